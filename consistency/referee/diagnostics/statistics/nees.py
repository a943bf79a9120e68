"""Normalized estimation error squared, Bar-Shalom, Li & Kirubarajan (2001) sec. 5.4, and a test of its distribution."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from consistency.referee.defaults import FALSE_ALARM
from consistency.referee.diagnostics.records.array_blocks import by_steps
from consistency.referee.diagnostics.records.validity import asymmetric
from consistency.referee.diagnostics.records.whitening import mean_and_count, spread_steps, whiten
from consistency.referee.diagnostics.statistics import distributions
from consistency.referee.types import Array


def nees(error: Array, covariance: Array) -> Array:
    """error' covariance^-1 error, Herath et al. (2007) eq. 14.

    Parameters
    ----------
    error : (..., n), truth minus estimate; wrap angles first
    covariance : (..., n, n)

    Returns
    -------
    (...), chi-square distributed with n degrees of freedom if the covariance is the error's

    Raises
    ------
    ValueError
        Shapes do not fit, a value is not finite, or a covariance is not symmetric or not positive
        definite; the message names the first index.
    """
    e, P = np.asarray(error, float), np.asarray(covariance, float)
    n = e.shape[-1] if e.ndim else 0
    try:
        if P.shape[-2:] != (n, n):
            raise ValueError
        batch = np.broadcast_shapes(e.shape[:-1], P.shape[:-2])
        e, P = np.broadcast_to(e, (*batch, n)), np.broadcast_to(P, (*batch, n, n))
    except ValueError:
        raise ValueError(f"error {e.shape} and covariance {P.shape} must be (..., n) and (..., n, n)") from None
    _require(np.isfinite(e), "the error is not finite", 1)
    _require(np.isfinite(P), "the covariance is not finite", 2)
    if not (np.swapaxes(P, -1, -2) == P).all():
        _require(~asymmetric(P), "the covariance is not symmetric", 0)
    whitened = whiten(e, P)
    if not np.isfinite(whitened).all():
        _require(np.linalg.eigvalsh(P) > 0, "the covariance is not positive definite", 1)
        raise ValueError("a covariance is not positive definite")
    return np.asarray(np.einsum("...i,...i->...", whitened, whitened))


def anees(values: Array) -> Array:
    """Average over runs, Herath et al. (2007) eq. 16: (runs, steps) -> (steps,).

    A NaN is a run that has no value in that step (rank-deficient covariance, or failed earlier); where
    no run has one the average is NaN.
    """
    return by_steps(lambda block: mean_and_count(block, 0)[0], np.asarray(values, float))


_half_width = lru_cache(distributions.kolmogorov.isf)


@dataclass(frozen=True)
class Pit:
    """Probability integral transform of the NEES against its band."""

    values: Array  # (N,), sorted: uniform between 0 and 1 if the covariance is right
    half_width: float  # of the simultaneous band around the diagonal
    statistic: float  # Kolmogorov's distance
    p_value: float


def pit(nees: Array, dof: int, false_alarm: float = FALSE_ALARM) -> Pit:
    """Distribution function of the chi-square at the NEES of one step of each run, and Kolmogorov's test.

    One value a run, at steps spread over the trajectory (:func:`spread_steps`), is an independent sample, so
    the exact distribution of Kolmogorov's distance holds (Marsaglia, Tsang & Wang 2003) and the band holds
    for the whole empirical distribution function at once.

    Parameters
    ----------
    nees : (runs, steps), NaN where a run has no value
    dof : degrees of freedom, not fitted to the data
    """
    steps = spread_steps(np.isfinite(nees))
    rows = np.flatnonzero(steps >= 0)
    u = np.sort(distributions.chi2.cdf(nees[rows, steps[rows]], dof))
    if len(u) == 0:
        return Pit(u, float("nan"), float("nan"), float("nan"))
    return Pit(u, _half_width(false_alarm, len(u)), *kolmogorov(u))


def kolmogorov(u: Array) -> tuple[float, float]:
    """Kolmogorov's distance of independent values (N,) from the uniform distribution on [0, 1], and its p value."""
    u, N = np.sort(u), len(u)
    grid = np.arange(N + 1) / N
    distance = float(max((grid[1:] - u).max(), (u - grid[:-1]).max()))
    return distance, float(distributions.kolmogorov.sf(distance, N))


def _require(good: Array, what: str, last: int) -> None:
    """Raise ValueError, with the first index of the batch, unless all is true over the ``last`` axes."""
    if not good.all():
        bad = ~good.all(axis=tuple(range(-last, 0)))
        index = tuple(int(i) for i in np.argwhere(np.atleast_1d(bad))[0])
        raise ValueError(f"{what} at index {index if np.ndim(bad) else ()}")
