"""Normality of a sample: moments, and a test that needs no fitted distribution function."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from consistency.referee.types import Array


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
