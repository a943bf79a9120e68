"""The test of run means, equivalence and plans against computations of their own, such as a likelihood maximised.

Everything random has a fixed seed that was not chosen, and no assertion here depends on luck but the counts, which have
limits at 1e-5.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
from draws import autoregression
from records import changed
from scipy import optimize, special, stats

from consistency.diagnostics import (
    Settings,
    e_process,
    ever,
    gate_runs,
    judge,
    make_record,
    mean_test,
    pilot_plan,
    power_of,
    ratio_interval,
    required_runs,
)
from consistency.referee.diagnostics.scale import (
    acceptance,
    equivalence,
    equivalence_by_betting,
    equivalence_of_total,
    run_means,
    scale_test,
)

SURE = 1e-5


# --- an oracle ---------------------------------------------------------------------------------------


def log_nu_of_spread(means):
    """log(2 / CV^2), nothing corrected."""
    return float(np.log(2.0 * means.mean() ** 2 / means.var(ddof=1)))


def covariance_of_left_out(a, b):
    """(N - 1) / N times the sum of products of differences from the mean, Efron & Stein (1981)."""
    N = len(a)
    return (N - 1) ** 2 / N * float(np.cov(a, b, ddof=1)[0, 1])


def doubt(means):
    """Variance of log nu by the jackknife, which is at least 2 / N."""
    left_out = [log_nu_of_spread(np.delete(means, i)) for i in range(len(means))]
    return max(covariance_of_left_out(left_out, left_out), 2.0 / len(means))


def gamma_shape(means):
    """log of the most likely shape and its standard error, from the curvature of the likelihood by differences."""

    def minus_log_likelihood(log_a):
        a = float(np.exp(log_a))
        return -float(stats.gamma.logpdf(means, a, scale=means.mean() / a).sum())

    best = optimize.minimize_scalar(
        minus_log_likelihood, bounds=(-8.0, 14.0), method="bounded", options={"xatol": 1e-10}
    )
    h = 1e-3
    curve = [minus_log_likelihood(best.x + d) for d in (-h, 0.0, h)]
    return float(best.x), float(1.0 / np.sqrt((curve[0] - 2.0 * curve[1] + curve[2]) / h**2))


class Oracle(NamedTuple):
    nu: float
    spread: float
    by_spread: float = 0.0  # log nu, one standard error to the safe side, at a mean of 1
    by_likelihood: float = 0.0


def at_most_skewness(log_nu, mean, dof):
    """log(2 / v) with log v = log observed + change / v, by bisection; change is 0.4 of 4 / dof a unit of the mean."""
    change, observed = 1.6 / dof * (1.0 - mean), 2.0 * mean**2 * np.exp(-log_nu)
    if dof == 1 or change <= 0.0:
        return log_nu
    v = optimize.brentq(lambda v: np.log(v / observed) - change / v, observed, observed + change + 1.0, xtol=1e-14)
    return float(min(log_nu, np.log(2.0 / v)))


def oracle(means, dof, steps, gaussian=True):
    N = len(means)
    without = [np.delete(means, i) for i in range(N)]
    left_out, log_mean = [log_nu_of_spread(m) for m in without], [float(np.log(m.mean())) for m in without]
    of_mean, both = covariance_of_left_out(log_mean, log_mean), covariance_of_left_out(left_out, log_mean)
    slope, reach = both / of_mean, 4.0 * np.sqrt(of_mean)
    shift = -slope * min(max(float(np.log(means.mean())), -reach), reach)
    variance = max(covariance_of_left_out(left_out, left_out) - slope * both, 2.0 / N)
    cv2 = means.var(ddof=1) / means.mean() ** 2
    at_one = log_nu_of_spread(means) - np.log1p(cv2 / N) + min(shift, 0.0)
    by_spread = at_most_skewness(at_one, float(means.mean()), dof) - np.sqrt(variance)
    log_a, error = gamma_shape(means)
    by_likelihood = np.log(2.0) + log_a - error
    nu = min(np.exp(min(by_spread, by_likelihood)), dof * steps)
    nu, spread = (dof, np.inf) if gaussian and nu <= dof else (nu, 2.0 / variance)
    return Oracle(nu, spread, by_spread, by_likelihood)


def tails(ratio, k, spread):
    """p values above and below, with a normal quantile read as Student's t."""
    above = stats.t.sf(stats.norm.isf(stats.chi2.sf(k * ratio, k)), spread)
    return float(above), float(stats.t.cdf(stats.norm.ppf(stats.chi2.cdf(k * ratio, k)), spread))


def gamma_means(rng, runs, nu=3.0, ratio=1.0):
    return ratio * rng.chisquare(nu, runs) / nu


def cases():
    """Run means of many kinds: (runs,), dof, steps."""
    rng = np.random.default_rng(1)
    found = {
        "gamma": (gamma_means(rng, 40, 9.0), 3, 50),
        "few, near 1": (gamma_means(rng, 20, 30.0), 3, 50),
        "too large": (gamma_means(rng, 60, 12.0, 1.3), 3, 50),
        "far too large": (gamma_means(rng, 60, 12.0, 30.0), 3, 50),
        "few, too large": (gamma_means(rng, 25, 12.0, 4.0), 3, 50),
        "too small": (gamma_means(rng, 60, 12.0, 0.75), 3, 50),
        "far too small": (gamma_means(rng, 45, 8.0, 0.01), 3, 50),
        "fully dependent": (gamma_means(rng, 50, 3.0), 3, 50),
        "more even than independent steps": (1.0 + 0.01 * rng.standard_normal(30), 2, 4),
        "two kinds of runs": (np.concatenate([gamma_means(rng, 30, 2.0), gamma_means(rng, 30, 200.0)]), 1, 100),
        "log-normal": (np.exp(0.5 * rng.standard_normal(80)), 1, 100),
        "heavy": (np.exp(1.5 * rng.standard_normal(80)), 2, 100),
        "one step": (gamma_means(rng, 30, 2.0), 2, 1),
        "small values": (np.concatenate([gamma_means(rng, 40, 40.0), [0.002, 0.01]]), 1, 100),
        "uniform": (rng.uniform(0.2, 1.8, 70), 1, 100),
        "one degree, too small": (gamma_means(rng, 40, 30.0, 0.8), 1, 2000),
    }
    return found


CASES = cases()


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("gaussian", [True, False])
def test_effective_dof_and_p_values(name, gaussian):
    means, dof, steps = CASES[name]
    test, expected = scale_test(means, dof, steps, gaussian), oracle(means, dof, steps, gaussian)
    if steps == 1 and gaussian:
        expected = Oracle(dof, np.inf)
    assert test.runs == len(means)
    assert test.ratio == pytest.approx(means.mean(), rel=1e-12)
    assert test.effective_dof == pytest.approx(expected.nu, rel=2e-6)
    assert test.spread == pytest.approx(expected.spread, rel=1e-8)
    above, below = tails(means.mean(), len(means) * test.effective_dof, test.spread)
    assert test.above == pytest.approx(above, rel=1e-6, abs=1e-300)
    assert test.below == pytest.approx(below, rel=1e-6, abs=1e-300)
    assert test.p_value == pytest.approx(min(1.0, 2.0 * min(above, below)), rel=1e-6)


@pytest.mark.parametrize("runs", [1, 2, 19])
def test_below_twenty_runs_the_worst_case_is_taken(runs):
    """Chi-square of one step, exactly; the spread between the runs plays no part."""
    means = 1.2 + 1e-3 * np.arange(runs)
    test = scale_test(means, 3, 100)
    assert (test.effective_dof, test.spread) == (3.0, np.inf)
    assert test.above == pytest.approx(stats.chi2.sf(3 * means.sum(), 3 * runs), rel=1e-10)
    assert test.below == pytest.approx(stats.chi2.cdf(3 * means.sum(), 3 * runs), rel=1e-10)
    assert scale_test(1.2 + 1e-3 * np.arange(20), 3, 100).effective_dof > 100


def test_a_run_without_any_error_leaves_the_worst_case():
    means = np.append(np.full(40, 1.1) + 0.01 * np.arange(40), 0.0)
    assert scale_test(means, 2, 100).effective_dof == 2.0


def test_effective_dof_of_known_worlds():
    """(tr C)^2 / tr C^2, from below: C_kl = .9^|k - l| in each of 3 components; 2,000 runs."""
    rng = np.random.default_rng(5)
    T, n = 60, 3
    C = 0.9 ** np.abs(np.subtract.outer(np.arange(T), np.arange(T)))
    exact = n * T**2 / np.square(C).sum()
    nees = np.square(autoregression(rng, 2000, T, n, 0.9)).sum(axis=-1)
    assert 0.8 * exact < mean_test(nees, n).effective_dof < exact * 1.05


def test_nothing_to_judge():
    test = scale_test(np.empty(0), 3, 0)
    assert test.runs == 0
    assert np.isnan([test.ratio, test.above, test.below, test.p_value]).all()
    assert np.isnan(acceptance(test, 3, 0.05)).all()


def test_run_means_count_the_steps_that_a_run_has():
    nees = np.array([[1.0, 2.0, 6.0], [np.nan, 4.0, np.nan], [np.nan] * 3])
    means, counts = run_means(nees)
    assert means[:2] == pytest.approx([3.0, 4.0])
    assert np.isnan(means[2])
    assert counts.tolist() == [3, 1, 0]
    test = mean_test(nees, 2)
    assert (test.runs, test.ratio) == (2, pytest.approx(1.75))


def test_ragged_runs_count_the_steps_of_the_longest():
    """nu is at most dof times the steps of the longest run."""
    nees = np.full((30, 8), np.nan)
    for run in range(30):
        nees[run, : 2 + run % 3] = 2.0 + 1e-4 * run
    assert mean_test(nees, 2).effective_dof == pytest.approx(2 * 4)


# --- what is accepted ----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["gamma", "too large", "fully dependent", "two kinds of runs"])
@pytest.mark.parametrize("allow", [None, "conservative"])
def test_accepted_interval_is_where_the_p_value_crosses(name, allow):
    means, dof, steps = CASES[name]
    test = scale_test(means, dof, steps)
    low, high = acceptance(test, dof, 0.04, allow)
    k = len(means) * test.effective_dof
    assert tails(high / dof, k, test.spread)[0] == pytest.approx(0.04 if allow else 0.02, rel=1e-6)
    if allow:
        assert low == 0.0
    else:
        assert tails(low / dof, k, test.spread)[1] == pytest.approx(0.02, rel=1e-6)
    assert (low <= test.ratio * dof <= high) == ((test.above if allow else test.p_value) > 0.04)


# --- the interval of the ratio ----------------------------------------------------------------------------


@pytest.mark.parametrize("confidence", [0.95, 0.99])
def test_ratio_interval_from_twenty_runs_on(confidence):
    """Chi-square with nu from the spread as it is; what doubt remains, by the jackknife, in Student's t."""
    rng = np.random.default_rng(7)
    means = gamma_means(rng, 30, 6.0, 1.8)
    N = len(means)
    nu = np.exp(log_nu_of_spread(means)) / (1.0 + means.var(ddof=1) / means.mean() ** 2 / N)
    tail = stats.norm.sf(stats.t.isf((1 - confidence) / 2, 2.0 / doubt(means)))
    value, low, high = ratio_interval(means, 3, confidence)
    assert value == pytest.approx(means.mean())
    assert low == pytest.approx(value * N * nu / stats.chi2.isf(tail, N * nu), rel=1e-6)
    assert high == pytest.approx(value * N * nu / stats.chi2.ppf(tail, N * nu), rel=1e-6)


@pytest.mark.parametrize("size", [0.5, 1.0, 3.0])
def test_upper_end_is_by_the_spread_of_means_whose_ratio_it_is(size):
    """High enough that the test of Y / high, without its standard errors, just finds it; the same in any unit."""
    means = size * gamma_means(np.random.default_rng(3), 40, 60.0)
    N, (value, _, high) = 40, ratio_interval(means, 3)
    tail = stats.norm.sf(stats.t.isf(0.025, 2.0 / doubt(means)))
    log_nu = log_nu_of_spread(means) - np.log1p(means.var(ddof=1) / value**2 / N)
    k = N * max(3.0, np.exp(at_most_skewness(log_nu, value / high, 3)))
    assert high == pytest.approx(value * k / stats.chi2.ppf(tail, k), rel=2e-3)
    assert k < 0.9 * N * np.exp(log_nu)


def test_a_constant_axis_in_some_runs_keeps_the_rate():
    """4,000 draws at 5 %: half of the runs have one axis that does not change; without the bound 9 % of 21 runs err."""
    rng, draws, level = np.random.default_rng(4), 4000, 0.05
    constant = rng.random((draws, 21)) < 0.5
    means = 1.0 + constant * (rng.chisquare(1, constant.shape) - 1.0) / 6 + 0.004 * rng.standard_normal(constant.shape)
    count = sum(scale_test(y, 6, 2000).below <= level / 2 for y in means)
    assert count <= stats.binom.isf(SURE, draws, level / 2)


def test_ratio_interval_of_few_runs():
    """As if all steps were one, or by the spread that is seen if that is larger."""
    for means, dof in (
        (np.array([1.0, 1.1, 0.9, 1.05]), 3),
        (np.array([0.02, 5.0, 0.01, 0.1]), 3),
        (np.array([2.0]), 2),
    ):
        nu = float(dof)
        if len(means) > 1:
            cv2 = means.var(ddof=1) / means.mean() ** 2
            nu = min(nu, 2.0 / cv2 / (1.0 + cv2 / len(means)))
        k = len(means) * nu
        value, low, high = ratio_interval(means, dof)
        assert low == pytest.approx(value * k / stats.chi2.isf(0.025, k), rel=1e-6)
        assert high == pytest.approx(value * k / stats.chi2.ppf(0.025, k), rel=1e-6)
    assert ratio_interval(np.array([1.0, 1.1, 0.9, 1.05]), 6)[2] < ratio_interval(np.array([1.0, 1.1, 0.9, 1.05]), 1)[2]


def test_ratio_interval_where_there_is_nothing_to_spread():
    assert np.isnan(ratio_interval(np.empty(0))).all()
    assert ratio_interval(np.zeros(5)) == (0.0, 0.0, 0.0)
    assert ratio_interval(np.full(30, 1.5)) == pytest.approx((1.5, 1.5, 1.5))
    value, low, high = ratio_interval(np.full(5, 1.5), 2)
    assert low < 1.0 < value < 2.0 < high


# --- large and small numbers -------------------------------------------------------------------------------


def test_hardly_any_spread():
    """Runs that are all alike: nu is at its upper end, and nothing divides by zero."""
    for means in (np.full(25, 1.01), 1.0 + 1e-9 * np.arange(25)):
        assert scale_test(means, 3, 40).effective_dof == pytest.approx(120.0)


def test_digamma_equation_holds():
    """The shape solves log a - digamma(a) = log mean Y - mean log Y, from tiny shapes to huge ones."""
    rng = np.random.default_rng(9)
    for shape in (0.05, 0.5, 5.0, 500.0, 5e5):
        means = rng.gamma(shape, 1.0 / shape, 400).clip(1e-300)
        gap = np.log(means.mean()) - np.log(means).mean()
        a = optimize.brentq(lambda x, gap=gap: np.log(x) - special.psi(x) - gap, 1e-4, 1e9)
        error = (
            1.0 / np.sqrt(len(means) * (a * a * special.polygamma(1, a) - a)) if a < 1e6 else np.sqrt(2 / len(means))
        )
        test = scale_test(means, 1, 10**9, gaussian=False)
        assert test.effective_dof <= 2.0 * a * np.exp(-error) * (1 + 1e-6)
        if oracle(means, 1, 10**9, gaussian=False).by_likelihood < oracle(means, 1, 10**9, False).by_spread:
            assert test.effective_dof == pytest.approx(2.0 * a * np.exp(-error), rel=1e-5)


@pytest.mark.parametrize("size", [1e-300, 1e-170, 1e170, 1e300])
def test_means_of_any_size_have_an_interval(size):
    one, all_ = np.ones(30), np.full(30, size)
    one[3] = size
    for means in (one, all_):
        found = ratio_interval(means, 3)
        assert found.low <= found.value <= found.high
    assert ratio_interval(all_, 3).low == pytest.approx(size * ratio_interval(np.ones(30), 3).low)


# --- two one-sided tests --------------------------------------------------------------------------------


@pytest.mark.parametrize("detect", [1.5, 2.0, 0.5, 1.25])
@pytest.mark.parametrize("ratio", [0.6, 1.0, 1.4])
def test_by_hand_below_twenty_runs(detect, ratio):
    """Chi-square of N n degrees of freedom at both ends of the interval."""
    n, means = 3, gamma_means(np.random.default_rng(21), 19, ratio=ratio)
    k, total, d = 19 * n, n * means.sum(), max(detect, 1 / detect)
    too_large, too_small = stats.chi2.cdf(total / d, k), stats.chi2.sf(total * d, k)
    both = equivalence(means, n, 50, Settings(detect=detect))
    assert both.p_value == pytest.approx(max(too_large, too_small), rel=1e-9)
    assert both.factor == pytest.approx(d)
    assert both.level == pytest.approx(0.05)
    one = equivalence(means, n, 50, Settings(detect=detect, allow="conservative"))
    assert one.p_value == pytest.approx(too_large, rel=1e-9)


@pytest.mark.parametrize("allow", [None, "conservative"])
@pytest.mark.parametrize("ratio", [0.72, 1.0, 1.35])
def test_by_the_test_of_means_from_twenty_runs_on(ratio, allow):
    means = gamma_means(np.random.default_rng(22), 40, 8.0, ratio)
    result = equivalence(means, 2, 50, Settings(detect=1.4, allow=allow))
    below, above = scale_test(means / 1.4, 2, 50).below, scale_test(means * 1.4, 2, 50).above
    assert result.p_value == pytest.approx(below if allow else max(below, above))
    assert below != pytest.approx(above, rel=0.01)


def test_level_is_one_less_the_power():
    means = np.full(19, 1.0) + 1e-9
    for power in (0.8, 0.95, 0.999):
        result = equivalence(means, 3, 50, Settings(power=power))
        assert result.level == pytest.approx(1 - power)
        assert result.shown == (result.p_value <= 1 - power)
    at_stake = equivalence(means, 3, 50, Settings()).p_value
    assert equivalence(means, 3, 50, Settings(power=1 - 1.01 * at_stake)).shown
    assert not equivalence(means, 3, 50, Settings(power=1 - 0.99 * at_stake)).shown


def test_a_mean_of_unlike_runs_at_the_end_is_seldom_called_equivalent():
    """A tenth of the runs x6, the others right, one error in all steps: 300 draws of 102 runs at 5 %."""
    rng = np.random.default_rng(29)
    draws = rng.chisquare(6, (300, 102)) / 6 * np.where(rng.random((300, 102)) < 0.1, 6.0, 1.0)
    shown = sum(equivalence(means, 6, 50, Settings()).shown for means in draws)
    assert shown <= stats.binom.isf(SURE, 300, 0.05)
    low = rng.chisquare(6, (300, 102)) / 6 * np.exp(rng.standard_normal((300, 102)) - 0.5) / 1.5
    assert sum(equivalence(means, 6, 50, Settings()).shown for means in low) <= stats.binom.isf(SURE, 300, 0.05)


def test_nothing_is_shown_of_nothing():
    result = equivalence(np.empty(0), 3, 0, Settings())
    assert np.isnan(result.p_value)
    assert not result.shown
    assert result.runs is None


# --- runs that would decide ----------------------------------------------------------------------------


def test_runs_that_would_decide_by_hand():
    """2 / nu ((z + z') / distance)^2, to the nearer of 'shown' and 'at fault'."""
    z = stats.norm.ppf
    means = gamma_means(np.random.default_rng(27), 40)
    for ratio, allow, expected in (
        (1.0, None, 2 / 3 * (2 * z(0.9) / np.log(1.5)) ** 2),
        (1.2, None, 2 / 3 * (2 * z(0.9) / np.log(1.5 / 1.2)) ** 2),
        (1.4, None, 2 / 3 * ((z(0.9) + z(1 - 0.02 / 4)) / np.log(1.4)) ** 2),
        (1.4, "conservative", 2 / 3 * ((z(0.9) + z(1 - 0.02 / 2)) / np.log(1.4)) ** 2),
        (0.7, None, 2 / 3 * ((z(0.9) + z(1 - 0.02 / 4)) / np.log(1 / 0.7)) ** 2),
    ):
        settings = Settings(false_alarm=0.02, power=0.9, allow=allow)
        nu = scale_test(means / means.mean() * ratio, 3, 1, gaussian=False).effective_dof
        result = equivalence(means / means.mean() * ratio, 3, 1, settings)
        assert result.runs == max(int(np.ceil(3 / nu * expected)), 20)


def test_few_runs_are_taken_for_right():
    """19 runs do not know their ratio; what would decide is worked out at 1 and the worst case."""
    z = stats.norm.ppf
    result = equivalence(np.full(19, 3.0), 2, 50, Settings())
    assert result.runs == int(np.ceil((2 * z(0.95) / np.log(1.5)) ** 2))


def test_no_advice_where_there_is_none():
    assert equivalence(np.zeros(30), 3, 1, Settings()).runs is None
    near = equivalence(np.full(5, 1.0), 1, 1, Settings(detect=1.0001))
    assert near.runs is None


def test_what_may_be_conservative_is_far_from_the_end():
    """One-sided, a ratio of .7 is farther from 1.5 than one of 1; it is no fault, and takes fewer runs to show."""
    z, means = stats.norm.ppf, gamma_means(np.random.default_rng(28), 40)
    nu = scale_test(0.7 * means / means.mean(), 3, 1, gaussian=False).effective_dof
    result = equivalence(0.7 * means / means.mean(), 3, 1, Settings(allow="conservative", power=0.999))
    assert result.runs == int(np.ceil(2 / nu * (2 * z(0.999) / np.log(1.5 / 0.7)) ** 2))


# --- by betting, and of innovations -----------------------------------------------------------------------


@pytest.mark.parametrize("ratio", [0.85, 1.1])
@pytest.mark.parametrize("allow", [None, "conservative"])
def test_by_betting(allow, ratio):
    """The e-process of Y / d against 'none is too large', that of Y d against 'none is too small'."""
    means, d = gamma_means(np.random.default_rng(29), 60, 20.0, ratio), 1.6
    result = equivalence_by_betting(means, 3, Settings(detect=d, allow=allow))
    too_large, too_small = ever(e_process(means / d, 3).down), ever(e_process(means * d, 3).up)
    assert (too_large < too_small) == (ratio < 1)
    assert result.p_value == pytest.approx(too_large if allow else max(too_large, too_small))
    assert (result.factor, result.level, result.runs) == (d, pytest.approx(0.05), None)
    low, high = result.interval
    assert ever(e_process(means / low, 3).up) == pytest.approx(0.05, rel=1e-3)
    assert ever(e_process(means / high, 3).down) == pytest.approx(0.05, rel=1e-3)
    assert low < ratio < high


def test_of_innovations():
    rng = np.random.default_rng(31)
    d, total = 1.2, float((1.05 * rng.chisquare(2, (10, 20))).sum())
    expected = stats.chi2.cdf(total / d, 400), stats.chi2.sf(total * d, 400)
    both = equivalence_of_total(total, 400, Settings(), d)
    assert both.p_value == pytest.approx(max(expected), rel=1e-9)
    one = equivalence_of_total(total, 400, Settings(allow="conservative", power=0.9), d)
    assert one.p_value == pytest.approx(expected[0], rel=1e-9)
    assert one.level == pytest.approx(0.1)
    assert both.interval == pytest.approx(total / stats.chi2.ppf([0.95, 0.05], 400), rel=1e-4)
    nothing = equivalence_of_total(float("nan"), 0, Settings(), d)
    assert np.isnan(nothing.p_value)
    assert nothing.interval is None
    assert not nothing.shown


# --- in a verdict ---------------------------------------------------------------------------------------


def test_innovations_of_nearly_the_stated_size_are_tolerated():
    """4 % too small in 40,000 innovations is found, shown to lie within 1.1 and not within 1.02; no chance in it."""
    nis = 1.04 * stats.chi2.ppf((np.random.default_rng(0).permutation(40_000) + 0.5) / 40_000, 2).reshape(400, 100)
    evidence = make_record("f", nis=nis, nis_dof=np.full(nis.shape, 2), optimal_gain=True)
    assert judge(evidence).status == "overconfident"
    verdict = judge(evidence, Settings(tolerance=1.1))
    assert (verdict.status, verdict.faults) == ("consistent", ())
    assert [a.question for a in verdict.answers if a.tolerated] == ["innovation scale"]
    assert judge(evidence, Settings(tolerance=1.02)).status == "overconfident"
    assert not judge(changed(evidence, optimal_gain=False), Settings(tolerance=1.1)).answers


# --- runs that a verdict takes, from a few runs ---------------------------------------------------------------


def pilot(runs=40, nu=20.0, seed=91):
    return gamma_means(np.random.default_rng(seed), runs, nu)


def chi_square_power(k, ratio, tail):
    """Of a test of ratio times chi-square(k), at the side of ``ratio``."""
    if ratio > 1:
        return float(stats.chi2.sf(stats.chi2.ppf(1 - tail, k) / ratio, k))
    return float(stats.chi2.cdf(stats.chi2.ppf(tail, k) / ratio, k))


@pytest.mark.parametrize(
    "detect, allow", [(1.2, None), (1.5, None), (0.67, None), (1.2, "conservative"), (1.5, "conservative")]
)
def test_by_hand(detect, allow):
    """The least N with the power, at half of the rate and the pilot's nu, times 1.15 and rounded up."""
    means, dof, false_alarm, power = pilot(), 3, 0.04, 0.9
    test = scale_test(means / means.mean(), dof, 60)
    tail = 0.02 if allow else 0.01
    runs = 1
    while chi_square_power(runs * test.effective_dof, detect, tail) < power:
        runs += 1
    plan = pilot_plan(means, dof, 60, detect, false_alarm, power, allow)
    assert plan.runs == max(30, int(np.ceil(1.15 * runs)))
    assert plan.pilot_runs == 40
    assert plan.effective_dof == pytest.approx(test.effective_dof)
    assert plan.standard_error == pytest.approx(np.sqrt(2.0 / test.spread))
    assert 0.0 < plan.standard_error < 1.0
    assert plan.effective_dof > dof


def test_never_more_than_without_a_pilot():
    """A pilot whose runs spread as one step does: the plan of the worst case, and no margin on it."""
    means = pilot(30, 3.0, 92)
    plan = pilot_plan(means, 3, 60, 1.5)
    assert plan.effective_dof == 3.0
    assert plan.standard_error == 0.0
    assert plan.runs == gate_runs(3, 1.5)
    assert pilot_plan(means, 3, 60, 1.5, allow="conservative").runs == gate_runs(3, 1.5, allow="conservative")
    assert gate_runs(3, 1.5, allow="conservative") < gate_runs(3, 1.5)


def test_the_scale_of_the_pilot_does_not_matter():
    """Many pilots: one that is overconfident by 4 is planned for as a right one is."""
    for seed in range(20):
        means = pilot(seed=seed)
        plans = {c: pilot_plan(c * means, 3, 60, 1.2).runs for c in (0.25, 1.0, 4.0)}
        assert len(set(plans.values())) == 1


@pytest.mark.parametrize(
    "options, message",
    [
        ({"means": np.ones(19)}, "a pilot needs at least 20 runs, got 19"),
        ({"detect": 1.0}, "ratio must be positive and not 1"),
        ({"detect": -2.0}, "ratio must be positive"),
        ({"detect": np.inf}, "ratio must be positive"),
        ({"detect": 1.000001}, "more than"),
        ({"false_alarm": 0.0}, "false_alarm must lie between"),
        ({"power": 1.0}, "power must lie between"),
        ({"dof": 0}, "dof must be at least 1"),
    ],
)
def test_what_cannot_be_planned_is_refused(options, message):
    with pytest.raises(ValueError, match=message):
        pilot_plan(**{"means": pilot(), "dof": 3, "steps": 60, "detect": 1.5, **options})


def test_power_of_fractional_degrees_of_freedom():
    """nu is no whole number; between its neighbours."""
    low, middle, high = (power_of(nu, 50, 1.2, 0.05) for nu in (7.0, 7.5, 8.0))
    assert low < middle < high
    assert required_runs(8.0, 1.2) < required_runs(7.5, 1.2) < required_runs(7.0, 1.2)
    assert middle == pytest.approx(chi_square_power(50 * 7.5, 1.2, 0.025))
