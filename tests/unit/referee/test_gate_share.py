"""Does a gate ever fire: the share that it rejects, and the smallest spike that it rejects."""

import json

import numpy as np
import pytest
from command import consistency, refused
from scipy import stats

import consistency as cs
from consistency.referee.diagnostics.monitor import gate_share, smallest_spike


def fed(nis, dof=1, gate=0.99):
    monitor = cs.Monitor(gate=gate)
    for value in nis:
        monitor.update(value, dof)
    return monitor


def monitored(capsys, folder, nis, dof, *words):
    rows = "\n".join(f"{k + 1},{value!r},{dof}" for k, value in enumerate(np.asarray(nis, float).tolist()))
    (folder / "nis.csv").write_text(f"step,nis,nis_dof\n{rows}\n")
    return consistency(capsys, "monitor", folder / "nis.csv", "--innovations", "optimal", *words)[0]


@pytest.mark.parametrize("gate, fewest", [(0.95, 72), (0.99, 368), (0.999, 3688)])
def test_the_fewest_measurements_that_show_that_none_is_rejected(gate, fewest):
    """0.99^368 is 2.5 %: with fewer nothing can be shown."""
    assert gate_share(0, fewest, gate)[::2] == (pytest.approx(gate**fewest), fewest)
    assert gate_share(0, fewest, gate).finding == "too few"
    assert gate_share(0, fewest - 1, gate).finding == ""


@pytest.mark.parametrize("refused_, tried", [(0, 400), (3, 1000), (10, 1000), (30, 1000), (1, 1)])
def test_both_sides_are_binomial(refused_, tried):
    share = gate_share(refused_, tried, 0.99)
    both = [stats.binomtest(refused_, tried, 0.01, side).pvalue for side in ("less", "greater")]
    assert [share.few, share.many] == pytest.approx(both, rel=1e-9)
    assert share.finding == ("too few" if both[0] <= 0.025 else "too many" if both[1] <= 0.025 else "")


@pytest.mark.parametrize("scale", [1.0, 0.5, 0.1, 0.01, 1e-4])
@pytest.mark.parametrize("dof", [1, 2, 3, 12])
def test_half_of_the_smallest_spikes_are_rejected(dof, scale):
    """Noncentral chi-square; and a covariance that is 100 times too large hides spikes of 33 deviations in 3-D."""
    spike = smallest_spike(dof, 0.99, scale)
    limit = stats.chi2.isf(0.01, dof) / scale
    assert stats.ncx2.sf(limit, dof, spike**2) == pytest.approx(0.5, abs=1e-3)


def test_known_spikes():
    assert smallest_spike(3, 0.99) == pytest.approx(3.05, abs=0.005)
    assert smallest_spike(3, 0.99, 0.01) == pytest.approx(33.65, abs=0.01)
    assert smallest_spike(1, 0.99, 0.01) == pytest.approx(25.76, abs=0.01)
    assert smallest_spike(2, 0.99, 20.0) == 0.0  # half are rejected anyway
    limit = stats.chi2.isf(0.01, 3)
    near, far = (smallest_spike(3, 0.99, limit / x) for x in (999.9, 1000.1))
    assert near == pytest.approx(far, rel=2e-4)  # both formulas


def test_rejections_right_after_another_do_not_count():
    """2 accepted innovations must come between, 5 with a gate below 99 %; a step without one is none."""
    monitor = fed([9.0, 9.0, 1.0, 9.0, 1.0, 1.0, 1.0, 9.0, 1.0])
    assert (monitor.measurements, monitor.rejections) == (9, 4)
    assert (monitor.refused, monitor.tried) == (2, 3)
    assert (fed([1.0], dof=0).tried, fed([np.nan]).refused) == (0, 1)
    assert fed([9.0, *[1.0] * 5, 9.0], gate=0.95).refused == 2
    assert fed([9.0, *[1.0] * 4, 9.0], gate=0.95).refused == 1
    assert (fed([1.0], gate=None).gate_share, fed([1.0], gate=None).smallest_spikes) == (None, {})


def test_a_covariance_that_is_100_times_too_large(tmp_path, capsys):
    nis = stats.chi2.ppf((np.arange(368) + 0.5) / 368, 3) / 100
    out = monitored(capsys, tmp_path, nis, 3, "--gate", "99%")
    assert (
        "rejected 0 % of 368 measurements (a right filter: 1 %): too few (p 0.025, at a false-alarm rate of 5 %)" in out
    )
    assert "34 in 3-D (3.1 if its covariance were right)" in out
    assert "too large" in out
    out = monitored(capsys, tmp_path, nis[:-1], 3, "--gate", "0.99")
    assert "shows nothing: 368 without a rejection" in out
    data = json.loads(monitored(capsys, tmp_path, nis, 3, "--gate", "99%", "--json"))
    assert data["gate_share"]["finding"] == "too few"
    assert (data["gate_share"]["tried"], data["gate_share"]["fewest"]) == (368, 368)
    assert data["smallest_spikes"] == [
        {"dof": 3, "found": pytest.approx(33.65, rel=0.01), "right": pytest.approx(3.051, rel=1e-3)}
    ]
    assert data["gate"] == 0.99
    without = json.loads(monitored(capsys, tmp_path, nis, 3, "--json"))
    assert (without["gate_share"], without["smallest_spikes"]) == (None, [])


def test_a_covariance_that_is_too_small_and_a_right_one(tmp_path, capsys):
    values = stats.chi2.ppf((np.random.default_rng(1).permutation(2000) + 0.5) / 2000, 2)
    out = monitored(capsys, tmp_path, 2 * values, 2, "--gate", "99%")
    assert "too many (p below 1e-6" in out
    out = monitored(capsys, tmp_path, values, 2, "--gate", "99%")
    assert "not shown to be too few or too many" in out
    assert "2.9 in 2-D." in out


@pytest.mark.parametrize(
    "gate, message",
    [("abc", "--gate abc: must be a probability"), ("99", "--gate must be a probability of at least 0.95 and below 1"),
     ("0%", "got 0.0"), ("100%", "got 1.0"), ("nan", "got nan"), ("", "--gate : must be a probability"),
     ("%", "--gate %: must be a probability")],
)  # fmt: skip
def test_a_gate_that_is_none_is_refused(gate, message, tmp_path, capsys):
    (tmp_path / "nis.csv").write_text("step,nis,nis_dof\n1,1.0,1\n")
    words = ["monitor", tmp_path / "nis.csv", "--innovations", "optimal", "--gate", gate]
    assert message in refused(capsys, *words)
