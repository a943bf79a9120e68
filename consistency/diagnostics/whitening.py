"""Errors in units of what the covariance says."""

from __future__ import annotations

import functools
import operator

import numpy as np

from consistency.diagnostics.blocks import by_runs
from consistency.types import Array


def whiten(error: Array, covariance: Array) -> Array:
    """L^-1 error with L L' = covariance: standard normal, independent components, if the covariance is right.

    Shapes (..., n) and (..., n, n) -> (..., n). Rows that hold a NaN, or whose covariance is not positive
    definite, come back as NaN.
    """
    e = np.asarray(error, float)
    P = np.broadcast_to(np.asarray(covariance, float), (*e.shape, e.shape[-1]))
    return by_runs(_whiten, e, P) if e.ndim > 1 else _whiten(e, P)


def _whiten(e: Array, P: Array) -> Array:
    out = np.empty(e.shape)
    L: list[list[Array]] = []  # rows of arrays over the batch: n is small, the batch is not
    w: list[Array] = []
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        for i in range(e.shape[-1]):
            row: list[Array] = []
            for j in range(i):
                row.append(_less(P[..., i, j], row, L[j]) / L[j][j])
            row.append(np.sqrt(_less(P[..., i, i], row, row)))  # NaN or 0 where P is not definite, and so what follows
            w.append(_less(e[..., i], row, w) / row[i])
            L.append(row)
            out[..., i] = w[i]
    out[~np.isfinite(out).all(axis=-1)] = np.nan
    return out


def _less(value: Array, a: list[Array], b: list[Array]) -> Array:
    """``value`` less the sum of the products, as many as the shorter list has."""
    products = [x * y for x, y in zip(a, b, strict=False)]
    return value - functools.reduce(operator.add, products) if products else value


def standardise(error: Array, covariance: Array) -> Array:
    """Each component over its own standard deviation, (..., n) and (..., n, n) -> (..., n); NaN where that is 0."""
    variance = np.diagonal(covariance, axis1=-2, axis2=-1)
    return by_runs(lambda e, v: e / np.sqrt(np.where(v > 0, v, np.nan)), np.asarray(error, float), variance)


def subset(error: Array, covariance: Array, index: list[int]) -> Array:
    """Whitened errors of a group, (runs, steps, n) and (runs, steps, n, n) -> (runs, steps, len(index))."""

    def of_block(e: Array, P: Array) -> Array:
        e, P = e[..., index], P[..., index, :][..., index]
        return standardise(e, P) if len(index) == 1 else whiten(e, P)

    return by_runs(of_block, error, covariance)


def squared_length(whitened: Array) -> Array:
    """(runs, steps, n) -> (runs, steps): the NEES, if nothing is missing."""
    return by_runs(lambda w: np.square(w).sum(axis=-1), whitened)


def mean_of_runs(values: Array) -> Array:
    """Mean over the steps that a run has, (runs, steps, n) -> (runs, n); NaN where it has none."""

    def mean(block: Array) -> Array:
        present = ~np.isnan(block)
        total, count = np.where(present, block, 0.0).sum(axis=1), present.sum(axis=1)
        return np.where(count > 0, total / np.maximum(count, 1), np.nan)

    return by_runs(mean, values)


def spread_steps(present: Array) -> Array:
    """One step of each run, spread over the trajectory: (runs, steps) of bool -> (runs,), -1 where none.

    Runs are independent and steps are not, so one value of each run is an independent sample. Run i takes
    the step at the i-th point of the golden-ratio sequence, which fills the trajectory evenly for any
    number of runs and does not depend on the data.
    """
    present = np.asarray(present, bool)
    runs, steps = present.shape
    count = present.sum(axis=1)
    place = np.mod(0.5 + np.arange(runs) * (np.sqrt(5.0) - 1.0) / 2.0, 1.0)
    rank = np.minimum((place * count).astype(int), np.maximum(count - 1, 0))
    nth = np.cumsum(present, axis=1) - 1
    step = np.argmax(present & (nth == rank[:, None]), axis=1) if steps else np.zeros(runs, int)
    return np.where(count > 0, step, -1)
