"""The best setting and its interval, on log densities whose maximum and curvature are known."""

import numpy as np
import pytest
from scipy import optimize, stats

from consistency.bench.tuning.noise_factor_fit import (
    LIMIT,
    UNITS,
    KnownScores,
    depth_of,
    fit_log_factors,
    independent_sums,
    profile_intervals,
    score_derivatives,
)

SIGMAS = 4.8  # bound on a normal number, so that each assertion fails by chance in less than 1e-5 of all runs
QUANTILE = 1.96


def gaussian(z):
    """Log density of z (R, T) with a variance of e^x times 1."""
    return lambda x: -0.5 * (z**2 * np.exp(-x[0]) + x[0])


def fitted(score, *starts, p=1):
    fit = fit_log_factors(score, [np.full(p, start) for start in starts or (0.0,)])
    assert fit is not None
    return fit


def outside(score, best, x):
    """How far outside a setting is: the root of W over its quantile, by chi-square or by the spread of runs."""
    falls = (score(best) - score(x)).sum(axis=1)
    n, W = len(falls), max(2.0 * falls.sum(), 0.0)  # 0 where the other factor does better than the best setting
    student = stats.t.ppf(0.975, n - len(x))
    return float(min(np.sqrt(W) / QUANTILE, W / (student * np.sqrt(n * n / (n - len(x)) * falls.var()))))


def test_the_factor_is_that_of_greatest_likelihood(rng):
    z = rng.normal(0.0, 1.7, (40, 30))
    fit = fitted(gaussian(z))
    assert fit.log_factors[0] == pytest.approx(np.log((z**2).mean()), abs=1e-3)
    assert fit.edge == (0,)
    assert fit.settings < 30


def test_the_interval_is_that_of_theory(rng):
    """The log of a mean square of N numbers has the standard deviation sqrt(2 / N); its estimate spreads by 11 %."""
    z = rng.normal(size=(40, 30))
    low, high = fitted(gaussian(z)).interval[0]
    assert (high - low) / 2.0 == pytest.approx(QUANTILE * np.sqrt(2.0 / z.size), rel=SIGMAS * 0.12)


def test_steps_that_repeat_each_other_count_once(rng):
    """Runs whose steps are one number: the interval is that of R numbers, not of R T."""
    z = np.repeat(rng.normal(size=(60, 1)), 30, axis=1)
    low, high = fitted(gaussian(z)).interval[0]
    assert (high - low) / 2.0 == pytest.approx(QUANTILE * np.sqrt(2.0 / 60), rel=SIGMAS * 0.12)


def test_one_run_is_cut_into_blocks(rng):
    z = rng.normal(size=(1, 2000))
    low, high = fitted(gaussian(z)).interval[0]
    wanted = stats.t.ppf(0.975, UNITS - 1) * np.sqrt(2.0 / z.size)
    assert (high - low) / 2.0 == pytest.approx(wanted, rel=0.9)  # the spread of 20 blocks is known to 16 %
    assert np.isfinite([low, high]).all()


def test_two_factors_that_share_what_is_seen(rng):
    """Of z ~ N(0, a) and y ~ N(0, a + b) the intervals are those of the Fisher information, correlation included."""
    n = 4000
    z, y = rng.normal(0.0, 1.0, (100, n // 100)), rng.normal(0.0, np.sqrt(3.0), (100, n // 100))

    def score(x):
        a, total = np.exp(x[0]), np.exp(x[0]) + 2.0 * np.exp(x[1])
        return -0.5 * (z**2 / a + np.log(a) + y**2 / total + np.log(total))

    fit = fitted(score, p=2)
    a, total = (z**2).mean(), (y**2).mean()
    assert fit.log_factors == pytest.approx([np.log(a), np.log((total - a) / 2.0)], abs=5e-3)
    share = np.array([a, total - a]) / total
    information = 0.5 * n * (np.outer(share, share) + np.diag([1.0, 0.0]))
    wanted = QUANTILE * np.sqrt(np.diag(np.linalg.inv(information)))
    assert np.diff(fit.interval, axis=1)[:, 0] / 2.0 == pytest.approx(wanted, rel=SIGMAS * 0.1)


def test_slope_and_curvature_are_those_of_a_parabola():
    """Away from its top, where central differences are exact, too; 0 by a factor that is left out."""
    A, top = np.array([[2.0, -0.7, 0.4], [-0.7, 1.0, 0.3], [0.4, 0.3, 3.0]]), np.array([0.5, -0.3, 0.1])

    def score(x):
        return np.full((25, 2), (7.0 - 0.5 * (x - top) @ A @ (x - top)) / 50)

    slope, curvature = score_derivatives(KnownScores(score), np.zeros(3), [0, 1, 2])
    assert curvature == pytest.approx(-A, abs=1e-9)
    assert slope == pytest.approx(A @ top, abs=1e-9)
    slope, curvature = score_derivatives(KnownScores(score), np.zeros(3), [0, 2])
    assert slope == pytest.approx(A @ top * [1, 0, 1], abs=1e-9)
    assert curvature == pytest.approx(-A * np.outer([1, 0, 1], [1, 0, 1]), abs=1e-9)


def test_a_noise_that_is_not_there_is_bounded_from_above(rng):
    """y ~ N(0, 1 + e^x) with a mean square below 1: the best factor is none."""
    y = rng.normal(0.0, 0.9, (40, 50))

    def score(x):
        total = 1.0 + np.exp(x[0])
        return -0.5 * (y**2 / total + np.log(total))

    fit = fitted(score)
    low, high = fit.interval[0]
    assert fit.edge == (-1,)
    assert low == -np.inf
    assert -LIMIT < high < 0.0
    assert outside(score, np.array([-LIMIT]), np.array([high])) == pytest.approx(1.0, abs=0.05)


def test_data_that_say_nothing_bound_nothing():
    fit = fitted(lambda x: np.zeros((30, 5)))
    assert np.isinf(fit.interval).all()


def test_a_start_at_which_a_run_fails_is_left_for_the_next(rng):
    z = rng.normal(0.0, 1.5, (40, 30))
    score = gaussian(z)

    def failing(x):
        return None if x[0] < 0.2 else score(x)

    fit = fitted(failing, 0.0, 1.5)
    assert fit.log_factors[0] == pytest.approx(np.log((z**2).mean()), abs=1e-3)
    assert fit_log_factors(lambda x: None, [np.zeros(1), np.ones(1)]) is None


# --- the profile -------------------------------------------------------------------------------------


def test_a_setting_is_outside_by_chi_square_and_by_the_spread_of_runs(rng):
    """A parabola whose runs have slopes of known spread: below 1 the spread makes no interval shorter."""
    runs, H, distance = 40, 50.0, 0.2
    for spread in (0.2, 3.0):
        slopes = rng.normal(size=(runs, 1))
        slopes = spread * np.sqrt(H / runs) * (slopes - slopes.mean()) / slopes.std()

        def score(x, slopes=slopes):
            return slopes * x[0] - 0.5 * H / runs * x[0] ** 2

        student = stats.t.ppf(0.975, runs - 1) * spread * np.sqrt(runs / (runs - 1))
        wanted = np.sqrt(H) * distance / max(QUANTILE, student)
        at_best = independent_sums(score(np.zeros(1)))
        for x in (distance, -distance):
            assert depth_of(at_best, independent_sums(score(np.array([x]))), 1) == pytest.approx(wanted, rel=1e-3)
        half = max(QUANTILE, student) / np.sqrt(H)
        found = profile_intervals(score, np.zeros(1), np.array([[-H]]), LIMIT)
        assert found == pytest.approx(np.array([[-half, half]]), rel=1e-3)


def test_runs_without_scatter_have_the_interval_of_the_likelihood():
    """Errors that are all of one size: their scatter alone would say that the factor is known exactly."""
    z = np.where(np.arange(40 * 30).reshape(40, 30) % 2, 1.0, -1.0)
    score = gaussian(z)
    low, high = fitted(score).interval[0]
    for end in (low, high):
        fall = float((score(np.zeros(1)) - score(np.array([end]))).sum())
        assert 2.0 * fall == pytest.approx(QUANTILE**2, rel=0.05)


def test_an_interval_is_open_where_the_data_do_not_bound_it():
    """y of variance 1 + e^x, hardly more than 1: e^x may be 0, and in 1 + e^-x it may be anything large."""
    y = np.linspace(-1.0, 1.0, 800).reshape(40, 20)
    y *= np.sqrt(1.05 / (y**2).mean())
    for sign in (1.0, -1.0):

        def score(x, sign=sign):
            total = 1.0 + np.exp(sign * x[0])
            return -0.5 * (y**2 / total + np.log(total))

        fit = fitted(score)
        assert fit.log_factors[0] == pytest.approx(sign * np.log(0.05), abs=0.02)
        assert fit.edge == (0,)
        open_end, end = fit.interval[0] if sign > 0.0 else fit.interval[0, ::-1]
        assert open_end == -sign * np.inf
        assert outside(score, fit.log_factors, np.array([end])) == pytest.approx(1.0, abs=0.05)
        assert fit.settings < 50


@pytest.mark.parametrize("first", [0.02, 1.0])
def test_ends_are_those_of_the_profile(rng, first):
    """Of z ~ N(0, first e^a + e^b) and y ~ N(0, e^b): the other factor is at its best at each end, as by a search."""
    z = rng.normal(0.0, np.sqrt(first + 1.0), (30, 12))
    y = rng.normal(0.0, 1.0, (30, 3))

    def score(x):
        sizes = (first * np.exp(x[0]) + np.exp(x[1]), np.exp(x[1]))
        return np.hstack([-0.5 * (d**2 / v + np.log(v)) for d, v in zip((z, y), sizes, strict=True)])

    fit = fitted(score, p=2)
    for i in range(2):
        for end in fit.interval[i]:

            def at(other, i=i, end=end):
                value = float(np.clip(end, -LIMIT, LIMIT))
                return np.array([value, other] if i == 0 else [other, value])

            found = optimize.minimize_scalar(
                lambda other, at=at: -float(score(at(other)).sum()), bounds=(-LIMIT, LIMIT), method="bounded"
            )
            depth = outside(score, fit.log_factors, at(found.x))
            assert depth == pytest.approx(1.0, abs=0.12) if np.isfinite(end) else depth < 1.0
    assert fit.settings < 200


def test_an_end_lies_before_settings_at_which_a_run_fails(rng):
    z = rng.normal(0.0, 1.5, (40, 5))
    z *= 1.5 / np.sqrt((z**2).mean())
    score = gaussian(z)
    best = np.log(2.25)
    low, high = fitted(lambda x: None if x[0] > best + 0.07 else score(x), best).interval[0]
    assert best < high < best + 0.1
    assert low == pytest.approx(fitted(score, best).interval[0, 0], abs=0.02)


def test_a_run_that_fails_near_the_best_setting_leaves_an_interval(rng):
    z = rng.normal(0.0, 1.0, (40, 5))
    z /= np.sqrt((z**2).mean())
    score = gaussian(z)
    low, high = fitted(lambda x: None if x[0] > 0.02 else score(x)).interval[0]
    assert -0.4 < low < -0.1
    assert 0.0 < high < 0.1
