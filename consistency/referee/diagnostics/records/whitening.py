"""Errors in units of their stated covariance."""

from __future__ import annotations

import functools
import operator

import numpy as np

from consistency.referee.diagnostics.records.large_arrays import Symmetric, blocks, by_runs
from consistency.referee.types import Array

LARGE = 40  # components from which on LAPACK, matrix by matrix, is faster than all matrices entry by entry
NUMBERS = 2**22  # of matrices that are factored in one call
AT_ONCE = 8 * NUMBERS  # of matrices that are copied whole from their entries
FEW = 7  # components that NumPy adds one after the other; sums over so short an axis are slow


def whiten(error: Array, covariance: Array | Symmetric) -> Array:
    """L^-1 error with L L' = covariance: standard normal, independent components, if the covariance is right.

    Shapes (..., n) and (..., n, n) -> (..., n). Rows that hold a NaN, or whose covariance is not positive
    definite, come back as NaN.
    """
    e = np.asarray(error, float)
    if e.shape[-1] >= LARGE:
        return _whiten_large(e, covariance)
    P = Symmetric.of(covariance)
    P = P if P.shape[:-1] == e.shape else P.broadcast(e.shape[:-1])
    return by_runs(_whiten, e, P) if e.ndim > 1 else _whiten(e, P)


def _whiten(e: Array, P: Symmetric) -> Array:
    out = np.empty(e.shape)
    L: list[list[Array]] = []  # rows of arrays over the batch: n is small, the batch is not
    w: list[Array] = []
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        for i in range(e.shape[-1]):
            row: list[Array] = []
            for j in range(i):
                row.append(_less(P.entry(i, j), row, L[j]) / L[j][j])
            row.append(np.sqrt(_less(P.entry(i, i), row, row)))  # NaN or 0 where P is not definite, and so what follows
            w.append(_less(e[..., i], row, w) / row[i])
            L.append(row)
            out[..., i] = w[i]
    out[~all_finite(out)] = np.nan
    return out


def _whiten_large(e: Array, covariance: Array | Symmetric) -> Array:
    n = e.shape[-1]
    rows, P = e.reshape(*(e.shape[:-1] or (1,)), n), covariance
    if P.shape[:-1] != rows.shape:
        P = np.broadcast_to(np.asarray(P, float), (*rows.shape, n))
    elif rows.size * n <= AT_ONCE:
        P = np.asarray(P, float)  # indexing entry by entry is slow
    out = np.full(rows.shape, np.nan)
    for here in blocks(out.size // n, n * n, NUMBERS):
        index = np.unravel_index(np.arange(out.size // n)[here], rows.shape[:-1])
        some, matrices = rows[index], np.asarray(P[index], float)
        known = np.isfinite(some).all(axis=1) & np.isfinite(matrices).all(axis=(1, 2))
        some[~known] = np.nan
        some[known] = _solve(some[known], matrices[known])
        out[index] = some
    return out.reshape(e.shape)


def _solve(e: Array, P: Array) -> Array:
    """L^-1 e of finite rows (K, n) and (K, n, n), NaN where P is not positive definite: each half by itself then."""
    try:
        return np.asarray(np.linalg.solve(np.linalg.cholesky(P), e[..., None])[..., 0])
    except np.linalg.LinAlgError:
        if len(e) == 1:
            return np.full(e.shape, np.nan)
        half = len(e) // 2
        return np.concatenate([_solve(e[:half], P[:half]), _solve(e[half:], P[half:])])


def _less(value: Array, a: list[Array], b: list[Array]) -> Array:
    """``value`` less the sum of the products, as many as the shorter list has."""
    products = [x * y for x, y in zip(a, b, strict=False)]
    return value - functools.reduce(operator.add, products) if products else value


def standardise(error: Array, covariance: Array | Symmetric) -> Array:
    """Each component over its own standard deviation, (..., n) and (..., n, n) -> (..., n); NaN where that is 0."""

    def of_block(e: Array, P: Symmetric) -> Array:
        out = np.empty(e.shape)
        for i in range(e.shape[-1]):
            variance = P.entry(i, i)
            out[..., i] = e[..., i] / np.sqrt(np.where(variance > 0, variance, np.nan))
        return out

    e = np.asarray(error, float)
    return by_runs(of_block, e, Symmetric.of(covariance)) if e.ndim > 1 else of_block(e, Symmetric.of(covariance))


def subset(error: Array, covariance: Array | Symmetric, index: list[int]) -> Array:
    """Whitened errors of a group, (runs, steps, n) and (runs, steps, n, n) -> (runs, steps, len(index))."""

    def of_block(e: Array, P: Symmetric) -> Array:
        e, P = e[..., index], P.part(index)
        return standardise(e, P) if len(index) == 1 else whiten(e, P)

    return by_runs(of_block, error, Symmetric.of(covariance))


def squared_length(whitened: Array) -> Array:
    """(runs, steps, n) -> (runs, steps): the NEES, if nothing is missing."""

    def of_block(w: Array) -> Array:
        if w.shape[-1] > FEW:
            return np.asarray(np.square(w).sum(axis=-1))
        return functools.reduce(operator.add, (np.square(w[..., i]) for i in range(w.shape[-1])))

    return by_runs(of_block, whitened)


def all_finite(values: Array) -> Array:
    """Rows without a missing component, (..., n) -> (...) of bool."""
    return functools.reduce(operator.and_, (np.isfinite(values[..., i]) for i in range(values.shape[-1])))


def mean_and_count(values: Array, axis: int) -> tuple[Array, Array]:
    """Mean of the finite values along an axis, NaN where there is none, and how many there are."""
    present = np.isfinite(values)
    count = present.sum(axis=axis)
    total = np.where(present, values, 0.0).sum(axis=axis)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan), count


def mean_of_runs(values: Array) -> Array:
    """Mean over the steps that a run has, (runs, steps, n) -> (runs, n); NaN where it has none."""
    return by_runs(lambda block: mean_and_count(block, 1)[0], values)


def spread_steps(present: Array) -> Array:
    """One step of each run, spread over the trajectory: (runs, steps) of bool -> (runs,), -1 where none.

    Runs are independent and steps are not, so one value of each run is an independent sample. Run i takes
    the step at the i-th point of the golden-ratio sequence, which fills the trajectory evenly for any
    number of runs and does not depend on the data.
    """
    present = np.asarray(present, bool)

    def of_block(present: Array, place: Array) -> Array:
        count = present.sum(axis=1)
        rank = np.minimum((place * count).astype(int), np.maximum(count - 1, 0))
        nth = np.cumsum(present, axis=1) - 1
        step = np.argmax(present & (nth == rank[:, None]), axis=1) if present.shape[1] else np.zeros(len(present), int)
        return np.where(count > 0, step, -1)

    return by_runs(of_block, present, np.mod(0.5 + np.arange(len(present)) * (np.sqrt(5.0) - 1.0) / 2.0, 1.0))
