"""Large arrays in little memory: work done block by block, each of which stays in the cache."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np

from consistency.referee.types import Array

ROWS = 2**18  # pairs of run and step in a block
FEW = 7  # components that NumPy adds one after the other; sums over so short an axis are slow
FEWER = 2**16  # in a block of whole runs, which lies together in memory: what is worked out of it stays in the cache


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
