"""The parts of ``make bench``, on tiny sizes; and what it asserts can fail."""

import importlib.util
import json
from pathlib import Path

import bench
import bench_whole as whole
import numpy as np
import pytest
from bench_models import WARM
from bench_peers import FilterpyEkf, FilterpyUkf, stone_soup
from bench_trials import Case, Unequal, growing, grown, require_equal, steady
from threadpoolctl import threadpool_limits

import consistency as cs
from consistency.bench.simulation import World

BENCHMARKS = Path(bench.__file__).parent
TINY = bench.Effort(
    repeats=1,
    steps=12,
    peer_steps=(3, 2),
    landmarks=(14, 20),
    cloud=(10, 5),
    growth_repeats=1,
    size=(20, 12),
    runs=4,
    run_steps=20,
    memory_runs=(1, 2),
)


@pytest.fixture(scope="module", autouse=True)
def one_blas_thread():
    with threadpool_limits(1):
        yield


@pytest.fixture(scope="module")
def case():
    return steady(12)


def test_every_step_sees_exactly_twelve_known_landmarks(case):
    counts = np.diff(case.trial.first)
    assert counts[0] == 57
    assert set(counts[1:]) == {12}
    assert (case.run("ekf-uvd").nis_dof[1:] == 36).all()
    assert set(np.diff(steady(12, seen=0).trial.first)[1:]) == {0}
    assert set(case.trial.landmark[case.trial.first[1] :]) == set(range(57)), "all in turn"


def test_a_timed_filter_does_what_filters_do():
    """The trials are no nonsense: small errors, NIS as it should be (36 degrees of freedom in 200 steps)."""
    case = steady(200)
    for name in ("ekf-uvd", "ukf-uvd"):
        said = case.run(name)
        assert np.abs(said.pose - case.trial.truth[1:]).max() < 0.2
        assert np.nanmean(said.nis[1:]) / 36 == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize("stride", [1, 3])
def test_a_growing_map_has_a_constant_number_in_view(stride):
    trial = growing(20, stride).trial
    assert set(np.diff(trial.first)) == {12}
    assert set(trial.landmark) == set(range(20))
    assert trial.steps == (20 - 12 + 1) * stride
    assert set(np.diff(grown(20, 4).trial.first)) == {20, 12}


def test_the_head_of_a_case_is_its_first_steps(case):
    assert np.array_equal(case.head(5).run("ekf-uvd").pose, case.run("ekf-uvd").pose[:5])


def test_a_failed_run_is_no_measurement(case):
    trial = case.trial
    broken = cs.Trial(0, trial.start, trial.controls, trial.first, trial.landmark, trial.z * np.nan, 57)
    with pytest.raises(RuntimeError, match="ekf-uvd failed in step 1"):
        Case(broken, case.belief).run("ekf-uvd")


@pytest.mark.parametrize("peer, other", [(FilterpyEkf, "ukf-uvd"), (FilterpyUkf, "ekf-uvd")])
def test_filterpy_says_the_same_and_another_filter_does_not(case, peer, other):
    said = peer(case, 3)()
    assert require_equal("peer", *said, case.run(peer.filter), WARM) < 1e-11
    with pytest.raises(Unequal, match="peer: differs from ours by"):
        require_equal("peer", *said, case.run(other), WARM)


@pytest.mark.parametrize("kind", ["ekf", "ukf"])
def test_stone_soup_says_the_same(case, kind):
    pytest.importorskip("stonesoup")
    peer = stone_soup(kind, case, 3)
    assert not isinstance(peer, str)
    assert require_equal("peer", *peer(), case.run(f"{kind}-uvd"), WARM) < 1e-11


def test_without_stone_soup_there_is_a_reason(case, monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    assert "not installed" in str(stone_soup("ekf", case, 3))


@pytest.mark.parametrize("what", ["pose", "covariance", "nan"])
def test_a_difference_is_caught(case, what):
    ours = case.run("ekf-uvd")
    pose, covariance = ours.pose[WARM:].copy(), ours.covariance[WARM:].copy()
    assert require_equal("peer", pose, covariance, ours, WARM) == 0.0
    if what == "covariance":
        covariance[-1] *= 1 + 1e-6
    else:
        pose[-1, 2] += 1e-7 if what == "pose" else np.nan
    with pytest.raises(Unequal):
        require_equal("peer", pose, covariance, ours, WARM)


@pytest.mark.parametrize("group", ["peers", "kernels", "growth", "vision", "program", "memory"])
def test_a_group_of_rows(group):
    rows = list(bench.GROUPS[group](TINY))
    assert rows
    assert all(row.value is None or np.isfinite(row.value) for row in rows)
    assert {row.verdict for row in rows} <= {"met", "missed", ""}
    assert json.loads(json.dumps(bench.document(rows, 1.0), allow_nan=False))["rows"][0]["what"] == rows[0].what
    assert all(row.what in bench.line(row) for row in rows)


@pytest.mark.parametrize(
    "value, at_most, verdict",
    [(2.0, True, "met"), (2.1, True, "missed"), (2.0, False, "met"), (1.9, False, "missed"), (None, False, "missed"),
     (float("nan"), True, "missed")],
)  # fmt: skip
def test_met_and_missed(value, at_most, verdict):
    assert bench.Row("g", "w", value, "x", 2.0, at_most).verdict == verdict
    assert bench.Row("g", "w", value, "x").verdict == ""


def test_main_writes_what_it_prints(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(bench.GROUPS, "start", lambda effort: iter([bench.Row("start", "a row", 1.0, "s", 0.5, True)]))
    bench.main(["--only", "start", "--out", str(tmp_path / "new" / "bench.json")])
    assert "1 of 1 targets missed" in capsys.readouterr().out
    written = json.loads((tmp_path / "new" / "bench.json").read_text())
    assert written["rows"][0] | {"note": ""} == written["rows"][0]
    assert written["rows"][0]["verdict"] == "missed"


def test_the_clock_takes_time_and_goes_away():
    original = World.trial
    with whole.Clock().on(World, "trial"):
        assert World.trial is not original
    assert World.trial is original
    assert 0.0 < whole.share_outside(2, 20, ["ekf-uvd"], 1) < 1.0


def test_memory_lies_on_a_line():
    points = [{"runs": 100, "peak_mib": 300.0}, {"runs": 200, "peak_mib": 350.0}]
    assert whole.extrapolated(points, 1000) == pytest.approx(750.0)
    assert whole.extrapolated(points[1:], 200) == 350.0, "measured"
    assert whole.extrapolated([*points, {"runs": 300, "peak_mib": 300.0}], 1000) is None, "no rise, no line"


def test_peak_memory_is_the_childs_own():
    """Not the parent's, which the bench has made large before."""
    large = np.ones(100_000_000)  # 800 MB
    code = f"import sys; sys.path.insert(0, {str(BENCHMARKS)!r}); import bench_whole; print(bench_whole.peak_mib())"
    assert float(whole._process(["-c", code])) < 700.0 < large.nbytes / 2**20
    assert whole.peak_mib() > 700.0


def test_a_process_that_breaks_is_no_measurement():
    assert whole.help_seconds(1) > 0.0
    with pytest.raises(RuntimeError, match="exit status 2"):
        whole._process(["-m", "consistency", "nonsense"])
