"""Intervals of what is fitted to runs or drives, from its values with each left out; and of means over them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import stats

from consistency.referee.defaults import CONFIDENCE
from consistency.referee.diagnostics.verdict.parts import Interval
from consistency.referee.types import Array

TAIL = 0.5 * (1.0 - CONFIDENCE)
LEAST = 1e-12  # variance of the logarithm of a ratio


def student(k: float, tail: float = TAIL) -> float:
    """Reach of an interval from k values, in standard errors."""
    return float(stats.t.isf(tail, k - 1))


def jackknife(left_out: Array) -> float:
    """Standard error of an estimate from its values with each of k units left out (k,) (Efron & Stein 1981)."""
    return float(np.sqrt(len(left_out) - 1) * left_out.std())


def interval_of(value: float, left_out: Sequence[float] | Array) -> Interval:
    """Interval of a variance from its values with each block left out, in cube roots (Wilson & Hilferty 1931)."""
    roots = np.cbrt(np.asarray(left_out))
    error = jackknife(roots)
    if not error > 0:  # 0 with any block left out: its upper end is not known
        return Interval(value, 0.0, float("nan"))
    reach = student(len(roots)) * error
    root = float(np.cbrt(value))
    return Interval(value, max(root - reach, 0.0) ** 3, (root + reach) ** 3)


def dof_of_ratio(left_out: Array) -> Array:
    """Degrees of freedom nu of ratios from their values with each of k runs left out, (k, ...) -> (...).

    A ratio spreads as chi-square(nu) / nu (Satterthwaite 1946), whose logarithm has a variance of 2 / nu.
    """
    variance = (len(left_out) - 1) * np.log(left_out).var(axis=0)
    return np.asarray(2.0 / np.maximum(variance, LEAST))


def effective_number(weights: Array) -> float:
    """Number of units of equal weight whose mean is known as well as that of units with ``weights`` (k,)."""
    return float(np.square(weights.sum()) / np.square(weights).sum())


def interval_of_ratio(value: float, left_out: Array, runs: float | None = None) -> Interval:
    """Interval of a positive ratio from its values with each run left out, (k,).

    The lower end is that of Student's t for the logarithm, the upper that of chi-square(nu) / nu at the same
    probability: each is the farther one of both, since few runs do not tell how a ratio is distributed. ``runs`` is the
    :func:`effective_number` of runs with unlike weights.
    """
    reach = student(runs or len(left_out))
    nu = float(dof_of_ratio(left_out))
    low = value * np.exp(-reach * jackknife(np.log(left_out)))
    least = float(stats.chi2.ppf(stats.norm.sf(reach), nu))
    return Interval(value, float(low), value * nu / max(least, 1e-300))


def chance_of_one(value: float, left_out: Array, runs: float | None = None) -> float:
    """Probability of a ratio as far from 1, or farther, where the right one is 1, by :func:`interval_of_ratio`."""
    nu = float(dof_of_ratio(left_out))
    errors = np.log(value) * np.sqrt(0.5 * nu)
    if value < 1.0:
        errors = stats.norm.isf(stats.chi2.cdf(nu * value, nu))
    return float(min(2.0 * stats.t.sf(errors, (runs or len(left_out)) - 1), 1.0))


def floor_interval(value: float, open_value: float, left_out: Array, runs: float | None = None) -> Interval:
    """Interval of a variance that may be 0 from its values with each run left out, (k,), which may lie below 0.

    It is that of a ratio where none of these is 0, and symmetric otherwise; of a variance of 0 it is one-sided.

    Parameters
    ----------
    open_value : the variance that fits best where it may lie below 0
    """
    if value > 0.0 and left_out.min() > 0.0:
        return interval_of_ratio(value, left_out, runs)
    tail = 2.0 * TAIL if value == 0.0 else TAIL
    reach = student(runs or len(left_out), tail) * jackknife(left_out)
    return Interval(value, max(value - reach, 0.0), max(open_value, 0.0) + reach)


def mean_over_runs(values: Array, tail: float = TAIL) -> Interval:
    """Mean of a value of each run, (R,), with Student's interval; of one run its ends are NaN."""
    mean = float(values.mean())
    if len(values) < 2:
        return Interval(mean, float("nan"), float("nan"))
    error = float(values.std(ddof=1) / np.sqrt(len(values)))
    reach = student(len(values), tail) * error
    return Interval(mean, mean - reach, mean + reach)
