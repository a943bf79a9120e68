"""Coverage of the stated bounds, and root mean square errors."""

from __future__ import annotations

import functools
import operator
from collections.abc import Sequence

import numpy as np

from consistency.referee.defaults import CONFIDENCE
from consistency.referee.diagnostics.records.array_blocks import by_runs, of_runs
from consistency.referee.diagnostics.records.symmetric import Symmetric
from consistency.referee.diagnostics.records.whitening import spread_steps, squared_length
from consistency.referee.diagnostics.statistics.intervals import binomial_interval
from consistency.referee.types import Array

TWO_SIGMA = 0.9544997361036416  # P(|N(0, 1)| <= 2)


def coverage(error: Array, covariance: Array | Symmetric, bound: float = 2.0, counted: Array | None = None) -> Array:
    """Share of errors within ``bound`` standard deviations, for each axis.

    Shapes (..., n) and (..., n, n) -> (n,); rows with NaN, or not ``counted`` (...), do not count.
    """
    error, P = np.asarray(error, float), Symmetric.of(covariance)
    n = error.shape[-1]
    inside, count = np.zeros(n, np.int64), np.zeros(n, np.int64)
    if error.ndim == 1:
        error, P = error[None], P[None]
    for here in of_runs(error):
        for i in range(n):
            e, sigma = error[here][..., i], _sigma(P.entry(i, i)[here])
            valid = np.isfinite(e) & np.isfinite(sigma)
            if counted is not None:
                valid &= counted[here]
            within = np.abs(np.where(valid, e, 0.0)) <= bound * np.where(valid, sigma, 0.0)
            inside[i] += (valid & within).sum()
            count[i] += valid.sum()
    return np.where(count > 0, inside / np.maximum(count, 1), np.nan)


def _sigma(variance: Array) -> Array:
    return np.sqrt(np.where(variance >= 0, variance, np.nan))


def rmse(error: Array, axes: Sequence[int] | None = None, counted: Array | None = None) -> float:
    """Root of the mean squared length of errors (..., n) over all runs and steps.

    NaN rows do not count.

    Parameters
    ----------
    axes : components of the length; all of them where None
    counted : (...) of bool, rows that count
    """
    e = np.asarray(error, float)
    some = list(range(e.shape[-1])) if axes is None else list(axes)
    squared, count = np.empty(e[..., 0].size), 0
    for here in of_runs(e):
        part = squared_length(e[here][..., some])
        part = part[np.isfinite(part) if counted is None else np.isfinite(part) & counted[here]]
        squared[count : count + len(part)] = part
        count += len(part)
    return float(np.sqrt(squared[:count].mean())) if count else float("nan")


def coverage_interval(
    error: Array,
    covariance: Array | Symmetric,
    bound: float = 2.0,
    confidence: float = CONFIDENCE,
    counted: Array | None = None,
) -> tuple[Array, Array]:
    """Coverage of one step of each run and its exact binomial interval (Clopper & Pearson 1934), for each axis.

    One step of each run, spread over the trajectory (:func:`spread_steps`), gives independent draws; pooled steps would
    not. Shapes (runs, steps, n), (runs, steps, n, n) -> (n,), (n, 2); rows with NaN, or not ``counted`` (runs, steps),
    are not drawn.
    """
    error, P = np.asarray(error, float), Symmetric.of(covariance)
    there = by_runs(_usable, error, P)
    steps = spread_steps(there if counted is None else there & counted)
    rows = np.flatnonzero(steps >= 0)
    variance = P[rows, steps[rows]].variances
    inside = (np.abs(error[rows, steps[rows]]) <= bound * _sigma(variance)).sum(axis=0)
    if not len(rows):
        n = error.shape[-1]
        return np.full(n, np.nan), np.tile([0.0, 1.0], (n, 1))
    return inside / len(rows), np.stack(binomial_interval(inside, len(rows), confidence), axis=-1)


def _usable(error: Array, P: Symmetric) -> Array:
    variances = (P.entry(i, i) for i in range(P.n))
    known = (np.isfinite(error[..., i]) & np.isfinite(v) & (v >= 0) for i, v in enumerate(variances))
    return functools.reduce(operator.and_, known)
