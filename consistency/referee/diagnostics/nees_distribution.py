"""Test that the NEES has its chi-square distribution, without fitted parameters."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from consistency.referee.defaults import FALSE_ALARM
from consistency.referee.diagnostics import laws
from consistency.referee.diagnostics.whitening import spread_steps
from consistency.referee.types import Array


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
    u = np.sort(laws.chi2.cdf(nees[rows, steps[rows]], dof))
    if len(u) == 0:
        return Pit(u, float("nan"), float("nan"), float("nan"))
    return Pit(u, _half_width(false_alarm, len(u)), *kolmogorov(u))


def kolmogorov(u: Array) -> tuple[float, float]:
    """Kolmogorov's distance of independent values (N,) from the uniform distribution on [0, 1], and its p value."""
    u, N = np.sort(u), len(u)
    grid = np.arange(N + 1) / N
    distance = float(max((grid[1:] - u).max(), (u - grid[:-1]).max()))
    return distance, float(laws.kolmogorov.sf(distance, N))


@lru_cache
def _half_width(false_alarm: float, N: int) -> float:
    return float(laws.kolmogorov.isf(false_alarm, N))
