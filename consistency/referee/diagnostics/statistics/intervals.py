"""Acceptance intervals of averaged chi-square statistics."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import special

from consistency.referee.defaults import CONFIDENCE
from consistency.referee.diagnostics.statistics import distributions
from consistency.referee.types import Array


def anees_interval(dof: int, runs: int, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """Two-sided interval [r1, r2] of the average NEES of one step, Herath et al. (2007) eq. 17.

    Parameters
    ----------
    dof : dimension of the error
    runs : number of independent runs averaged
    confidence : probability that a consistent filter's average lies inside

    Raises
    ------
    ValueError
        dof or runs below 1, confidence outside (0, 1).
    """
    if dof < 1 or runs < 1:
        raise ValueError(f"dof and runs must be at least 1, got {dof} and {runs}")
    low, high = chi2_mean_interval(dof * runs, confidence)
    return low * dof, high * dof


def chi2_mean_interval(dof: float, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """Two-sided interval of chi-square over its degrees of freedom, for example of summed NIS."""
    if not 0.0 < confidence < 1.0:
        raise ValueError(f"confidence must lie between 0 and 1, got {confidence}")
    tail = 0.5 * (1.0 - confidence)
    return float(distributions.chi2.ppf(tail, dof) / dof), float(distributions.chi2.isf(tail, dof) / dof)


def binomial_interval(count: Any, draws: Any, confidence: float = CONFIDENCE) -> tuple[Array, Array]:
    """Exact interval of a share, Clopper & Pearson (1934), of ``count`` in ``draws``.

    Numbers or arrays that broadcast, whole or not; low and high have their shape. Without draws the interval is [0, 1].
    """
    count, draws = np.broadcast_arrays(np.asarray(count, float), np.asarray(draws, float))
    tail = 0.5 * (1.0 - confidence)
    some, not_all = count > 0.0, count < draws
    low = special.betaincinv(np.where(some, count, 1.0), draws - count + 1.0, tail)
    high = special.betaincinv(count + 1.0, np.where(not_all, draws - count, 1.0), 1.0 - tail)
    return np.where(some, low, 0.0), np.where(not_all, high, 1.0)
