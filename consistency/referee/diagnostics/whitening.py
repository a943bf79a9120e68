"""Errors in units of their stated covariance, whether that is one, and work on large arrays block by block."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from enum import IntEnum
from typing import NamedTuple

import numpy as np

from consistency.referee.types import Array, Indices

LARGE = 40  # components from which on LAPACK, matrix by matrix, is faster than all matrices entry by entry
NUMBERS = 2**22  # of matrices that are factored in one call
GOLDEN = (np.sqrt(5.0) - 1.0) / 2.0
DEFICIENT = 1e-12  # eigenvalue of a correlation matrix below which a direction carries no uncertainty
NEGATIVE = 1e-9  # of the largest entry: an eigenvalue further below zero is not rounding, in any unit
ROWS = 2**18  # pairs of run and step in a block
FEW = 7  # components that NumPy adds one after the other; sums over so short an axis are slow
FEWER = 2**16  # in a block of whole runs, which lies together in memory: what is worked out of it stays in the cache


def whiten(error: Array, covariance: Array) -> Array:
    """L^-1 error with L L' = covariance: standard normal, independent components, if the covariance is right.

    Shapes (..., n) and (..., n, n) -> (..., n). Rows that hold a NaN, or whose covariance is not positive
    definite, come back as NaN.
    """
    e = np.asarray(error, float)
    P = np.asarray(covariance, float)
    P = np.broadcast_to(P, (*e.shape, P.shape[-1]))
    if e.shape[-1] >= LARGE:
        return _whiten_matrix_by_matrix(e, P)
    if e.ndim == 1:
        return _whiten_entry_by_entry(e, P)
    return by_runs(_whiten_entry_by_entry, e, P)


def _whiten_entry_by_entry(e: Array, P: Array) -> Array:
    """The Cholesky factor of all matrices at once: n is small, the batch is not."""
    out = np.empty(e.shape)
    L: list[list[Array]] = []  # rows of arrays over the batch
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
    out[~all_finite(out)] = np.nan
    return out


def _less(value: Array, a: list[Array], b: list[Array]) -> Array:
    """``value`` less the sum of the products, as many as the shorter list has."""
    if not a or not b:
        return value
    total = a[0] * b[0]
    for x, y in zip(a[1:], b[1:], strict=False):
        total = total + x * y
    return np.asarray(value - total)


def _whiten_matrix_by_matrix(error: Array, covariance: Array) -> Array:
    n = error.shape[-1]
    batch = error.shape[:-1] or (1,)
    e = error.reshape(*batch, n)
    P = covariance.reshape(*batch, n, n)
    out = np.full(e.shape, np.nan)
    count = e.size // n
    for here in block_slices(count, n * n, NUMBERS):
        index = np.unravel_index(np.arange(here.start, min(here.stop, count)), batch)
        some = e[index]
        matrices = P[index]
        known = np.isfinite(some).all(axis=1) & np.isfinite(matrices).all(axis=(1, 2))
        some[~known] = np.nan
        some[known] = _solve(some[known], matrices[known])
        out[index] = some
    return out.reshape(error.shape)


def _solve(e: Array, P: Array) -> Array:
    """L^-1 e of finite rows (K, n) and (K, n, n), NaN where P is not positive definite: each half by itself then."""
    try:
        return np.asarray(np.linalg.solve(np.linalg.cholesky(P), e[..., None])[..., 0])
    except np.linalg.LinAlgError:
        if len(e) == 1:
            return np.full(e.shape, np.nan)
        half = len(e) // 2
        return np.concatenate([_solve(e[:half], P[:half]), _solve(e[half:], P[half:])])


def standardise(error: Array, covariance: Array) -> Array:
    """Each component over its own standard deviation, (..., n) and (..., n, n) -> (..., n); NaN where that is 0."""
    e = np.asarray(error, float)
    P = np.asarray(covariance, float)
    if e.ndim == 1:
        return _standardise(e, P)
    return by_runs(_standardise, e, P)


def _standardise(e: Array, P: Array) -> Array:
    out = np.empty(e.shape)
    for i in range(e.shape[-1]):
        variance = P[..., i, i]
        out[..., i] = e[..., i] / np.sqrt(np.where(variance > 0, variance, np.nan))
    return out


def whiten_group(error: Array, covariance: Array, index: Sequence[int]) -> Array:
    """Whitened errors of some components, (runs, steps, n) and (runs, steps, n, n) -> (runs, steps, len(index))."""
    some = list(index)

    def of_block(e: Array, P: Array) -> Array:
        if len(some) == 1:
            return _standardise(e[..., some], P[..., some, :][..., some])
        return whiten(e[..., some], P[..., some, :][..., some])

    if some == list(range(error.shape[-1])) and len(some) > 1:
        return whiten(error, covariance)
    return by_runs(of_block, error, covariance)


def squared_length(whitened: Array) -> Array:
    """(runs, steps, n) -> (runs, steps): the NEES, if nothing is missing."""

    def of_block(w: Array) -> Array:
        if w.shape[-1] > FEW:
            return np.asarray(np.square(w).sum(axis=-1))
        total = np.square(w[..., 0])
        for i in range(1, w.shape[-1]):
            total = total + np.square(w[..., i])
        return np.asarray(total)

    return by_runs(of_block, whitened)


def all_finite(values: Array) -> Array:
    """Rows without a missing component, (..., n) -> (...) of bool."""
    out = np.isfinite(values[..., 0])
    for i in range(1, values.shape[-1]):
        out = out & np.isfinite(values[..., i])
    return out


def mean_and_count(values: Array, axis: int) -> tuple[Array, Array]:
    """Mean of the finite values along an axis, NaN where there is none, and how many there are."""
    present = np.isfinite(values)
    count = present.sum(axis=axis)
    total = np.where(present, values, 0.0).sum(axis=axis)
    return np.where(count > 0, total / np.maximum(count, 1), np.nan), count


def are_unlike(counts: Indices) -> bool:
    """Whether runs have different numbers of steps, (runs,)."""
    return len(counts) > 0 and bool(counts.min() < counts.max())


def mean_of_runs(values: Array) -> Array:
    """Mean over the steps that a run has, (runs, steps, n) -> (runs, n); NaN where it has none."""
    return by_runs(lambda block: mean_and_count(block, 1)[0], values)


def spread_steps(present: Array) -> Array:
    """One step of each run, spread over the trajectory: (runs, steps) of bool -> (runs,), -1 where none.

    Runs are independent and steps are not, so one value of each run is an independent sample. Run i takes
    the step at the i-th point of the golden-ratio sequence, which fills the trajectory evenly for any
    number of runs and does not depend on the data. Where runs have unlike numbers of steps, these may depend on the
    data: then a run takes the first step that it has from that point of the longest trajectory on, if there is one.
    """
    present = np.asarray(present, bool)
    T = present.shape[1]
    if not T:
        return np.full(len(present), -1)

    def from_place(present: Array, place: Array) -> Array:
        there = present & (np.arange(T) >= (place * T).astype(int)[:, None])
        return np.where(there.any(axis=1), np.argmax(there, axis=1), -1)

    def of_block(present: Array, place: Array) -> Array:
        count = present.sum(axis=1)
        rank = np.minimum((place * count).astype(int), np.maximum(count - 1, 0))
        nth = np.cumsum(present, axis=1) - 1
        step = np.argmax(present & (nth == rank[:, None]), axis=1)
        return np.where(count > 0, step, -1)

    counts = present.sum(axis=1)
    of_runs = from_place if are_unlike(counts[counts > 0]) else of_block
    return by_runs(of_runs, present, np.mod(0.5 + np.arange(len(present)) * GOLDEN, 1.0))


class Validity(IntEnum):
    """Classes of :func:`classify`; where several hold, the last of them."""

    VALID = 0
    DEFICIENT = 1  # positive semidefinite: a direction carries no uncertainty
    INDEFINITE = 2
    ASYMMETRIC = 3
    NOT_FINITE = 4


class Tolerance(NamedTuple):
    """Limits of rounding errors."""

    asymmetry: float  # of the largest entry
    indefinite: float  # eigenvalue of a correlation matrix, below zero
    zero: float  # variance that counts as none, in its own unit


EXACT = Tolerance(asymmetry=1e-8, indefinite=DEFICIENT, zero=0.0)  # arrays of doubles
# text files of seven digits; of fewer, a singular matrix; variances of nothing as in the filters of this package
ROUNDED = Tolerance(asymmetry=1e-6, indefinite=1e-4, zero=1e-24)


def classify(covariance: Array, tolerance: Tolerance = EXACT) -> Indices:
    """:class:`Validity` of each matrix, (..., n, n) -> (...), in any units of the components.

    Rank is judged by the smallest eigenvalue of the correlation matrix, where a component whose variance is zero has
    the variance 1 and the covariances that it has.
    """

    def of_block(matrices: Array) -> Indices:
        finite = np.isfinite(matrices).all(axis=(-2, -1))
        out = np.full(len(matrices), Validity.NOT_FINITE, dtype=np.int64)
        P = matrices[finite]
        variance = np.diagonal(P, axis1=-2, axis2=-1)
        none = np.abs(variance) <= tolerance.zero
        scale = np.where(none, 1.0, np.sqrt(np.abs(variance)))
        smallest = np.linalg.eigvalsh(P / (scale[..., :, None] * scale[..., None, :]))[:, 0]
        smallest = np.where(none.any(axis=-1), np.minimum(smallest, 0.0), smallest)
        kind = np.where(smallest > DEFICIENT, Validity.VALID, Validity.DEFICIENT)
        kind[smallest < -tolerance.indefinite] = Validity.INDEFINITE
        kind[asymmetric(P, tolerance)] = Validity.ASYMMETRIC
        out[finite] = kind
        return out

    return by_runs(of_block, covariance.reshape(-1, *covariance.shape[-2:])).reshape(covariance.shape[:-2])


def asymmetric(covariance: Array, tolerance: Tolerance = EXACT) -> Array:
    """Which matrices (..., n, n) differ from their transpose by more than rounding; not those that are not finite."""
    with np.errstate(invalid="ignore"):  # infinity less infinity
        gap = np.abs(covariance - np.swapaxes(covariance, -1, -2)).max(axis=(-2, -1))
    return np.asarray(gap > tolerance.asymmetry * np.abs(covariance).max(axis=(-2, -1)))


def negative(covariance: Array) -> Array:
    """Which finite matrices (N, n, n) have a negative variance in some direction that is not rounding in any unit.

    More lenient than :attr:`Validity.INDEFINITE`, so that a covariance that lost its rank is not called impossible.
    """
    if not len(covariance):
        return np.zeros(0, bool)
    return np.asarray(np.linalg.eigvalsh(covariance)[:, 0] < -NEGATIVE * np.abs(covariance).max(axis=(-2, -1)))


def diagonal(deviations: Array) -> Array:
    """Covariances of standard deviations without cross terms, (..., n) -> (..., n, n); indefinite of a negative one."""
    sigma = np.asarray(deviations, float)
    n = sigma.shape[-1]
    P = np.zeros((*sigma.shape, n))
    P[..., range(n), range(n)] = sigma * np.abs(sigma)  # infinite ones leave the zeros as they are
    return P


def every_entry(holds: Callable[[Array], Array], matrices: Array) -> Array:
    """Where ``holds``, asked of arrays (...), is true of every entry of matrices (..., n, n); (...) of bool."""
    n = matrices.shape[-1]
    if n > FEW:
        return np.asarray(holds(matrices).all(axis=(-2, -1)))
    out = np.ones(matrices.shape[:-2], bool)
    for i, j in np.ndindex(n, n):
        out &= holds(matrices[..., i, j])
    return out


def block_slices(count: int, each: int, rows: int | None = None) -> Iterator[slice]:
    """Slices of an axis of ``count`` places with ``each`` rows at a place; at least one slice, which may be empty."""
    if rows is None:
        rows = ROWS
    size = max(rows // max(each, 1), 1)
    for start in range(0, max(count, 1), size):
        yield slice(start, start + size)


def of_runs(array: Array) -> Iterator[slice]:
    """Slices of the runs of an array (runs, steps, ...), or of the rows of one (rows, n)."""
    return block_slices(len(array), math.prod(array.shape[1:2]), FEWER)


def by_runs(function: Callable[..., Array], first: Array, *others: Array) -> Array:
    """Apply ``function``, which works on each run separately, to arrays (runs, ...) block by block."""
    slices = list(of_runs(first))
    if len(slices) == 1:
        return function(first, *others)
    out = np.empty(0)
    for here in slices:
        part = function(first[here], *(array[here] for array in others))
        if here.start == 0:
            out = np.empty((len(first), *part.shape[1:]), part.dtype)
        out[here] = part
    return out


def by_steps(function: Callable[..., Array], *arrays: Array) -> Array:
    """Apply ``function``, which works on each step separately, to arrays (runs, steps, ...) block by block."""
    runs, steps = arrays[0].shape[:2]
    parts = []
    for here in block_slices(steps, runs):
        parts.append(function(*(array[:, here] for array in arrays)))
    return np.concatenate(parts)
