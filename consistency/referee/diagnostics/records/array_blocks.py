"""Large arrays processed block by block, so that intermediate results need little memory."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import numpy as np

from consistency.referee.diagnostics.records.symmetric import Symmetric
from consistency.referee.types import Array

ROWS = 2**18  # pairs of run and step in a block
FEWER = 2**16  # in a block of whole runs, which lies together in memory: what is worked out of it stays in the cache


def blocks(count: int, each: int, rows: int | None = None) -> Iterator[slice]:
    """Slices of an axis of ``count`` places with ``each`` rows at a place; at least one slice, which may be empty."""
    size = max((ROWS if rows is None else rows) // max(each, 1), 1)
    return (slice(k, k + size) for k in range(0, max(count, 1), size))


def of_runs(array: Array) -> Iterator[slice]:
    """Slices of the runs of an array (runs, steps, ...), or of the rows of one (rows, n)."""
    return blocks(len(array), math.prod(array.shape[1:2]), FEWER)


def by_runs(function: Callable[..., Array], first: Array, *others: Array | Symmetric) -> Array:
    """Apply ``function``, which works on each run separately, to arrays (runs, ...) block by block."""
    runs = len(first)
    parts = list(of_runs(first))
    if len(parts) == 1:
        return function(first, *others)
    out: Array | None = None
    for here in parts:
        part = function(first[here], *(array[here] for array in others))
        if out is None:
            out = np.empty((runs, *part.shape[1:]), part.dtype)
        out[here] = part
    assert out is not None
    return out


def by_steps(function: Callable[..., Array], *arrays: Array) -> Array:
    """Apply ``function``, which works on each step separately, to arrays (runs, steps, ...) block by block."""
    runs, steps = arrays[0].shape[:2]
    return np.concatenate([function(*(array[:, here] for array in arrays)) for here in blocks(steps, runs)])
