"""Whiteness of the NIS, band with gaps, shape of many components: each against values worked out in another way.

What is drawn at random is compared with the same numbers worked out by hand, except where a docstring states a rate.
"""

import numpy as np
import pytest
from scipy import integrate, special, stats

from consistency.diagnostics import hotelling, mean_shape, nis_whiteness, simultaneous_band, whiteness
from consistency.referee.diagnostics.bias_and_shape import products_test
from consistency.referee.diagnostics.distributions import weighted_chi_square_tail
from consistency.referee.diagnostics.scale import _log_nu_of_means
from consistency.referee.diagnostics.whiteness import cube_root_moments

RATE = 1e-5


@pytest.fixture
def fresh():
    seed = np.random.SeedSequence().entropy
    print(f"seed {seed}")
    return np.random.default_rng(seed)


# --- whiteness of the NIS --------------------------------------------------------------------------------


def integrated_moments(n):
    """Mean and standard deviation of the cube root x of chi-square(n) / n, from its density over x."""
    raw = [
        integrate.quad(lambda x, r=r: 3 * x**2 * n * stats.chi2.pdf(n * x**3, n) * x**r, 0, 6, points=[0.01, 1])[0]
        for r in (1, 2)
    ]
    return raw[0], np.sqrt(raw[1] - raw[0] ** 2)


@pytest.mark.parametrize("n", [1, 2, 3, 6, 40])
def test_moments_of_the_cube_root_are_those_of_its_density(n):
    mean, deviation = cube_root_moments(np.array([0, n]))
    assert np.isnan([mean[0], deviation[0]]).all()
    assert (mean[1], deviation[1]) == pytest.approx(integrated_moments(n), rel=1e-7)


def test_nis_whiteness_by_hand(fresh):
    """Steps of no, one, two and five degrees of freedom, and missing ones; stated 1.7 times too small."""
    dof = fresh.choice([0, 1, 2, 5], (25, 60))
    dof[0] = 5
    nis = np.where(dof > 0, 1.7 * fresh.chisquare(np.maximum(dof, 1)), np.nan)
    nis[3, 40:] = np.nan
    counted = np.isfinite(nis)
    overall = nis[counted].sum() / dof[counted].sum()
    u = np.full(nis.shape, np.nan)
    for n in (1, 2, 5):
        mean, deviation = integrated_moments(n)
        here = counted & (dof == n)
        u[here] = ((nis[here] / overall / n) ** (1 / 3) - mean) / deviation
    u -= u[counted].mean()
    expected = whiteness(u[..., None], np.ones((*u.shape, 1, 1)))
    found = nis_whiteness(nis, dof)
    assert found.statistic == pytest.approx(expected.statistic, rel=1e-6)
    assert found.correlation == pytest.approx(expected.correlation, abs=1e-8)
    assert found.dof == 10


def test_white_innovations_with_heavy_tails_are_white(fresh):
    """Cube roots whose mean is not that of chi-square, at a rate of 1e-5."""
    nis = np.square(fresh.standard_t(3, (50, 400)))
    assert nis_whiteness(nis, np.ones(nis.shape, int)).p_value > RATE


def test_whiteness_of_no_nis_is_unknown():
    dof = np.ones((30, 30), int)
    for nis in (np.full(dof.shape, np.nan), np.zeros(dof.shape)):
        assert np.isnan(nis_whiteness(nis, dof).p_value)
    assert np.isnan(nis_whiteness(np.ones(dof.shape), 0 * dof).p_value)


# --- band --------------------------------------------------------------------------------------------------


def two_steps(nees, shared_correlation):
    """p value of the band of two steps (runs, 2) by Hunter's bound, from the correlation of runs that have both."""
    a, b = np.isfinite(nees).sum(axis=0)
    rho = max(shared_correlation * np.isfinite(nees).all(axis=1).sum() / np.sqrt(a * b), 0.0)
    tails = [min(f(np.nansum(x), 3 * len(x[np.isfinite(x)])) for f in (stats.chi2.sf, stats.chi2.cdf)) for x in nees.T]
    c = stats.norm.isf(min(tails))
    return float(2 * (stats.norm.sf(c) + 2 * special.owens_t(c, np.sqrt((1 - rho) / (1 + rho)))))


@pytest.mark.parametrize("first, second", [(0, 0), (15, 0), (0, 20), (11, 4)])
def test_neighbours_correlate_less_where_runs_are_missing(fresh, first, second):
    """The first step lacks the first runs, the second the last."""
    common = fresh.chisquare(2, 60)
    nees = 1.4 * np.stack([common + fresh.chisquare(1, 60), common + fresh.chisquare(1, 60)], axis=1)
    nees[:first, 0], nees[60 - second :, 1] = np.nan, np.nan
    both = nees[np.isfinite(nees).all(axis=1)]
    rho = float(np.corrcoef(both.T)[0, 1])
    assert simultaneous_band(nees, 3).p_value == pytest.approx(min(1.0, two_steps(nees, rho)), rel=1e-9)


def test_the_correlation_of_few_shared_runs_is_not_used(fresh):
    nees = 1.3 * np.repeat(fresh.chisquare(3, (50, 1)), 2, axis=1)
    nees[:16, 0], nees[35:, 1] = np.nan, np.nan  # 19 have both
    assert simultaneous_band(nees, 3).p_value == pytest.approx(min(1.0, two_steps(nees, 0.0)))
    nees[15, 0] = 3.0
    nees[15, 1] = 3.0
    assert simultaneous_band(nees, 3).p_value == pytest.approx(min(1.0, two_steps(nees, 1.0)))


def test_opposite_and_equal_neighbours(fresh):
    """A negative correlation counts as none, and one of 1 is not lost in rounding."""
    x = 1.2 * stats.chi2.ppf((np.arange(40) + 0.5) / 40, 3)
    for pair, rho in ((np.stack([x, x[::-1]], axis=1), 0.0), (np.stack([x, x], axis=1), 1.0)):
        assert simultaneous_band(pair, 3).p_value == pytest.approx(two_steps(pair, rho), rel=1e-6)
    equal = np.repeat(1.3 * fresh.chisquare(3, (40, 1)), 300, axis=1) * fresh.uniform(0.999999, 1.0, 300)
    assert 0.0 <= simultaneous_band(equal, 3).p_value <= 1.0


# --- shape ---------------------------------------------------------------------------------------------------


def imhof(value, weights):
    """P(sum of weights chi-square(1) > value), Imhof (1961) eq. 3.2, by numerical integration."""

    def integrand(u):
        angle = 0.5 * np.arctan(weights * u).sum() - 0.5 * value * u
        return float(np.sin(angle) / (u * np.prod((1 + (weights * u) ** 2) ** 0.25)))

    return 0.5 + integrate.quad(integrand, 0, 200, limit=4000)[0] / np.pi


@pytest.mark.parametrize("weights", [[1.0], [2.0, 0.5, 0.5], [3.0, 0.0, 0.0], [1.0] * 15, [2.5, 1.5, 1, 1, 0.3, 0.1]])
@pytest.mark.parametrize("standard", [0.5, 2.0, 4.0])
def test_tail_of_a_weighted_sum_of_chi_squares(weights, standard):
    scale = np.array(weights)
    value = float(scale.sum() + standard * np.sqrt(2 * np.square(scale).sum()))
    expected = imhof(value, scale) if len(scale) > 3 else None
    if (scale[scale > 0] == scale[0]).all():
        expected = float(stats.chi2.sf(value / scale[0], (scale > 0).sum()))
    if expected is None:  # chi-square(2) / 2 is exponential
        expected = integrate.quad(lambda y: stats.chi2.pdf(y, 1) * np.exp(-max(value - 2 * y, 0.0)), 0, 80)[0]
    assert weighted_chi_square_tail(value, scale) == pytest.approx(expected, rel=0.08)


def test_ends_of_that_tail():
    scale = np.array([2.0, 1.0, 0.0])
    assert weighted_chi_square_tail(3.0, scale) == 1.0
    assert weighted_chi_square_tail(0.0, scale) == 1.0
    assert weighted_chi_square_tail(float("inf"), scale) == 0.0
    assert 0.3 < weighted_chi_square_tail(3.05, scale) < 0.45  # near the mean, where differences are small
    assert 1e-60 < weighted_chi_square_tail(500.0, scale) < 1e-50


def by_hand(x):
    """p value of :func:`products_test` for more than three numbers."""
    p = stats.ttest_1samp(x, 0.0).pvalue
    scores = float(np.square(stats.norm.isf(p / 2)).sum())
    together = weighted_chi_square_tail(scores, np.linalg.eigvalsh(np.corrcoef(x.T)))
    return float(min(1.0, 2 * min(p.min() * x.shape[1], together)))


@pytest.mark.parametrize("shift", [0.0, 0.3, 2.0])
@pytest.mark.parametrize("runs, few", [(50, 15), (50, 1), (12, 15), (12, 1)])
def test_products_by_hand(fresh, runs, few, shift):
    """Faults in one number or in all of 15; correlated numbers, with more runs than numbers or fewer."""
    x = fresh.standard_normal((runs, 15)) + 0.5 * fresh.standard_normal((runs, 1))
    x[:, :few] += shift
    assert products_test(x) == pytest.approx(by_hand(x), rel=1e-6)
    x[:, 3] = 0.0
    assert np.isnan(products_test(x))


def test_few_numbers_are_judged_as_before(fresh):
    for size in (1, 3):
        x = fresh.standard_normal((20, size)) + 0.4
        assert products_test(x) == pytest.approx(hotelling(x).p_value)
    x = fresh.standard_normal((20, 4)) + 0.4
    assert products_test(x) == pytest.approx(by_hand(x))


@pytest.mark.parametrize("n", [2, 3, 6, 9])
def test_the_shape_is_asked_from_six_runs_a_further_component(fresh, n):
    w = fresh.standard_normal((6 * (n - 1), 4, n))
    assert np.isfinite(mean_shape(w)[1])
    assert np.isnan(mean_shape(w[1:])[1])


@pytest.mark.parametrize("slow", [False, True])
def test_shape_of_six_components_finds_one_correlation_and_many(fresh, slow):
    """A right shape is passed, and so large a fault missed, at a rate of 1e-5 at most."""
    w = fresh.standard_normal((200, 1, 6)) * np.ones((1, 20, 1)) if slow else fresh.standard_normal((200, 20, 6))
    assert mean_shape(w)[1] > RATE
    one, many = w.copy(), w + (0.8 if slow else 0.4) * w[..., :1]
    one[..., 1] += (3.0 if slow else 0.5) * w[..., 0]
    assert mean_shape(one)[1] < RATE
    assert mean_shape(many)[1] < RATE


# --- scale ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("runs", [3, 20, 41])
def test_spread_without_each_run(fresh, runs):
    """log(2 / CV^2) of all other runs, one by one."""
    means = fresh.chisquare(4, runs) / 4
    _, left_out = _log_nu_of_means(means)
    for run in range(runs):
        others = np.delete(means, run)
        assert left_out[run] == pytest.approx(np.log(2 * others.mean() ** 2 / others.var(ddof=1)), rel=1e-6)


def test_spread_of_one_run_is_the_smallest_that_is_told():
    means = np.array([0.5, 1.5])
    assert _log_nu_of_means(means)[1] == pytest.approx(np.log(2 * means[::-1] ** 2 / 1e-12))
