"""Has the covariance the right shape: relative sizes of the components and their correlations?"""

from __future__ import annotations

import numpy as np
from scipy import stats

from consistency.diagnostics.bias import Moments, hotelling, moments
from consistency.diagnostics.blocks import by_runs
from consistency.diagnostics.whitening import all_finite
from consistency.types import Array


def identity_statistic(whitened: Array) -> tuple[float, float]:
    """Likelihood ratio that whitened errors (N, n) have covariance I, mean zero: statistic and p value.

    N (tr S - ln det S - n) with S the mean of w w', chi-square with n (n + 1) / 2 degrees of freedom after
    Bartlett's correction (Anderson 2003, sec. 10.8). It sees scale and shape together;
    :func:`sphericity` sees the shape alone.
    """
    w = np.asarray(whitened, float)
    N, n = w.shape
    S = w.T @ w / N
    sign, logdet = np.linalg.slogdet(S)
    if sign <= 0:
        return float("inf"), 0.0
    statistic = N * (float(np.trace(S)) - float(logdet) - n)
    statistic *= 1.0 - (2 * n + 1 - 2 / (n + 1)) / (6 * N)
    return statistic, float(stats.chi2.sf(statistic, n * (n + 1) / 2))


def sphericity(whitened: Array, known: Moments | None = None) -> tuple[Array, Array]:
    """Mauchly's (1940) test of every step: covariance of the whitened errors proportional to I.

    (runs, steps, n) -> statistic and p value, (steps,) each; the mean and the scale may be anything. Box's
    second-order expansion of the null distribution (Anderson 2003, sec. 10.7.4). NaN where fewer than
    4 n runs are left, or n is 1. ``known`` are the moments, where they are.
    """
    N, _, S = moments(whitened) if known is None else known
    n = whitened.shape[-1]
    statistic, p_value = np.full(len(N), np.nan), np.full(len(N), np.nan)
    good = (4 * n <= N) & (np.trace(S, axis1=-2, axis2=-1) > 0)
    if n == 1 or not good.any():
        return statistic, p_value
    m = N[good] - 1.0
    sign, logdet = np.linalg.slogdet(S[good])
    trace = np.trace(S[good], axis1=-2, axis2=-1) / n
    with np.errstate(divide="ignore", invalid="ignore"):
        log_w = np.where(sign > 0, logdet - n * np.log(trace), -np.inf)
    rho = 1.0 - (2 * n * n + n + 2) / (6 * n * m)
    omega = (n + 2) * (n - 1) * (n - 2) * (2 * n**3 + 6 * n**2 + 3 * n + 2) / (288 * n**2 * m**2 * rho**2)
    f = n * (n + 1) / 2 - 1
    statistic[good] = value = -m * rho * log_w
    tail = stats.chi2.sf(value, f)
    p_value[good] = np.clip(tail + omega * (stats.chi2.sf(value, f + 4) - tail), 0.0, 1.0)
    return statistic, p_value


def mean_shape(whitened: Array) -> tuple[Array, float]:
    """Mean of w w' over whole trajectories, scaled to trace n, and the p value of its being diagonal.

    (runs, steps, n) -> (n, n), p. Each run is one observation of the mean products of different components,
    n (n - 1) / 2 numbers with mean zero under any scale of each component; Hotelling's T-squared. (Scales
    that differ are seen by the test of each axis.) p is NaN where there are fewer than three runs for each
    number.
    """
    present = all_finite(whitened)
    n = whitened.shape[-1]
    count = present.sum(axis=1)
    M = by_runs(second_moments, whitened, present)[count > 0] / count[count > 0, None, None]
    mean = M.mean(axis=0) if len(M) else np.full((n, n), np.nan)
    trace = float(np.trace(mean))
    scaled = mean * n / trace if trace > 0 else mean
    size = n * (n - 1) // 2
    if n == 1 or len(M) < 3 * size + 3 or not trace > 0:
        return scaled, float("nan")
    i, j = np.triu_indices(n, 1)
    return scaled, hotelling(M[:, i, j]).p_value


def second_moments(whitened: Array, present: Array) -> Array:
    """Sum of w w' over the steps of each run, (runs, steps, n) -> (runs, n, n)."""
    w = np.where(present[..., None], whitened, 0.0)
    return np.asarray(np.swapaxes(w, -1, -2) @ w)
