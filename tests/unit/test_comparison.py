"""Filters against each other, and against a baseline."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

import consistency as cs
from consistency.comparison import baseline_of, compare_filters, compare_with, read_baseline, write_baseline
from consistency.diagnostics import RunSummary, compare, summary
from consistency.types import Array

RATE = 1e-4  # false-failure rate of each statistical test below


def of_runs(means: Array, runs: Array | None = None) -> RunSummary:
    empty = np.empty((len(means), 0))
    return RunSummary(np.arange(len(means)) if runs is None else runs, 3, means, empty, empty)


def gamma(rng: np.random.Generator, size: int, ratio: float) -> Array:
    return rng.gamma(5.0, ratio / 5.0, size)


def test_summary_by_hand() -> None:
    error = np.array([[[1.0, 0.0], [3.0, 1.0]], [[0.0, 2.0], [np.nan, np.nan]]])
    P = np.broadcast_to(np.eye(2), (2, 2, 2, 2))
    nees = np.square(error).sum(axis=-1)
    s = summary(nees, 2, error, P)
    np.testing.assert_allclose(s.nees, [(1 + 10) / 4, 4 / 2])
    np.testing.assert_allclose(s.squared, [[5.0, 0.5], [0.0, 4.0]])
    np.testing.assert_allclose(s.covered, [[0.5, 1.0], [1.0, 1.0]])


def test_paired_ratio_is_the_t_interval_of_the_influence() -> None:
    rng = np.random.default_rng()
    a, b = gamma(rng, 30, 2.0), gamma(rng, 30, 1.0)
    d = compare(of_runs(a), of_runs(b)).differences[0]
    z = a / a.mean() - b / b.mean()
    half = stats.t.ppf(0.975, 29) * z.std(ddof=1) / np.sqrt(30)
    np.testing.assert_allclose([d.low, d.high], np.exp(np.log(a.mean() / b.mean()) + np.array([-half, half])))


def test_a_filter_against_itself_is_not_worse() -> None:
    a = of_runs(gamma(np.random.default_rng(), 20, 5.0))
    c = compare(a, a)
    assert not c.worse
    assert c.p_value == 1.0
    assert c.distance == 0.0


@pytest.mark.parametrize(("of_a", "of_b"), [(4.0, 1.0), (0.25, 1.0), (4.0, 0.5)])
def test_farther_from_consistent_is_worse_on_either_side(of_a: float, of_b: float) -> None:
    """Missed with probability below 1e-6: the distance is at least 7 standard errors."""
    rng = np.random.default_rng()
    a, b = gamma(rng, 100, of_a), gamma(rng, 100, of_b)
    assert compare(of_runs(a), of_runs(b), 1e-3).worse
    assert not compare(of_runs(b), of_runs(a), 1e-3).worse


@pytest.mark.parametrize("ratio", [1.0, 3.0])
def test_false_alarms_stay_below_the_stated_rate(ratio: float) -> None:
    """400 pairs of equally consistent filters at 5 %; fails by chance less often than 1 in 10,000."""
    rng = np.random.default_rng()
    found = 0
    for _ in range(400):
        shared = rng.gamma(4.0, 1.0, 40)
        a, b = (ratio * (shared + rng.gamma(1.0, 1.0, 40)) / 5.0 for _ in range(2))
        found += compare(of_runs(a), of_runs(b)).worse
    assert found <= stats.binom.isf(RATE, 400, 0.06)  # Student's t on gamma means: at most 6 %


def test_common_runs_are_paired_and_others_left_out() -> None:
    rng = np.random.default_rng()
    a, b = gamma(rng, 20, 1.0), gamma(rng, 20, 1.0)
    a[3] = np.nan
    c = compare(of_runs(a, np.arange(20)), of_runs(b, np.arange(5, 25)))
    assert c.paired
    assert c.runs == 15
    d = c.differences[0]
    assert d.a == pytest.approx(3 * a[5:20].mean())
    assert not compare(of_runs(a[4:16]), of_runs(b[:12], np.arange(100, 112))).paired


def test_refusals() -> None:
    a = of_runs(np.ones(20))
    with pytest.raises(ValueError, match="at least 8 runs"):
        compare(a, of_runs(np.ones(5)))
    with pytest.raises(ValueError, match="dimensions"):
        compare(a, RunSummary(a.runs, 2, a.nees, a.squared, a.covered))


def test_needed_runs_is_what_the_power_takes() -> None:
    """Power of 300 comparisons at the number asked for: at least 0.95 less 5 points; 1 in 10,000 by chance."""
    rng = np.random.default_rng()
    pilot = compare(of_runs(gamma(rng, 4000, 1.5)), of_runs(gamma(rng, 4000, 1.0)), 0.05)
    needed = pilot.needed_runs(1.5, 0.95)
    found = sum(
        compare(of_runs(gamma(rng, needed, 1.5)), of_runs(gamma(rng, needed, 1.0)), 0.05).worse for _ in range(300)
    )
    assert found >= stats.binom.ppf(RATE, 300, 0.90)


# --- results and files -----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def results() -> cs.Results:
    scenario = cs.load_scenario("herath2007-stereo").variant("short", truth__steps=40)
    return cs.run_trials(scenario, ["ekf-xyz", "ekf-uvd"], runs=12, seed=3)


def test_two_filters_of_the_same_trials(results: cs.Results) -> None:
    (compared,) = compare_filters(baseline_of(results), ["ekf-xyz", "ekf-uvd"])
    assert compared.comparison.paired
    assert compared.sentence.startswith("ekf-xyz is ")
    names = [d.name for d in compared.comparison.differences]
    assert names[0] == "ANEES"
    assert "RMSE heading" in names
    assert "2-sigma coverage x" in names


def test_a_baseline_read_back_is_the_same(results: cs.Results, tmp_path: Path) -> None:
    write_baseline(results, tmp_path / "base.json")
    for compared in compare_with(baseline_of(results), read_baseline(tmp_path / "base.json"), []):
        assert compared.comparison.paired
        assert compared.comparison.distance == 0.0
        assert not compared.worse
        assert "every run is the same" in compared.sentence


def test_other_trials_are_not_paired(results: cs.Results) -> None:
    other = cs.run_trials(results.scenario, ["ekf-uvd"], runs=12, seed=4)
    (compared,) = compare_with(baseline_of(results), baseline_of(other), [])
    assert not compared.comparison.paired
    assert "not the same" in compared.sentence


def test_bad_baselines_are_refused(results: cs.Results, tmp_path: Path) -> None:
    path = tmp_path / "base.json"
    write_baseline(results, path)
    with pytest.raises(cs.InputError, match="exists already"):
        write_baseline(results, path)
    data = json.loads(path.read_text())
    for broken, message in (
        ("{", "not valid JSON"),
        ("[]", "is no baseline"),
        (json.dumps(data | {"kind": "log"}), "is no baseline"),
        (json.dumps(data | {"filters": {"f": {}}}), "damaged"),
    ):
        path.write_text(broken)
        with pytest.raises(cs.InputError, match=message):
            read_baseline(path)
    with pytest.raises(cs.InputError, match="cannot be read"):
        read_baseline(tmp_path / "nix.json")
    base = baseline_of(results)
    with pytest.raises(cs.InputError, match="is not in"):
        compare_filters(base, ["ekf-uvd", "nix"])
    with pytest.raises(cs.InputError, match="give two filters"):
        compare_filters(base, ["ekf-uvd"])
