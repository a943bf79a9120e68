"""The best setting and its interval, on log densities whose maximum and curvature are known."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from scipy import stats

from consistency.tuning.fit import LIMIT, Fit, _derivatives, _Search, maximise
from consistency.tuning.profile import UNITS
from consistency.types import Array

SIGMAS = 4.8  # bound on a normal number, so that each assertion fails by chance in less than 1e-5 of all runs
QUANTILE = 1.96


def gaussian(z: Array) -> Callable[[Array], Array]:
    """Log density of z (R, T) with a variance of e^x times 1."""
    return lambda x: -0.5 * (z**2 * np.exp(-x[0]) + x[0])


def fitted(score: Callable[[Array], Array | None], *starts: float, p: int = 1) -> Fit:
    fit = maximise(score, [np.full(p, start) for start in starts or (0.0,)])
    assert fit is not None
    return fit


def test_the_factor_is_that_of_greatest_likelihood(rng: np.random.Generator) -> None:
    z = rng.normal(0.0, 1.7, (40, 30))
    fit = fitted(gaussian(z))
    assert fit.log_factors[0] == pytest.approx(np.log((z**2).mean()), abs=1e-3)
    assert fit.edge == (0,)
    assert fit.settings < 30


def test_the_interval_is_that_of_theory(rng: np.random.Generator) -> None:
    """The log of a mean square of N numbers has the standard deviation sqrt(2 / N); its estimate spreads by 11 %."""
    z = rng.normal(size=(40, 30))
    low, high = fitted(gaussian(z)).interval[0]
    assert (high - low) / 2.0 == pytest.approx(QUANTILE * np.sqrt(2.0 / z.size), rel=SIGMAS * 0.12)


def test_steps_that_repeat_each_other_count_once(rng: np.random.Generator) -> None:
    """Runs whose steps are one number: the interval is that of R numbers, not of R T."""
    z = np.repeat(rng.normal(size=(60, 1)), 30, axis=1)
    low, high = fitted(gaussian(z)).interval[0]
    assert (high - low) / 2.0 == pytest.approx(QUANTILE * np.sqrt(2.0 / 60), rel=SIGMAS * 0.12)


def test_one_run_is_cut_into_blocks(rng: np.random.Generator) -> None:
    z = rng.normal(size=(1, 2000))
    low, high = fitted(gaussian(z)).interval[0]
    wanted = stats.t.ppf(0.975, UNITS - 1) * np.sqrt(2.0 / z.size)
    assert (high - low) / 2.0 == pytest.approx(wanted, rel=0.9)  # the spread of 20 blocks is known to 16 %
    assert np.isfinite([low, high]).all()


def test_two_factors_that_share_what_is_seen(rng: np.random.Generator) -> None:
    """Of z ~ N(0, a) and y ~ N(0, a + b) the intervals are those of the Fisher information, correlation included."""
    n = 4000
    z, y = rng.normal(0.0, 1.0, (100, n // 100)), rng.normal(0.0, np.sqrt(3.0), (100, n // 100))

    def score(x: Array) -> Array:
        a, total = np.exp(x[0]), np.exp(x[0]) + 2.0 * np.exp(x[1])
        return -0.5 * (z**2 / a + np.log(a) + y**2 / total + np.log(total))

    fit = fitted(score, p=2)
    a, total = (z**2).mean(), (y**2).mean()
    assert fit.log_factors == pytest.approx([np.log(a), np.log((total - a) / 2.0)], abs=5e-3)
    share = np.array([a, total - a]) / total
    information = 0.5 * n * (np.outer(share, share) + np.diag([1.0, 0.0]))
    wanted = QUANTILE * np.sqrt(np.diag(np.linalg.inv(information)))
    assert np.diff(fit.interval, axis=1)[:, 0] / 2.0 == pytest.approx(wanted, rel=SIGMAS * 0.1)


def test_slopes_and_curvature_are_those_of_a_parabola() -> None:
    A, runs = np.array([[2.0, -0.7], [-0.7, 1.0]]), 25
    slope = np.linspace(-1.0, 1.0, runs)

    def score(x: Array) -> Array:
        return (-0.5 * x @ A @ x / runs + slope * x[0])[:, None]

    slopes, curvature = _derivatives(_Search(score), np.zeros(2), [0, 1])
    assert curvature == pytest.approx(-A, abs=1e-9)
    assert slopes == pytest.approx(np.column_stack([slope, np.zeros(runs)]), abs=1e-9)


def test_a_noise_that_is_not_there_is_bounded_from_above(rng: np.random.Generator) -> None:
    """y ~ N(0, 1 + e^x) with a mean square below 1: the best factor is none."""
    y = rng.normal(0.0, 0.9, (40, 50))

    def score(x: Array) -> Array:
        total = 1.0 + np.exp(x[0])
        return -0.5 * (y**2 / total + np.log(total))

    fit = fitted(score)
    low, high = fit.interval[0]
    assert fit.edge == (-1,)
    assert low == -np.inf
    assert -LIMIT < high < 0.0
    drop = score(np.array([-LIMIT])).sum() - score(np.array([high])).sum()
    assert drop == pytest.approx(stats.chi2.ppf(0.95, 1) / 2.0, rel=0.15)


def test_data_that_say_nothing_bound_nothing() -> None:
    fit = fitted(lambda x: np.zeros((30, 5)))
    assert np.isinf(fit.interval).all()


def test_a_start_at_which_a_run_fails_is_left_for_the_next(rng: np.random.Generator) -> None:
    z = rng.normal(0.0, 1.5, (40, 30))
    score = gaussian(z)

    def failing(x: Array) -> Array | None:
        return None if x[0] < 0.2 else score(x)

    fit = fitted(failing, 0.0, 1.5)
    assert fit.log_factors[0] == pytest.approx(np.log((z**2).mean()), abs=1e-3)
    assert maximise(lambda x: None, [np.zeros(1), np.ones(1)]) is None
