"""Filters against each other, and against a baseline."""

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from command import consistency, refused
from numpy.testing import assert_allclose
from recorded import read_recordings
from scipy import optimize, special, stats

import consistency as cs
from consistency.bench.runs.results_to_records import results_source
from consistency.diagnostics import Comparison, RunSummary, compare, summary
from consistency.referee.diagnostics.comparison import summary_of_runs
from consistency.referee.diagnostics.nees import Contrast, contrast, margin
from consistency.referee.gating.session import RunningTest, needed_at, watching
from consistency.referee.verdicts.compare_sources import (
    Compared,
    baseline,
    compare_filters,
    compare_with,
    read_baseline,
    write_baseline,
)
from consistency.testing import ConsistencyError, InsufficientTrials, assert_not_worse

RATE = 1e-5  # false-failure rate of each statistical assertion below


def of_runs(means, runs=None):
    empty = np.empty((len(means), 0))
    return RunSummary(np.arange(len(means)) if runs is None else runs, 3, means, empty, empty)


def gamma(rng, size, ratio):
    return rng.gamma(5.0, ratio / 5.0, size)


def test_summary_by_hand():
    error = np.array([[[1.0, 0.0], [3.0, 1.0]], [[0.0, 2.0], [np.nan, np.nan]]])
    P = np.broadcast_to(np.eye(2), (2, 2, 2, 2))
    nees = np.square(error).sum(axis=-1)
    s = summary(nees, 2, error, P)
    assert_allclose(s.nees, [(1 + 10) / 4, 4 / 2])
    assert_allclose(s.squared, [[5.0, 0.5], [0.0, 4.0]])
    assert_allclose(s.covered, [[0.5, 1.0], [1.0, 1.0]])


def test_paired_ratio_is_the_t_interval_of_the_influence():
    rng = np.random.default_rng()
    a, b = gamma(rng, 30, 2.0), gamma(rng, 30, 1.0)
    d = compare(of_runs(a), of_runs(b)).differences[0]
    z = a / a.mean() - b / b.mean()
    half = stats.t.ppf(0.975, 29) * z.std(ddof=1) / np.sqrt(30) * np.exp(0.5 * np.sqrt(2 / 29))  # to the safe side
    assert_allclose([d.low, d.high], np.exp(np.log(a.mean() / b.mean()) + np.array([-half, half])))


def test_a_coverage_in_which_no_run_differs_has_an_interval():
    """A share of runs of 1 - .025^(1/21) is missing among 21 runs with probability 2.5 %; never beyond [-1, 1]."""
    nees, inside = gamma(np.random.default_rng(6), 21, 2.0), np.ones((21, 1))
    a = RunSummary(np.arange(21), 1, nees, nees[:, None], inside)
    d = compare(a, a).differences[2]
    assert (d.difference, d.low, d.high) == (0.0, pytest.approx(-(1 - 0.025 ** (1 / 21))), pytest.approx(-d.low))
    opposite = RunSummary(np.arange(21), 1, nees, nees[:, None], 0.0 * inside)
    d = compare(a, opposite).differences[2]
    assert (d.low, d.high) == (pytest.approx(0.025 ** (1 / 21)), 1.0)


@pytest.mark.parametrize("largest", [1.0, 0.2])
def test_runs_that_are_missing_may_differ_as_much_as_those_that_are_not(largest):
    """One of 21 runs differs by ``largest``: Student's t alone would give 2.1 / 21 of that, and miss too often."""
    nees, inside = gamma(np.random.default_rng(6), 21, 2.0), np.ones((21, 1))
    less = inside - largest * (np.arange(21) == 4)[:, None]
    missing = largest * (1 - 0.025 ** (1 / 21))
    a, b = (RunSummary(np.arange(21), 1, nees, nees[:, None], covered) for covered in (less, inside))
    for first, second, gap in ((a, b, -largest / 21), (b, a, largest / 21)):
        d = compare(first, second).differences[2]
        assert (d.difference, d.low, d.high) == pytest.approx((gap, gap - missing, gap + missing))


# --- the test of 'worse' ---------------------------------------------------------------------------


def slow(rng, runs, n):
    """Mean NEES over n of runs with one error in all their steps."""
    return rng.chisquare(n, runs) / n


def mixed(rng, runs, n):
    """Mean NEES over n of runs of 100 independent steps."""
    return rng.chisquare(100 * n, runs) / (100 * n)


def now_and_then(rng, runs, n):
    """Three runs in ten are slow."""
    return np.where(rng.random(runs) < 0.3, slow(rng, runs, n), mixed(rng, runs, n))


def same_trials(rng, runs, n):
    """Two slow filters with errors that are correlated 0.9."""
    e, d = rng.standard_normal((2, runs, n))
    return np.square(e).mean(axis=1), np.square(0.9 * e + np.sqrt(0.19) * d).mean(axis=1)


EQUALLY_CONSISTENT = {
    "slow and mixed": (slow, mixed, 1.0, 1.0),
    "mixed and slow": (mixed, slow, 1.0, 1.0),
    "slow and mixed, both x0.5": (slow, mixed, 0.5, 0.5),
    "mixed and slow, both x2": (mixed, slow, 2.0, 2.0),
    "both slow, x1.5 and x1/1.5": (slow, slow, 1.5, 1 / 1.5),
    "now and then and mixed, both x0.5": (now_and_then, mixed, 0.5, 0.5),
}


@pytest.mark.parametrize("world", EQUALLY_CONSISTENT)
@pytest.mark.parametrize("runs, n, paired", [(8, 1, True), (12, 3, True), (30, 1, True), (20, 1, False)])
def test_no_more_false_alarms_than_stated(rng, world, runs, n, paired):
    """400 comparisons at 5 and 1 % of two filters that are equally far from consistent."""
    of_a, of_b, scale_a, scale_b = EQUALLY_CONSISTENT[world]
    pairs = [(scale_a * of_a(rng, runs, n), scale_b * of_b(rng, runs, n)) for _ in range(400)]
    p = np.array([compare(of_runs(a), of_runs(b), paired=paired).p_value for a, b in pairs])
    for rate in (0.05, 0.01):
        assert (p <= rate).sum() <= stats.binom.isf(RATE, 400, rate)


def test_calibration_rows_count_false_alarms(monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parents[3] / "benchmarks")
    import calibration_compare

    monkeypatch.setattr(calibration_compare, "QUICK_GATES", {0.05: 40, 0.01: 20})
    rows = calibration_compare.rows(True, 5)
    assert len(rows) == 2 * 2 * 3 * 2
    assert {(r["stated"], r["gates"]) for r in rows} == {(0.05, 40), (0.01, 20)}
    assert all(0 <= r["found"] <= r["gates"] for r in rows)
    assert {r["world"] for r in rows} | {r["question"] for r in rows} == set(calibration_compare.ABOUT)
    assert rows == calibration_compare.rows(True, 5)
    monkeypatch.setattr(calibration_compare, "_p_value", lambda *_: 0.03)
    always = calibration_compare.rows(True, 5)
    assert {r["found"] for r in always if r["stated"] == 0.05} == {40}
    assert {r["found"] for r in always if r["stated"] == 0.01} == {0}


def test_the_p_value_by_hand(monkeypatch):
    """Of each side the larger p value counts, of both sides the smaller, twice."""
    table = {
        # one-sided p of log a - log b above and below 0, the same of log a + log b -> p
        ((0.01, 0.99), (0.03, 0.97)): 0.06,  # over, decided by the sum
        ((0.04, 0.96), (0.03, 0.97)): 0.08,  # over, decided by the difference
        ((0.98, 0.02), (0.999, 0.001)): 0.04,  # under
        ((0.01, 0.99), (0.99, 0.01)): 1.0,  # b is farther, on the other side: neither
        ((0.45, 0.55), (0.52, 0.48)): 1.0,  # twice 0.52 is no probability
        ((1.0, 1.0), (0.001, 0.999)): 1.0,  # no difference at all
    }
    a = of_runs(np.linspace(0.5, 1.5, 20))
    for tails, wanted in table.items():
        of_sign = {
            sign: SimpleNamespace(p_values=p, value=0.0, error=1.0, half_width=lambda tail: 1.0)
            for sign, p in zip((-1.0, 1.0), tails, strict=True)
        }
        monkeypatch.setattr(
            "consistency.referee.diagnostics.comparison.contrast",
            lambda a, b, sign, paired, of_sign=of_sign: of_sign[sign],
        )
        assert compare(a, a).p_value == pytest.approx(wanted)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize("paired", [True, False])
def test_a_contrast_by_hand(rng, sign, paired):
    """Slope by a numerical derivative, gamma shape by its equation; limits are the terms of order 1 / runs."""
    runs_a, runs_b = 3000, 3000 if paired else 1500
    a, b = now_and_then(rng, runs_a, 1), now_and_then(rng, runs_b, 1)  # the moments hide a good part of the spread
    b = b + rng.chisquare(1.0, runs_b) if paired else b  # and here they do not
    c = contrast(a, b, sign, paired)
    assert c.value == pytest.approx(np.log(a.mean()) + sign * np.log(b.mean()))
    assert c.freedom == runs_b - 1

    def value_and_variance(of_a, of_b):
        mean_a, mean_b = (np.average(x, weights=w) for x, w in ((a, of_a), (b, of_b)))
        x, y = a / mean_a - 1.0, sign * (b / mean_b - 1.0)
        if paired:
            variance = np.average((x + y) ** 2, weights=of_a) / runs_a
        else:
            variance = np.average(x**2, weights=of_a) / runs_a + np.average(y**2, weights=of_b) / runs_b
        return float(np.log(mean_a) + sign * np.log(mean_b)), float(variance)

    x, y = a / a.mean() - 1.0, sign * (b / b.mean() - 1.0)
    of_a, of_b = (0.1 * (x + y) / runs_a,) * 2 if paired else (0.1 * x / runs_a, 0.1 * y / runs_b)
    (up, v_up), (down, v_down) = (value_and_variance(1.0 + k * of_a, 1.0 + k * of_b) for k in (1.0, -1.0))
    assert c.slope == pytest.approx(np.log(v_up / v_down) / (up - down), rel=0.01, abs=0.02)

    def spread_of_gamma(means):
        gap = np.log(means.mean()) - np.log(means).mean()
        return 1.0 / float(optimize.brentq(lambda shape: np.log(shape) - special.digamma(shape) - gap, 1e-3, 1e3))

    hidden = [spread_of_gamma(a), spread_of_gamma(b)]
    moments = [x.var(), y.var()]
    factor = sum(map(max, moments, hidden)) / sum(moments)
    _, variance = value_and_variance(np.ones(runs_a), np.ones(runs_b))
    assert c.variance == pytest.approx(variance * factor, rel=0.025)
    assert factor > 1.05


def test_the_slope_of_a_few_runs_by_hand(rng):
    """Against a reference without spread: Fisher's k-statistic k3 / s^4, less what the division by the mean adds."""
    a = rng.gamma(1.0, 1.0, 9)
    x = a / a.mean()
    wanted = stats.kstat(x, 3) / x.var(ddof=1) ** 2 - 2.0 * 9.0 / 7.0
    for sign in (-1.0, 1.0):
        for paired in (True, False):
            assert contrast(a, np.ones(9), sign, paired).slope == pytest.approx(wanted)


def test_student_and_what_makes_it_safe():
    c = Contrast(value=-0.6, variance=0.04, slope=1.5, freedom=9.0)
    t = -0.6 / (0.2 * np.exp(0.5 * (1.5 * 0.6 + np.sqrt(2 / 9))))  # the hypothesis lies 0.6 above
    assert c.p_values == pytest.approx((stats.t.sf(t, 9), stats.t.cdf(t, 9)))
    t = 0.6 / (0.2 * np.exp(0.5 * np.sqrt(2 / 9)))  # a variance that would be smaller is left as it is
    assert Contrast(0.6, 0.04, 1.5, 9.0).p_values == pytest.approx((stats.t.sf(t, 9), stats.t.cdf(t, 9)))
    t = -2.0 / (0.2 * np.exp(0.5 * (1.5 * 0.8 + np.sqrt(2 / 9))))  # moved by 4 standard errors at most
    assert Contrast(-2.0, 0.04, 1.5, 9.0).p_values[1] == pytest.approx(stats.t.cdf(t, 9))
    half = stats.t.isf(0.01, 9) * 0.2 * np.exp(0.5 * (1.5 * 0.8 + np.sqrt(2 / 9)))
    for slope in (1.5, -1.5):
        assert Contrast(0.0, 0.04, slope, 9.0).half_width(0.01) == pytest.approx(half)
    assert margin(8.0) == 0.5


def test_runs_without_spread_and_runs_of_zeros(rng):
    one = np.ones(10)
    assert compare(of_runs(2.0 * one), of_runs(one)).p_value == 0.0
    assert compare(of_runs(one), of_runs(2.0 * one)).p_value == 1.0
    assert compare(of_runs(one), of_runs(one)).at_most == 0.0
    opposite = np.linspace(0.5, 1.5, 10)
    assert compare(of_runs(opposite), of_runs(2.0 - opposite)).p_value == 1.0  # the sum has next to no spread
    some = np.where(np.arange(10) < 3, 0.0, 1.0)
    assert compare(of_runs(some), of_runs(gamma(rng, 10, 1.0))).p_value <= 1.0
    with pytest.raises(ValueError, match="every NEES of b is 0"):
        compare(of_runs(one), of_runs(0.0 * one))


def test_common_runs_are_paired_and_others_left_out():
    rng = np.random.default_rng()
    a, b = gamma(rng, 20, 1.0), gamma(rng, 20, 1.0)
    a[3] = np.nan
    c = compare(of_runs(a, np.arange(20)), of_runs(b, np.arange(5, 25)))
    assert c.paired
    assert c.runs == 15
    d = c.differences[0]
    assert d.a == pytest.approx(3 * a[5:20].mean())
    assert not compare(of_runs(a[4:16]), of_runs(b[:12], np.arange(100, 112))).paired
    assert compare(of_runs(a[4:12]), of_runs(b[:8])).paired
    order = rng.permutation(15)
    mixed_up = compare(of_runs(a[5:20], np.arange(5, 20)), of_runs(b[:15][order], 5 + order))
    assert (mixed_up.standard_error, mixed_up.differences[0].low) == pytest.approx((c.standard_error, d.low))


def test_refusals():
    a = of_runs(np.ones(20))
    with pytest.raises(ValueError, match="at least 8 runs"):
        compare(a, of_runs(np.ones(5)))
    with pytest.raises(ValueError, match="dimensions"):
        compare(a, RunSummary(a.runs, 2, a.nees, a.squared, a.covered))


# --- the runs that it takes ------------------------------------------------------------------------


def test_a_plan_by_hand():
    c = Comparison(50, True, (), 0.0, 0.1, 1.0, 0.05)
    n = c.needed_runs(1.5, 0.9)

    def size(runs):
        z = stats.t.isf(0.025, runs - 1) + stats.t.isf(0.05, runs - 1)
        return float(z * 0.1 * np.sqrt(50 / runs) * np.exp(np.sqrt(2 / (runs - 1))))

    assert size(n) <= np.log(1.5) < size(n - 1)
    assert c.needed_runs(1 / 1.5, 0.9) == n
    assert replace(c, sum_error=0.1).needed_runs(1.5, 0.9) == n
    assert replace(c, sum_error=0.2, reference=0.5 * np.log(1.5)).needed_runs(1.5, 0.9) == n
    assert replace(c, sum_error=0.2).needed_runs(1.5, 0.9) > 3 * n
    assert replace(c, standard_error=1.0, at_most=0.4).needed_runs(1.5) == 50
    assert replace(c, standard_error=1.0, at_most=0.41).needed_runs(1.5) > 50
    assert c.needed_runs(1.0 + 1e-6) > 10**9
    assert replace(c, standard_error=0.0).needed_runs() == 8
    assert replace(c, at_most=0.0).needed_runs(3.0) == c.needed_runs(3.0) < 50


def test_worse_is_a_p_value_up_to_the_rate():
    c = Comparison(50, True, (), 0.0, 0.1, 0.05, 0.05)
    assert c.worse
    assert not replace(c, p_value=0.0501).worse


def test_worse_on_the_conservative_side_says_what_it_rests_on():
    wiggle = 1.0 + 0.1 * np.linspace(-1.0, 1.0, 20)
    sentences = [Compared("a", "b", compare(of_runs(ratio * wiggle), of_runs(wiggle)), (0, 0)) for ratio in (0.5, 2.0)]
    low, high = sentences
    assert low.worse
    assert high.worse
    assert low.comparison.conservative
    assert not high.comparison.conservative
    assert low.comparison.unseen == pytest.approx(0.13911, abs=1e-5)  # (1 - p)^20 = 0.05
    assert "unless rare runs with a large NEES are missing here: up to 14 % of all runs" in low.sentence
    assert "rare runs" not in high.sentence


def test_limits_of_the_distance_by_hand():
    """With next to no spread the limits are the distance and the reference themselves."""
    wiggle = 1.0 + 1e-6 * np.linspace(-1.0, 1.0, 20)
    for of_a, of_b in ((3.0, 2.0), (2.0, 3.0), (0.2, 0.5), (0.5, 0.2), (3.0, 0.5), (0.5, 3.0), (0.2, 2.0), (1.0, 1.0)):
        c = compare(of_runs(of_a * wiggle), of_runs(of_b * wiggle[::-1]))
        distance = abs(np.log(of_a)) - abs(np.log(of_b))
        assert c.distance == pytest.approx(distance, abs=1e-4)
        assert c.at_most == pytest.approx(distance, abs=1e-4)
        assert c.reference == pytest.approx(abs(np.log(of_b)), abs=1e-4)
        assert c.worse == (distance > 1e-4)


def test_runs_that_show_that_nothing_is_lost_are_enough(rng):
    """Another rounding of the same filter needs no more runs; a filter that could be farther off does."""
    nees = rng.chisquare(3, (10, 1))
    rounded = nees * (1.0 + 1e-12 * rng.standard_normal((10, 1)))
    c = assert_not_worse(nees_a=rounded, nees_b=nees, dof=3)
    assert not c.worse
    assert c.at_most < 1e-9
    sentence = Compared("f", "f", compare(of_runs(rounded[:, 0]), of_runs(nees[:, 0])), (0, 0)).sentence
    assert "no difference shown; at most x1 farther off" in sentence
    better = compare(of_runs(nees[:, 0]), of_runs(100.0 * nees[:, 0]))
    assert better.at_most < 0.0
    sentence = Compared("f", "f", better, (0, 0)).sentence
    assert f"f is at least {np.exp(-better.at_most):.3g} times nearer to consistent than the reference" in sentence
    assert "no difference" not in sentence
    assert "less consistent" not in sentence
    with pytest.raises(InsufficientTrials):
        assert_not_worse(nees_a=rng.chisquare(3, (10, 1)), nees_b=rng.chisquare(3, (10, 1)), dof=3, false_alarm=1e-9)


def test_what_few_runs_leave_open_is_said(rng):
    c = compare(of_runs(rng.chisquare(3, 10)), of_runs(rng.chisquare(3, 10)))
    assert not c.worse
    assert c.at_most > np.log(1.5)
    sentence = Compared("f", "g", c, (0, 0)).sentence
    assert f"; no difference shown; at most x{np.exp(c.at_most):.3g} farther off; {c.needed_runs(1.5)} runs" in sentence
    unlimited = Compared("f", "g", replace(c, at_most=np.inf), (0, 0)).sentence
    assert "; no difference shown; " in unlimited
    assert "at most" not in unlimited
    worse = compare(of_runs(9.0 * rng.chisquare(3, 100)), of_runs(rng.chisquare(3, 100)))
    assert "no difference" not in Compared("f", "g", worse, (0, 0)).sentence


def test_the_end_of_a_session_plans_as_the_gate_did(rng):
    entries = []
    a, b = same_trials(rng, 400, 8)
    for scale in (1.0, 2.0):
        with watching(RunningTest(keep=entries.append)):
            c = assert_not_worse(nees_a=scale * a[:, None], nees_b=scale * b[:, None], dof=1, false_alarm=1e-9)
        assert needed_at(entries[-1], 1e-9) == entries[-1].needed == c.needed_runs()
        assert needed_at(replace(entries[-1], planned_detect=1.01), 1e-9) == c.needed_runs(1.01)


# --- results and files -----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def results():
    scenario = cs.load_scenario("herath2007-stereo").variant("short", truth__steps=40)
    return cs.run_trials(scenario, ["ekf-xyz", "ekf-uvd"], runs=12, seed=3)


def test_two_filters_of_the_same_trials(results):
    (compared,) = compare_filters(baseline(results_source(results)), ["ekf-xyz", "ekf-uvd"])
    assert compared.comparison.paired
    assert compared.sentence.startswith("ekf-xyz is ")
    names = [d.name for d in compared.comparison.differences]
    assert names[0] == "ANEES"
    assert "RMSE heading" in names
    assert "2-sigma coverage x" in names


def test_other_trials_are_not_paired(results):
    other = cs.run_trials(results.scenario, ["ekf-uvd"], runs=12, seed=4)
    (compared,) = compare_with(baseline(results_source(results)), baseline(results_source(other)), [])
    assert not compared.comparison.paired
    assert "not the same" in compared.sentence


def test_bad_baselines_are_refused(results, tmp_path):
    path, base = tmp_path / "base.json", baseline(results_source(results))
    write_baseline(base, path)
    with pytest.raises(cs.InputError, match="exists already"):
        write_baseline(base, path)
    data = json.loads(path.read_text())
    for broken, message in (
        ("{", "not valid JSON"),
        ("[]", "is not a baseline"),
        (json.dumps(data | {"kind": "log"}), "is not a baseline"),
        (json.dumps(data | {"filters": {"f": {}}}), "damaged"),
    ):
        path.write_text(broken)
        with pytest.raises(cs.InputError, match=message):
            read_baseline(path)
    with pytest.raises(cs.InputError, match="cannot be read"):
        read_baseline(tmp_path / "nix.json")
    with pytest.raises(cs.InputError, match="is not in"):
        compare_filters(base, ["ekf-uvd", "nix"])
    with pytest.raises(cs.InputError, match="give two filters"):
        compare_filters(base, ["ekf-uvd"])


def test_files_whose_truth_is_not_known_are_other_trials(tmp_path):
    """Archives hold errors alone: runs of one number need not belong together."""
    rng = np.random.default_rng(515)
    for name in ("a", "b"):
        np.savez(tmp_path / f"{name}.npz", errors=rng.normal(size=(9, 5, 1)), covariances=np.ones((9, 5, 1, 1)))
    a, b = (baseline(read_recordings(tmp_path / f"{name}.npz"), name) for name in ("a", "b"))
    assert a.of_the_trials_of(a)
    assert not a.of_the_trials_of(b)
    (compared,) = compare_with(a, b, [])
    assert not compared.comparison.paired
    assert "Log or truth differ" in compared.sentence


def test_files_of_one_name_are_told_apart_by_their_paths(inside, capsys):
    rng = np.random.default_rng(3)
    names, stated = "run,t,x,y,heading", ",1,0,0,1,0,1"
    rows = [(run, t) for run in range(20) for t in range(4)]
    (inside / "truth.csv").write_text(f"{names}\n" + "".join(f"{run},{t},0,0,0\n" for run, t in rows))
    for side in ("new", "old"):
        (inside / side).mkdir()
        lines = [",".join(map(repr, [run, t, *rng.normal(size=3).tolist()])) + stated for run, t in rows]
        head = f"{names},P_xx,P_xy,P_xh,P_yy,P_yh,P_hh"
        (inside / side / "est.csv").write_text("\n".join([head, *lines, ""]))
    files = ["new/est.csv", "old/est.csv"]
    shown, _ = consistency(capsys, "compare", *files, "--truth", "truth.csv")
    assert f"est of {files[0]} is not shown to be less consistent than est of {files[1]}: 20 runs" in shown
    assert f"est of {files[1]} (reference)" in shown
    assert {"RMSE x (m)", "RMSE heading (rad)"} <= {line.split("  ")[0] for line in shown.splitlines()}
    same, _ = consistency(capsys, "compare", files[0], files[0], "--truth", "truth.csv")
    assert "than the reference" in same


# --- what else may be stated -------------------------------------------------------------------------------------


def members(rng, m, ratio=1.0, runs=60, steps=4):
    """Truth (runs, steps, 2) and members (runs, steps, m, 2), the truth with ``ratio`` times their variance."""
    return np.sqrt(ratio) * rng.standard_normal((runs, steps, 2)), rng.standard_normal((runs, steps, m, 2))


def members_table(path, m, ratio=1.0, seed=0, runs=40):
    truth, draws = members(np.random.default_rng(seed), m, ratio, runs)
    rows = [",".join(["run", "step", "true_x", *(f"ex{i}" for i in range(m))])]
    for run, step in np.ndindex(truth.shape[:2]):
        rows.append(",".join(map(str, [run + 3, step, truth[run, step, 0], *draws[run, step, :, 0]])))
    path.write_text("\n".join(rows) + "\n")
    return path


def test_members_are_compared_as_numbers_of_one_kind(tmp_path, capsys):
    """Truth of 4 times the variance: that they are not found worse has a probability below 1e-6."""
    a, b, few = (tmp_path / name for name in ("a.csv", "b.csv", "few.csv"))
    for path, m, ratio in ((a, 20, 4.0), (b, 20, 1.0), (few, 10, 1.0)):
        members_table(path, m, ratio)
    given = ("--members", "x=ex*")
    (found,) = json.loads(consistency(capsys, "compare", a, b, *given, "--json")[0])
    assert found["worse"]
    assert [d["name"] for d in found["differences"]] == ["ANEES"]  # their RMSE has no unit
    kind = found["sentence"].partition("Both are ")[2]
    summary_of_a = summary_of_runs(cs.read(a, members={"x": "ex*"}))
    assert summary_of_a.runs.tolist() == list(range(3, 43))
    shown = summary_of_a.kind
    assert kind == shown
    assert "numbers of 20 members" in kind
    assert float(kind.split()[-1]) == pytest.approx(1.55, abs=0.25)  # of 2, less
    consistency(capsys, "baseline", b, *given, "--out", tmp_path / "b.json")
    stored = json.loads(consistency(capsys, "compare", a, tmp_path / "b.json", *given, "--json")[0])
    assert stored[0]["distance"] == pytest.approx(found["distance"])
    err = refused(capsys, "compare", few, tmp_path / "b.json", *given)
    assert "10 members" in err
    assert "20 members" in err
    damaged = (tmp_path / "b.json").read_text().replace('"kind": "numbers', '"kind": 3, "x": "numbers')
    (tmp_path / "bad.json").write_text(damaged)
    assert "bad.json" in refused(capsys, "compare", a, tmp_path / "bad.json", *given)


def test_a_baseline_of_covariances_has_no_kind(results, tmp_path):
    write_baseline(baseline(results_source(results)), tmp_path / "base.json")
    assert "kind" not in (tmp_path / "base.json").read_text().replace('"kind": "baseline"', "")


def test_the_gate_compares_members_ensembles_repeats_and_rows():
    """At a false-alarm rate of 1e-6; a right candidate is found worse with that probability."""
    rng = np.random.default_rng(4)
    truth, draws = members(rng, 20)
    options = {"false_alarm": 1e-6, "detect": 6.0}
    assert not assert_not_worse(members_a=draws, members_b=draws, truth=truth, **options).worse
    with pytest.raises(ConsistencyError, match="worse"):
        assert_not_worse(members_a=draws / 4, members_b=draws, truth=truth, **options)
    with pytest.raises(ValueError, match=r"20 members.*10 members"):
        assert_not_worse(members_a=draws, members_b=draws[:, :, :10], truth=truth, **options)
    mean = draws.mean(axis=2, keepdims=True)
    P = np.swapaxes(draws - mean, 2, 3) @ (draws - mean) / 19
    e = truth - mean[:, :, 0]
    assert not assert_not_worse(e, P, e, P, ensemble=20, **options).worse
    with pytest.raises(ConsistencyError, match="worse"):
        assert_not_worse(e, P / 16, e, P, ensemble=20, **options)
    x = rng.standard_normal((80, 3))
    P = np.broadcast_to(np.eye(3), (80, 3, 3))
    assert assert_not_worse(x, P, x, P, independent=True, **options).runs == 80
    of_repeats = {"truth": "repeats", "independent": True}
    assert assert_not_worse(x + 7.0, P, x - 3.0, P, **of_repeats, **options).runs == 79
    with pytest.raises(ConsistencyError, match="worse"):
        assert_not_worse(x, P / 16, x, P, **of_repeats, **options)
    with pytest.raises(ValueError, match="members"):
        assert_not_worse(cs.run_trials, filter="a", members_a=draws)


def test_runs_of_members_are_planned_by_what_their_numbers_show():
    """A ratio of 1.5 shows as less in ranks among 4 members, and takes more runs than that of a covariance."""
    truth, draws = members(np.random.default_rng(5), 4)
    entries = []
    with watching(RunningTest(keep=entries.append)), pytest.raises(InsufficientTrials) as found:
        assert_not_worse(members_a=draws, members_b=-draws, truth=truth, false_alarm=1e-6, detect=1.5)
    sides = (
        summary_of_runs(cs.judge(members=draws, truth=truth).record),
        summary_of_runs(cs.judge(members=-draws, truth=truth).record),
    )
    assert found.value.needed > 1.3 * compare(*sides, 1e-6).needed_runs(1.5, 0.95)


def test_repeats_are_compared_run_by_run(tmp_path, capsys):
    rng = np.random.default_rng(6)
    paths = []
    for name, size in (("a.csv", 1.0), ("b.csv", 5.0)):
        rows = ["run,step,x,P_x_x", *(f"{run},1,{size * rng.standard_normal()},1" for run in range(60))]
        (tmp_path / name).write_text("\n".join(rows) + "\n")
        paths.append(tmp_path / name)
    words = ("--truth", "repeats", "--state", "x", "--json")
    (found,) = json.loads(consistency(capsys, "compare", *paths, *words)[0])
    assert (found["runs"], found["paired"], found["worse"]) == (59, True, False)
    assert json.loads(consistency(capsys, "compare", *paths[::-1], *words)[0])[0]["worse"]


def test_bounds_are_not_compared(tmp_path, capsys):
    path = tmp_path / "a.csv"
    path.write_text("run,step,x,true_x,bound_x\n" + "\n".join(f"{run},1,{run % 3},1,2" for run in range(30)) + "\n")
    err = refused(capsys, "compare", path, path, "--level", "95%")
    for part in ("bounds are not compared", "'analyse'", "--gaussian"):
        assert part in err
    assert "ANEES" in consistency(capsys, "compare", path, path, "--level", "95%", "--gaussian")[0]
