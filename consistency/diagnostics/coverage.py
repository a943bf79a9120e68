"""How often the truth lies within the stated bounds, and how large the error is."""

from __future__ import annotations

import numpy as np
from scipy import special

from consistency.diagnostics.blocks import blocks, by_runs
from consistency.diagnostics.whitening import spread_steps, squared_length
from consistency.types import Array

TWO_SIGMA = 0.9544997361036416  # P(|N(0, 1)| <= 2)


def coverage(error: Array, covariance: Array, bound: float = 2.0) -> Array:
    """Share of errors within ``bound`` standard deviations, for each axis.

    Shapes (..., n) and (..., n, n) -> (n,); rows with NaN do not count.
    """
    error = np.asarray(error, float)
    n = error.shape[-1]
    inside, count = np.zeros(n, np.int64), np.zeros(n, np.int64)
    rows, variance = error.reshape(-1, n), np.diagonal(covariance, axis1=-2, axis2=-1).reshape(-1, n)
    for here in blocks(len(rows), 1):
        sigma = _sigma(variance[here])
        valid = np.isfinite(rows[here]) & np.isfinite(sigma)
        within = np.abs(np.where(valid, rows[here], 0.0)) <= bound * np.where(valid, sigma, 0.0)
        inside += (valid & within).sum(axis=0)
        count += valid.sum(axis=0)
    return np.where(count > 0, inside / np.maximum(count, 1), np.nan)


def _sigma(variance: Array) -> Array:
    return np.sqrt(np.where(variance >= 0, variance, np.nan))


def rmse(error: Array) -> float:
    """Root of the mean squared length of errors (..., n) over all runs and steps; NaN rows do not count."""
    squared = squared_length(np.asarray(error, float))
    squared = squared[np.isfinite(squared)]
    return float(np.sqrt(squared.mean())) if squared.size else float("nan")


def coverage_interval(
    error: Array, covariance: Array, bound: float = 2.0, confidence: float = 0.95
) -> tuple[Array, Array]:
    """Coverage of one step of each run and its exact binomial interval (Clopper & Pearson 1934), for each axis.

    One step a run, spread over the trajectory (:func:`spread_steps`): independent draws, which pooled steps
    are not. Shapes (runs, steps, n), (runs, steps, n, n) -> (n,), (n, 2).
    """
    error = np.asarray(error, float)
    variance = np.diagonal(covariance, axis1=-2, axis2=-1)
    there = by_runs(lambda e, v: (np.isfinite(e) & np.isfinite(v) & (v >= 0)).all(axis=-1), error, variance)
    steps = spread_steps(there)
    rows = np.flatnonzero(steps >= 0)
    inside = (np.abs(error[rows, steps[rows]]) <= bound * _sigma(variance[rows, steps[rows]])).sum(axis=0)
    if not len(rows):
        n = error.shape[-1]
        return np.full(n, np.nan), np.tile([0.0, 1.0], (n, 1))
    N, tail = len(rows), 0.5 * (1.0 - confidence)
    low = np.where(inside > 0, special.betaincinv(np.maximum(inside, 1), N - inside + 1, tail), 0.0)
    high = np.where(inside < N, special.betaincinv(inside + 1, np.maximum(N - inside, 1), 1.0 - tail), 1.0)
    return inside / N, np.stack([low, high], axis=-1)
