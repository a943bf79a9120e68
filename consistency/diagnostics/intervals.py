"""Acceptance intervals of averaged chi-square statistics."""

from __future__ import annotations

from scipy import stats


def anees_interval(dof: int, runs: int, confidence: float = 0.95) -> tuple[float, float]:
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


def chi2_mean_interval(dof: float, confidence: float = 0.95) -> tuple[float, float]:
    """Two-sided interval of chi-square over its degrees of freedom, for example of summed NIS."""
    if not 0.0 < confidence < 1.0:
        raise ValueError(f"confidence must lie between 0 and 1, got {confidence}")
    tail = 0.5 * (1.0 - confidence)
    return float(stats.chi2.ppf(tail, dof) / dof), float(stats.chi2.isf(tail, dof) / dof)
