"""Every diagnostic against an independent oracle, on the fault that it is for, and on a clean case.

Random numbers are fresh in every run (the seed is printed when a test fails). Clean cases are judged at a false-alarm
rate of 1e-5, comparisons with simulations have 5-sigma limits (6e-7 each), and faults are so large that 1e-5 of them
would be missed: together under 1 false failure in 1,000 runs of this file.
"""

import re
from itertools import combinations

import numpy as np
import pytest
from draws import autoregression, identities
from hypothesis import given
from hypothesis import strategies as st
from referee import judge
from scipy import stats
from statsmodels.stats.diagnostic import acorr_ljungbox

import consistency as cs
from consistency.diagnostics import (
    Settings,
    answers,
    coverage_interval,
    gate_runs,
    hotelling,
    identity_statistic,
    make_record,
    mean_shape,
    nis_test,
    noncredibility,
    pit,
    power_of,
    required_runs,
    simultaneous_band,
    sphericity,
    spread_steps,
    standardise,
    t_squared,
    whiten,
    whiteness,
)
from consistency.diagnostics import judge as judge_record
from consistency.referee.diagnostics.tails import beyond_stated, outliers
from consistency.referee.diagnostics.verdict_parts import MAIN, SHARES

AXES = ("x", "y", "heading")
RUNS, STEPS, DOF = 100, 40, 3
FALSE_ALARM = 1e-5
P = np.array([[0.04, 0.01, 0.001], [0.01, 0.09, -0.002], [0.001, -0.002, 0.003]])  # m^2, m rad, rad^2


def within(count, total, rate, sigmas=5.0):
    """Is the count of a binomial variable as near to its mean as it should be?"""
    return bool(abs(count - total * rate) <= sigmas * np.sqrt(total * rate * (1 - rate)) + 1)


# --- planning ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("dof", [1, 3, 6])
@pytest.mark.parametrize("ratio", [0.5, 0.8, 1.3, 3.0])
@pytest.mark.parametrize("two_sided", [True, False])
def test_required_runs_are_the_fewest(dof, ratio, two_sided):
    """Counted up one by one."""
    tail = 0.01 / (2 if two_sided else 1)
    for runs in range(1, 10_000):
        k = dof * runs
        side = stats.chi2.sf if ratio > 1 else stats.chi2.cdf
        edge = stats.chi2.isf(tail, k) if ratio > 1 else stats.chi2.ppf(tail, k)
        if side(edge / ratio, k) >= 0.9:
            break
    assert required_runs(dof, ratio, 0.01, 0.9, two_sided) == runs
    assert power_of(dof, runs, ratio, 0.01, two_sided) >= 0.9 > power_of(dof, runs - 1, ratio, 0.01, two_sided)


def test_a_gate_plans_with_the_share_of_the_mean():
    assert gate_runs(3, 1.5) == required_runs(3, 1.5, 0.025)
    assert gate_runs(3, 1.5, 0.01, 0.9, "conservative") == required_runs(3, 1.5, 0.005, 0.9, two_sided=False)
    assert gate_runs(3, 1.5) > required_runs(3, 1.5)


# --- many questions ------------------------------------------------------------------------------------


@given(st.lists(st.floats(1e-12, 1.0), min_size=3, max_size=3))
def test_the_correction_is_that_of_closed_testing(p):
    """Every intersection of the questions by weighted Bonferroni; a question's p is the largest of those it is in."""
    names = (MAIN, "bias", "outliers")
    found = answers(dict(zip(names, p, strict=True)), 0.05)
    share = {q: a.share for q, a in found.items()}
    assert sum(share.values()) == pytest.approx(1.0)
    for i, name in enumerate(names):
        worst = 0.0
        for size in range(3):
            for others in combinations([j for j in range(3) if j != i], size):
                total = sum(share[names[j]] for j in (i, *others))
                worst = max(worst, min(p[j] * total / share[names[j]] for j in (i, *others)))
        assert found[name].adjusted == pytest.approx(min(worst, 1.0))
        assert found[name].found == (found[name].adjusted <= 0.05)


def test_shares_of_questions_not_asked_go_to_the_others_but_not_to_the_main():
    for all_but in ("scale in some direction", "shape"):
        everything = answers({q: 0.5 for q in SHARES if q != all_but}, 0.05)
        assert sum(a.share for a in everything.values()) == pytest.approx(1.0)
        assert everything[MAIN].share == 0.5
    found = answers({MAIN: 0.5, "bias": 0.5, "outliers": 0.5, "shape": float("nan")}, 0.05)
    assert set(found) == {MAIN, "bias", "outliers"}
    assert found[MAIN].share == 0.5
    assert found["bias"].share == pytest.approx(0.5 * 0.05 / 0.075)
    assert answers({MAIN: 0.04}, 0.05)[MAIN].found
    assert answers({"bias": 0.04}, 0.05)["bias"].found
    assert answers({MAIN: float("nan")}, 0.05) == {}


# --- units of the covariance -----------------------------------------------------------------------------


@pytest.mark.parametrize("scale", [1e-18, 1.0, 1e18])
def test_whitened_errors_square_to_the_nees(fresh, scale):
    A = fresh.standard_normal((5, 4, 3, 5))
    C = A @ np.swapaxes(A, -1, -2)
    e = fresh.standard_normal((5, 4, 3))
    w = whiten(e * np.sqrt(scale), C * scale)
    assert np.allclose(np.square(w).sum(axis=-1), cs.nees(e, C), rtol=1e-8)
    root = np.linalg.cholesky(C)
    assert np.allclose((root @ w[..., None])[..., 0], e, rtol=1e-8)


def test_whitening_leaves_out_what_has_no_root():
    C = np.array([np.eye(2), np.zeros((2, 2)), -np.eye(2), np.ones((2, 2)), np.full((2, 2), np.nan)])
    w = whiten(np.ones((5, 2)), C)
    assert np.isfinite(w).all(axis=-1).tolist() == [True, False, False, False, False]


def test_an_axis_of_no_variance_is_left_out_in_silence():
    with np.errstate(all="raise"):
        assert np.isnan(standardise(np.ones((1, 2)), np.diag([0.0, 4.0])[None])[0, 0])


@given(st.integers(1, 80), st.integers(1, 80), st.integers(0, 10**6))
def test_a_spread_step_is_one_that_the_run_has(runs, steps, seed):
    rows = np.arange(runs)[:, None]
    present = (np.arange(steps) + seed * rows) % steps < max(steps // 2, 1)  # as many in each run
    chosen = spread_steps(present)
    assert np.array_equal(chosen >= 0, present.any(axis=1))
    rows = np.flatnonzero(chosen >= 0)
    assert present[rows, chosen[rows]].all()


@pytest.mark.parametrize("runs", [10, 50, 1000])
def test_spread_steps_fill_the_trajectory_evenly(runs):
    """The golden-ratio sequence puts in every fifth its share of runs, give or take two."""
    counts = np.bincount(spread_steps(np.ones((runs, 100), bool)) // 20, minlength=5)
    assert np.abs(counts - runs / 5).max() <= 2


# --- scale ---------------------------------------------------------------------------------------------


def test_bonferroni_band_is_exact_in_each_step(fresh):
    nees = fresh.chisquare(3, (30, 20))
    nees[:4, 10:] = np.nan
    band = simultaneous_band(nees, 3, 0.04, "bonferroni")
    for k, runs in ((0, 30), (15, 26)):
        assert stats.chi2.sf(band.high[k] * runs, 3 * runs) == pytest.approx(0.04 / 40)
        assert stats.chi2.cdf(band.low[k] * runs, 3 * runs) == pytest.approx(0.04 / 40)
    one_sided = simultaneous_band(nees, 3, 0.04, "bonferroni", "conservative")
    assert stats.chi2.sf(one_sided.high[0] * 30, 90) == pytest.approx(0.04 / 20)
    assert (one_sided.low == 0).all()


@pytest.mark.parametrize("method", ["max", "bonferroni"])
@pytest.mark.parametrize("allow", [None, "conservative"])
def test_p_value_of_the_curve_is_where_it_would_leave_its_band(fresh, method, allow):
    nees = np.square(autoregression(fresh, 40, 30, 3, 0.9)).sum(axis=-1)
    p = simultaneous_band(nees, 3, 0.05, method, allow).p_value
    if p < 0.9:
        assert simultaneous_band(nees, 3, p * 1.001, method, allow).outside.any()
    if p > 1e-12:
        assert not simultaneous_band(nees, 3, min(p * 0.999, 0.99), method, allow).outside.any()


@pytest.mark.parametrize("zero", [0.0, 1e-15])
@pytest.mark.parametrize("decimals", [1, 2, 3])
@pytest.mark.parametrize("runs", [1, 2])
def test_errors_of_few_decimals_are_not_too_small(decimals, runs, zero):
    """False-alarm rate of all cases together: 12 times 20 draws at 1e-6."""
    zeros = 0
    for seed in range(20):
        errors = np.random.default_rng([decimals, runs, seed]).standard_normal((runs, 2000))
        nees = np.round(errors, decimals) ** 2
        zeros += (nees == 0).sum()
        nees[nees == 0] = zero
        band = simultaneous_band(nees, 1, 1e-6)
        assert not band.below.any()
        assert band.p_value > 1e-6
    assert zeros


@pytest.mark.parametrize("zero", [0.0, 1e-15])
@pytest.mark.parametrize("runs", [2, 20])
def test_a_start_that_is_known_in_all_runs_is_too_small(runs, zero):
    nees = np.random.default_rng(runs).chisquare(3, (runs, 200))
    nees[:, 0] = zero
    band = simultaneous_band(nees, 3, 1e-3)
    assert band.below.nonzero()[0].tolist() == [0]
    assert band.p_value < 1e-3


def test_errors_that_are_all_zero_are_too_small():
    assert simultaneous_band(np.zeros((5, 20)), 3, 1e-3).below.all()


# --- bias ----------------------------------------------------------------------------------------------

# Johnson & Wichern (2007) Table 5.1: sweat rate, sodium, potassium of 20 women; Example 5.3: T^2 = 9.74
SWEAT = np.array([
    [3.7, 48.5, 9.3], [5.7, 65.1, 8.0], [3.8, 47.2, 10.9], [3.2, 53.2, 12.0], [3.1, 55.5, 9.7], [4.6, 36.1, 7.9],
    [2.4, 24.8, 14.0], [7.2, 33.1, 7.6], [6.7, 47.4, 8.5], [5.4, 54.1, 11.3], [3.9, 36.9, 12.7], [4.5, 58.8, 12.3],
    [3.5, 27.8, 9.8], [4.5, 40.2, 8.4], [1.5, 13.5, 10.1], [8.5, 56.4, 7.1], [4.5, 71.6, 8.2], [6.5, 52.8, 10.9],
    [4.1, 44.1, 11.2], [5.5, 40.9, 9.4],
])  # fmt: skip


def test_hotelling_on_a_published_example():
    test = hotelling(SWEAT - [4.0, 50.0, 10.0])
    assert test.statistic == pytest.approx(9.74, abs=0.005)
    assert test.p_value == pytest.approx(0.065, abs=5e-4)
    assert test.mean == pytest.approx([0.640, -4.600, -0.035])


def test_hotelling_of_one_component_is_the_t_test(fresh):
    x = fresh.standard_normal((15, 1)) + 0.5
    t = stats.ttest_1samp(x[:, 0], 0.0)
    test = hotelling(x)
    assert test.statistic == pytest.approx(float(t.statistic) ** 2)
    assert test.p_value == pytest.approx(float(t.pvalue))
    assert test.interval[0] == pytest.approx(tuple(t.confidence_interval(0.95)))


def test_t_squared_of_each_step_is_that_of_the_runs_it_has(fresh):
    w = fresh.standard_normal((12, 4, 3))
    w[5:, 3], w[3:, 2] = np.nan, np.nan
    statistic, p = t_squared(w)
    for k, rows in ((0, 12), (3, 5)):
        x = w[:rows, k]
        by_hand = rows * x.mean(axis=0) @ np.linalg.inv(np.cov(x.T)) @ x.mean(axis=0)
        assert statistic[k] == pytest.approx(by_hand)
        assert p[k] == pytest.approx(stats.f.sf(by_hand * (rows - 3) / (3 * (rows - 1)), 3, rows - 3))
    assert np.isnan(p[2])


@pytest.mark.parametrize("sample", [np.ones((3, 3)), np.ones(5), np.full((9, 2), np.nan)])
def test_hotelling_refuses_what_it_cannot_judge(sample):
    with pytest.raises(ValueError, match="more finite rows"):
        hotelling(sample)


# --- shape ---------------------------------------------------------------------------------------------


def test_sphericity_of_two_components_is_exact(fresh):
    """W^((N - 2) / 2) is the p value where n = 2 (Anderson 2003, sec. 10.7.3)."""
    w = fresh.standard_normal((20, 50, 2))
    _, p = sphericity(w)
    for k in range(50):
        S = np.cov(w[:, k].T)
        assert p[k] == pytest.approx((4 * np.linalg.det(S) / np.trace(S) ** 2) ** 9, rel=0.01)


@pytest.mark.parametrize("n", [3, 6])
def test_sphericity_p_values_are_uniform(fresh, n):
    """20,000 steps of independent runs, at the fewest runs that are asked; 10 % to Box's expansion."""
    w = fresh.standard_normal((4 * n, 20_000, n))
    _, p = sphericity(w)
    for level in (0.05, 0.005):
        count = int((p <= level).sum())
        assert 0.9 * 20_000 * level - 5 * np.sqrt(20_000 * level) <= count
        assert count <= 1.1 * 20_000 * level + 5 * np.sqrt(20_000 * level)


def test_sphericity_does_not_trust_its_expansion_with_few_runs(fresh):
    """Below 4 n runs its far tail is up to twice too small, and the smallest of many steps lives there."""
    assert np.isnan(sphericity(fresh.standard_normal((11, 2, 3)))[1]).all()


def test_identity_statistic_is_chi_square(fresh):
    p = np.array([identity_statistic(fresh.standard_normal((30, 3)))[1] for _ in range(5000)])
    for level in (0.5, 0.05, 0.01):
        assert within(int((p <= level).sum()), 5000, level)
    assert identity_statistic(1.5 * fresh.standard_normal((200, 3)))[1] < 1e-5
    assert identity_statistic(np.zeros((5, 2))) == (float("inf"), 0.0)


def test_mean_shape_by_hand(fresh):
    w = fresh.standard_normal((30, 20, 3))
    w[np.arange(30), np.arange(30) % 20] = np.nan
    shape, p = mean_shape(w)
    M = np.array([np.einsum("ki,kj->ij", x, x) / len(x) for x in (r[np.isfinite(r).all(axis=1)] for r in w)])
    assert shape == pytest.approx(M.mean(axis=0) * 3 / np.trace(M.mean(axis=0)))
    assert p == pytest.approx(hotelling(M[:, [0, 0, 1], [1, 2, 2]]).p_value)
    assert np.isnan(mean_shape(w[:11])[1])


# --- tails ---------------------------------------------------------------------------------------------


def test_outliers_of_a_conservative_filter_are_outliers_for_the_stated_covariance(fresh):
    """P right in a fifth of the runs and 4 times too large in the others; one false alarm in 1,000."""
    w = fresh.standard_normal((50, 50, 3)) * np.where(np.arange(50) % 5 == 0, 1.0, 0.5)[:, None, None]
    covariance = np.broadcast_to(np.eye(3), (50, 50, 3, 3))
    settings = Settings(false_alarm=1e-3, allow="conservative")
    nees = float(np.square(w).sum(axis=-1).max())
    assert beyond_stated(w) == pytest.approx(min(1.0, 2500 * stats.chi2.sf(nees, 3)))
    verdict = judge_record(make_record("f", error=w, covariance=covariance), settings)
    (p,) = (answer.p_value for answer in verdict.answers if answer.question == "outliers")
    assert p == pytest.approx(max(outliers(w).p_value, beyond_stated(w)))
    assert "outliers" not in verdict.faults
    w[3, 7] = 12.0, 0.0, 0.0
    assert beyond_stated(w) == pytest.approx(2500 * stats.chi2.sf(144, 3))
    assert "outliers" in judge_record(make_record("f", error=w, covariance=covariance), settings).faults


def test_whiteness_needs_more_innovations_of_more_components(fresh):
    for m, fewest in ((1, 400), (10, 400), (30, 1200)):
        u, S = fresh.standard_normal((fewest // 20, 20, m)), np.eye(m)
        assert np.isfinite(whiteness(u, np.broadcast_to(S, (*u.shape, m))).p_value)
        assert np.isnan(whiteness(u[1:], np.broadcast_to(S, (*u[1:].shape, m))).p_value)


def test_outliers_by_hand(fresh):
    w = fresh.standard_normal((12, 7, 2))
    w[4, 3:] = np.nan
    found = outliers(w)
    p = {}
    for k in range(7):
        rows = np.flatnonzero(np.isfinite(w[:, k]).all(axis=1))
        x, N = w[rows, k], len(rows)
        for row, e in zip(rows, x - x.mean(axis=0), strict=True):
            d2 = e @ np.linalg.inv(np.cov(x.T)) @ e
            others = x[rows != row]
            gap = x[rows == row][0] - others.mean(axis=0)
            left_out = gap @ np.linalg.inv(np.cov(others.T)) @ gap
            p[stats.beta.sf(d2 * N / (N - 1) ** 2, 1, (N - 3) / 2)] = (int(row), k, np.sqrt(left_out))
    row, step, distance = p[min(p)]
    assert (found.run, found.step) == (row, step)
    assert found.distance == pytest.approx(distance)
    assert found.p_value == pytest.approx(min(1.0, min(p) * (12 * 3 + 11 * 4)))


def test_pit_is_the_exact_test_of_kolmogorov(fresh):
    nees = fresh.chisquare(3, (37, 11))
    chosen = spread_steps(np.ones((37, 11), bool))
    expected = stats.kstest(nees[np.arange(37), chosen], stats.chi2(3).cdf, method="exact")
    found = pit(nees, 3, 0.1)
    assert found.statistic == pytest.approx(expected.statistic)
    assert found.p_value == pytest.approx(expected.pvalue)
    assert stats.kstwo.sf(found.half_width, 37) == pytest.approx(0.1)
    assert np.isnan(pit(np.full((5, 5), np.nan), 3).p_value)


def test_coverage_interval_in_closed_form():
    """All or none within: ends at (alpha / 2)^(1 / N); else quantiles of Beta."""
    error = np.zeros((30, 1, 3))
    error[:, 0, 1], error[:9, 0, 2] = 5.0, 5.0
    share, interval = coverage_interval(error, identities(error), confidence=0.9)
    end = 0.05 ** (1 / 30)
    assert share.tolist() == [1.0, 0.0, 0.7]
    assert interval[0] == pytest.approx([end, 1.0])
    assert interval[1] == pytest.approx([0.0, 1.0 - end])
    assert interval[2] == pytest.approx([stats.beta.ppf(0.05, 21, 10), stats.beta.ppf(0.95, 22, 9)])


# --- innovations ---------------------------------------------------------------------------------------


def test_portmanteau_of_one_series_is_that_of_statsmodels(fresh):
    """Ljung-Box has N (N + 2) / (N - l) where the mean over pairs gives N^2 / (N - l)."""
    u = fresh.standard_normal(500)
    u -= u.mean()
    found = whiteness(u[None, :, None], np.ones((1, 500, 1, 1)))
    table = acorr_ljungbox(u, lags=10, boxpierce=True)
    assert found.dof == 10
    assert found.statistic == pytest.approx(table["lb_stat"].iloc[-1] * 500 / 502)
    assert table["bp_stat"].iloc[-1] < found.statistic < table["lb_stat"].iloc[-1]
    assert found.p_value == pytest.approx(stats.chi2.sf(found.statistic, 10))


def test_total_nis_by_hand():
    nis, dof = np.array([[3.0, np.nan, 8.0]]), np.array([[2, 0, 6]])
    test = nis_test(nis, dof)
    assert (test.ratio, test.dof) == (11.0 / 8.0, 8)
    assert test.above == pytest.approx(stats.chi2.sf(11.0, 8))
    assert test.p_value == pytest.approx(2 * stats.chi2.sf(11.0, 8))


# --- credibility ---------------------------------------------------------------------------------------


def test_noncredibility_by_hand(fresh):
    """10 / N sum |log10 rho|, rho the NEES with the stated over that with the actual error matrix."""
    error = fresh.standard_normal((9, 2, 2)) * [1.0, 4.0]
    C = np.diag([1.0, 9.0])
    index, inclination = noncredibility(error, cs.nees(error, np.broadcast_to(C, (9, 2, 2, 2))))
    for k in range(2):
        actual = sum(np.outer(e, e) for e in error[:, k]) / 9
        rho = [(e @ np.linalg.inv(C) @ e) / (e @ np.linalg.inv(actual) @ e) for e in error[:, k]]
        assert index[k] == pytest.approx(10 * np.mean(np.abs(np.log10(rho))))
        assert inclination[k] == pytest.approx(10 * np.mean(np.log10(rho)))


# --- whole verdicts: clean -----------------------------------------------------------------------------


def clean(rng, runs=RUNS, coefficient=0.9):
    """Errors as a filter makes them, their right covariance, white innovations of 2 components."""
    w = autoregression(rng, runs, STEPS, DOF, coefficient)
    return {"w": w, "u": rng.standard_normal((runs, STEPS, 2))}


def verdict_of(case, **options):
    w, u = case["w"], case["u"]
    runs, steps, _ = w.shape
    error = w @ np.linalg.cholesky(P).T * case.get("units", 1.0)
    return judge(
        "f", error, np.broadcast_to(P * case.get("units", 1.0) ** 2, (runs, steps, 3, 3)).copy(), optimal_gain=True,
        nis=np.square(u).sum(axis=-1), nis_dof=np.full((runs, steps), 2), innovations=u,
        innovation_covariances=identities(u), axes=AXES,
        **{"false_alarm": FALSE_ALARM, **options},
    )  # fmt: skip


@pytest.mark.parametrize("runs", [1, 2, 5, 9, 12, 20, 60])
@pytest.mark.parametrize("coefficient", [0.0, 0.9, 0.999])
def test_a_clean_filter_is_left_alone(fresh, runs, coefficient):
    """At 1e-6 each, 21 of them."""
    verdict = verdict_of(clean(fresh, runs, coefficient), false_alarm=1e-6)
    assert verdict.status in ("consistent", "undecided"), verdict.reasons
    assert verdict.faults == ()
    assert (verdict.first_step, verdict.subset, verdict.statistics["since"]) == (None, None, None)
    assert verdict.reasons[0].startswith(f"{verdict.status}: no fault found")
    assert 0.0 <= verdict.p_value <= 1.0
    if runs < 9:
        assert verdict.status == "undecided"
    elif runs == 60 and coefficient < 0.99:
        assert verdict.status == "consistent"


@pytest.mark.parametrize("units", [1e-18, 1e18])
def test_units_do_not_matter(fresh, units):
    case = clean(fresh)
    plain, scaled = verdict_of(case), verdict_of(case | {"units": units})
    assert scaled.status == plain.status == "consistent"
    for a, b in zip(plain.statistics["answers"], scaled.statistics["answers"], strict=True):
        assert a["p_value"] == pytest.approx(b["p_value"], rel=1e-6)


# --- whole verdicts: faults ----------------------------------------------------------------------------


def correlated(case, rng):
    """x and y go together by 0.5, which the covariance does not say; steps independent."""
    w = rng.standard_normal(case["w"].shape)
    w[..., 1] = 0.5 * w[..., 0] + np.sqrt(0.75) * w[..., 1]
    return case | {"w": w}


def heavy_tailed(case, rng):
    """Student's t with 5 degrees of freedom and the stated covariance."""
    runs = 400
    g = rng.standard_normal((runs, STEPS, DOF)) * np.sqrt(3.0 / rng.chisquare(5, (runs, STEPS, 1)))
    return {"w": g, "u": rng.standard_normal((runs, STEPS, 2))}


def wrong_for_a_moment(case, rng):
    """Step 18 has errors of chi-square's own quantiles: by chance their tails look heavy in 7 % of samples."""
    directions = rng.standard_normal((RUNS, DOF))
    quantiles = stats.chi2(DOF).ppf((np.arange(RUNS) + 0.5) / RUNS)
    case["w"][:, 17] = np.sqrt(3.0 * quantiles)[:, None] * directions / np.linalg.norm(directions, axis=1)[:, None]
    return case


def changed(where=..., factor=1.0, shift=0.0):
    """Errors of some runs, steps and axes times a factor, and with a shift."""

    def change(case, rng):
        case["w"][where] = factor * case["w"][where] + shift
        return case

    return change


def correlated_in_a_step(case, rng):
    case["w"][:, 30, 1] = 0.95 * case["w"][:, 30, 0] + np.sqrt(1 - 0.95**2) * case["w"][:, 30, 1]
    return case


OVER, UNDER, WRONG = ("overconfident",), ("conservative",), ("inconsistent",)
BIASED, HEAVY = ("biased",), ("heavy-tailed",)
FAULTS = {
    "too small": (changed(factor=np.sqrt(2.0)), "scale", OVER, "covariance too small by x"),
    "too large": (changed(factor=np.sqrt(0.4)), "scale", UNDER, "covariance too large by x"),
    "biased": (changed(shift=[1.2, 0.0, 0.0]), "bias", BIASED, "biased: mean error +1."),
    "biased in a step": (changed(np.s_[:, 9, 0], shift=2.0), "bias in some step", BIASED, " sigma in x, in step 10"),
    "correlated": (correlated, "shape", (*WRONG, *OVER, *UNDER), "correlation +0."),
    "correlated in a step": (
        correlated_in_a_step, "shape in some step", (*WRONG, *OVER, *UNDER), "covariance of the wrong shape",
    ),
    "heavy-tailed": (heavy_tailed, "outliers", HEAVY, "outlier in run "),
    "coloured innovations": (
        lambda case, rng: case | {"u": autoregression(rng, RUNS, STEPS, 2, 0.3)},
        "innovation whiteness", WRONG, "innovations correlated over steps",
    ),
    "large innovations": (
        lambda case, rng: case | {"u": case["u"] * np.sqrt(1.5)},
        "innovation scale", WRONG, "innovations larger than stated",
    ),
    "wrong half way": (changed(np.s_[:, 20:], np.sqrt(3.0)), "scale in some step", OVER, "] since step 21"),
    "wrong for a moment": (wrong_for_a_moment, "scale in some step", OVER, " in step 18"),
    "one run lost": (changed(np.s_[7, 25:], shift=[30.0, 0.0, 0.0]), "outliers", HEAVY, " in run 7, step "),
    "one axis": (changed(np.s_[..., 2], 2.0), "scale of an axis", OVER, "heading"),
    "axes that cancel": (  # the NEES is right in the mean
        changed(factor=np.sqrt([0.25, 0.25, 2.5])), "scale of an axis", (*WRONG, *OVER, *UNDER), "covariance ",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_found_and_named(name, fresh):
    """Judged at a false-alarm rate of 1e-5; missed with less than 1e-5."""
    fault, question, statuses, words = FAULTS[name]
    verdict = verdict_of(fault(clean(fresh), fresh))
    assert question in verdict.faults, verdict.reasons
    assert verdict.status in statuses
    assert words in verdict.reasons[0]


def test_the_distribution_is_judged_where_its_mean_is_right(fresh):
    """NEES that hardly spreads around 3."""
    verdict = judge("f", nees=3.0 + 0.1 * fresh.standard_normal((RUNS, STEPS)), dof=3, false_alarm=FALSE_ALARM)
    assert verdict.faults == ("distribution",)
    assert verdict.status == "inconsistent"
    assert "does not follow the chi-square" in verdict.reasons[0]


def test_where_when_and_how_much(fresh):
    """From step 21 on the covariance of the heading is 6 times too small."""
    case = clean(fresh)
    case["w"][:, 20:, 2] *= np.sqrt(6.0)
    verdict = verdict_of(case)
    assert verdict.status == "overconfident"
    assert (verdict.first_step, verdict.statistics["since"], verdict.subset) == (21, 21, "heading")
    low, high = verdict.inflation_interval
    assert low < (1 + 1 + 6) / 3 * 1.6
    assert high > (1 + 1 + 6) / 3 / 1.6
    assert "; heading too small by x" in verdict.reasons[0]
    assert "no bias found" in verdict.reasons[0]


def test_a_step_found_only_by_what_holm_leaves_is_still_named(fresh):
    """A wrong shape is found and frees its share: with that a step is found which its own share would not do for.

    The NEES of a step grows until it is found; there the side and the step must be named, whatever found them.
    """
    q = stats.chi2.ppf((np.arange(1, 31) - 0.5) / 30, 3)
    nees = np.array([fresh.permutation(q) for _ in range(10)]).T
    signs = fresh.choice([-1.0, 1.0], nees.shape)
    for factor in np.linspace(1.0, 3.0, 101):
        w = np.zeros((30, 10, 3))
        w[..., 0] = np.sqrt(nees) * signs  # all on one axis
        w[:, 4, 0] *= np.sqrt(factor)
        w += 1e-3 * fresh.standard_normal(w.shape)
        verdict = judge("f", w, identities(w))
        if "scale in some step" in verdict.faults:
            break
    assert "scale in some step" in verdict.faults
    assert verdict.first_step == 5
    assert verdict.statistics["steps_above"] == 1
    assert "in step None" not in verdict.reasons[0]


# --- degenerate input ------------------------------------------------------------------------------------


@pytest.mark.parametrize("runs", [1, 2, 3, 4, 9, 10])
@pytest.mark.parametrize("steps", [1, 10])
@pytest.mark.parametrize("n", [1, 3, 9])
def test_any_shape_is_judged(fresh, runs, steps, n):
    """36 shapes at 1e-7 each; a warning would be an error. Ten runs show no ratio of 1.5, unless steps are many."""
    e = fresh.standard_normal((runs, steps, n))
    for options in ({}, {"allow": "conservative"}, {"method": "bonferroni"}):
        verdict = judge("f", e, identities(e), false_alarm=1e-7, **options)
        assert verdict.status in ("consistent", "undecided"), verdict.reasons
        assert verdict.p_value <= 1.0


@pytest.mark.parametrize("runs", [5, 20])
def test_no_error_at_all_is_conservative(runs):
    e = np.zeros((runs, 30, 3))
    assert judge("f", e, identities(e)).status == "conservative"
    assert judge("f", nees=np.zeros((runs, 30)), dof=3).status == "conservative"


def test_one_and_the_same_error_is_not_consistent():
    e = np.ones((20, 30, 3))
    assert judge("f", e, identities(e)).status != "consistent"
    assert judge("f", nees=np.full((20, 30), 3.0), dof=3).status != "consistent"


def test_a_perfect_axis_is_judged(fresh):
    e = fresh.standard_normal((30, 30, 3))
    e[..., 2] = 0.0
    verdict = judge("f", e, identities(e), axes=AXES)
    assert not verdict.consistent
    assert "scale of an axis" in verdict.faults


@pytest.mark.parametrize("ratio", [1e-36, 1e36])
def test_a_covariance_out_of_all_proportion(fresh, ratio):
    e = fresh.standard_normal((20, 30, 3))
    verdict = judge("f", e, identities(e) / ratio)
    assert verdict.status == ("overconfident" if ratio > 1 else "conservative")
    assert max(len(number) for number in re.findall(r"[\d.e+-]+", verdict.reasons[0])) <= len("+1.0e+18")


@pytest.mark.parametrize("what", ["error", "covariance", "nees"])
def test_nothing_but_nan_is_failed(fresh, what):
    e = fresh.standard_normal((20, 30, 3))
    arrays = {"error": e, "covariance": identities(e), "nees": np.square(e).sum(axis=-1)}
    arrays[what] = np.full_like(arrays[what], np.nan)
    verdict = judge("f", **arrays)
    assert verdict.status == "failed"
    assert "no step has a covariance of full rank" in verdict.reasons[0]
