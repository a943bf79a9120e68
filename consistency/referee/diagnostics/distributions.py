"""Distribution functions of the tests, from :mod:`scipy.special` because :mod:`scipy.stats` is slow, and normality.

Loading :mod:`scipy.stats` costs as much as loading all else that a verdict needs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import optimize, special

from consistency.referee.types import Array

EXACT = 140  # values up to which Kolmogorov's distribution is computed here; SciPy approximates it for more
MOST = 0.95  # p value that is combined with others
CERTAIN = 4.0  # N d^2 from which twice the one-sided tail is the two-sided one to 14 digits
Value = Any  # a number or an array; what comes back has the shape to which all arguments broadcast
FARTHEST = 1e6  # times the largest weight: the tail beyond it is 0 in floating point


class ChiSquare:
    """The chi-square distribution, by the methods of :mod:`scipy.stats`; NaN where ``dof`` is not positive."""

    @staticmethod
    def cdf(x: Value, dof: Value) -> Value:
        return special.chdtr(_positive(dof), np.maximum(x, 0.0))

    @staticmethod
    def sf(x: Value, dof: Value) -> Value:
        return special.chdtrc(_positive(dof), np.maximum(x, 0.0))

    @staticmethod
    def ppf(p: Value, dof: Value) -> Value:
        return 2.0 * special.gammaincinv(_positive(dof) / 2.0, p)

    @staticmethod
    def isf(p: Value, dof: Value) -> Value:
        return special.chdtri(_positive(dof), p)


class Student:
    """Student's t distribution with ``dof`` degrees of freedom."""

    @staticmethod
    def cdf(x: Value, dof: Value) -> Value:
        return special.stdtr(_positive(dof), x)

    @staticmethod
    def sf(x: Value, dof: Value) -> Value:
        return special.stdtr(_positive(dof), np.negative(x))

    @staticmethod
    def ppf(p: Value, dof: Value) -> Value:
        p = np.asarray(p, float)
        ends = np.where(p > 0.0, np.inf, -np.inf)
        return np.where((p == 0.0) | (p == 1.0), ends, special.stdtrit(_positive(dof), p))[()]

    @staticmethod
    def isf(p: Value, dof: Value) -> Value:
        return -Student.ppf(p, dof)


class Beta:
    """The beta distribution on [0, 1]."""

    @staticmethod
    def sf(x: Value, a: Value, b: Value) -> Value:
        if hasattr(special, "betaincc"):  # from SciPy 1.11
            return special.betaincc(a, b, x)
        return special.betainc(b, a, 1.0 - np.asarray(x))


class Kolmogorov:
    """Distance between the empirical distribution function of N values and the true one."""

    @staticmethod
    def sf(distance: float, N: int) -> float:
        """Probability of a larger distance, exact to 1e-12.

        Marsaglia, Tsang & Wang (2003), Evaluating Kolmogorov's distribution, J. Statistical Software 8(18); where both
        sides cannot be exceeded together, twice the one-sided probability. Of more than 140 values by
        :mod:`scipy.stats`.
        """
        if not distance > 0.5 / N:  # the least distance there is
            return float("nan") if np.isnan(distance) else 1.0
        if distance >= 1.0:
            return 0.0
        if distance >= 0.5 or N * distance**2 > CERTAIN:
            return min(1.0, 2.0 * float(special.smirnov(N, distance)))
        if N > EXACT:
            from scipy import stats

            return float(stats.kstwo.sf(distance, N))
        return min(1.0, max(0.0, 1.0 - _within(distance, N)))

    @staticmethod
    def isf(p: float, N: int) -> float:
        """Inverse of :meth:`sf`, for 0 < p < 1."""
        if N > EXACT:
            from scipy import stats

            return float(stats.kstwo.isf(p, N))
        outer = min(1.0, float(special.smirnovi(N, p / 2.0)))  # never smaller: both sides may exceed it
        if Kolmogorov.sf(outer, N) >= p:
            return outer
        return float(optimize.brentq(lambda d: Kolmogorov.sf(d, N) - p, 0.5 / N, outer, xtol=1e-15, rtol=1e-14))


def _within(distance: float, N: int) -> float:
    """Probability of at most that distance: an entry of the N-th power of a matrix of transitions."""
    k = int(N * distance) + 1
    m = 2 * k - 1
    h = k - N * distance
    H: Array = (np.arange(m)[:, None] - np.arange(m) + 1 >= 0).astype(float)
    H[:, 0] -= h ** np.arange(1, m + 1)
    H[-1] -= h ** np.arange(m, 0, -1)
    H[-1, 0] += max(2.0 * h - 1.0, 0.0) ** m
    above = np.arange(m)[:, None] - np.arange(m) + 1
    H /= special.gamma(np.maximum(above, 0) + 1.0)
    power, exponent = _power(H, N)
    steps = np.log(np.arange(1, N + 1) / N).sum()
    return float(power[k - 1, k - 1] * np.exp(steps + exponent))


def _power(H: Array, N: int) -> tuple[Array, float]:
    """H to the power of N, scaled, and the logarithm of the scale."""
    out = np.eye(len(H))
    scale = 0.0
    square = H
    of_square = 0.0
    while True:
        if N & 1:
            out = out @ square
            scale = scale + of_square
            size = out.max()
            out = out / size
            scale = scale + np.log(size)
        N >>= 1
        if not N:
            return out, scale
        square = square @ square
        of_square = 2.0 * of_square
        size = square.max()
        square = square / size
        of_square = of_square + np.log(size)


def _positive(dof: Value) -> Value:
    dof = np.asarray(dof, float)
    return np.where(dof > 0.0, dof, np.nan)[()]


def combined_p_value(p_values: Sequence[float], weights: Sequence[float]) -> float:
    """One p value of several that may depend on each other, by Cauchy's distribution (Liu & Xie 2020).

    It is theirs where all are equal, and the smallest over its weight where that is far smaller than the others.
    ``weights`` add to 1. A p value counts as 0.95 at most.
    """
    p = np.clip(p_values, 1e-300, MOST)
    return float(np.arctan2(1.0, np.dot(weights, 1.0 / np.tan(np.pi * p))) / np.pi)


def weighted_chi_square_tail(value: float, weights: Array) -> float:
    """P(sum of weights times independent chi-square(1) > value) by saddlepoint, ``weights`` (k,) not negative.

    Lugannani & Rice (1980) in Barndorff-Nielsen's form, as in Kuonen (1999): relative errors of a few per cent far out
    in the tail too. Up to the mean, and so near to it that differences would be lost in rounding, 1.
    """
    weights = weights[weights > 0]
    if not value < FARTHEST * weights.max(initial=0.0):
        return 0.0
    if value <= weights.sum() + 0.01 * np.sqrt(2.0 * np.square(weights).sum()):
        return 1.0

    def slope(s: float) -> float:
        return float((weights / (1.0 - 2.0 * s * weights)).sum()) - value

    end = 0.5 / weights.max() - 0.25 / value  # where the term of the largest weight alone is twice the value
    s = float(optimize.brentq(slope, 0.0, end, xtol=1e-14 * end))
    left = 1.0 - 2.0 * s * weights
    w = np.sqrt(2.0 * s * value + np.log(left).sum())
    v = s * np.sqrt(2.0 * np.square(weights / left).sum())
    return float(special.ndtr(-w - np.log(v / w) / w))


chi2 = ChiSquare
t = Student
beta = Beta
kolmogorov = Kolmogorov


@dataclass(frozen=True)
class Normality:
    """Moments of one component and the omnibus test of D'Agostino & Pearson (1973)."""

    mean: float
    std: float
    skewness: float
    excess_kurtosis: float
    statistic: float  # chi-square with 2 degrees of freedom under normality
    p_value: float


def normality(sample: Array) -> Normality:
    """Moments and K-squared test of a sample (N,), N >= 20.

    Raises
    ------
    ValueError
        Too few or not finite values.
    """
    from scipy import stats  # slow to load, and no verdict needs it

    sample = np.asarray(sample, float)
    if sample.ndim != 1 or len(sample) < 20 or not np.isfinite(sample).all():
        raise ValueError(f"needs at least 20 finite values in one dimension, got shape {sample.shape}")
    test = stats.normaltest(sample)
    return Normality(
        float(sample.mean()),
        float(sample.std(ddof=1)),
        float(stats.skew(sample)),
        float(stats.kurtosis(sample)),
        float(test.statistic),
        float(test.pvalue),
    )
