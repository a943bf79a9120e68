"""Large arrays a block at a time, so that what is worked out on the way needs little memory."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from consistency.types import Array

ROWS = 2**18  # pairs of run and step in a block


def blocks(count: int, each: int) -> Iterator[slice]:
    """Slices of an axis of ``count`` places with ``each`` rows at a place; one slice, if of nothing, at least."""
    size = max(ROWS // max(each, 1), 1)
    return (slice(k, k + size) for k in range(0, max(count, 1), size))


def by_runs(function: Callable[..., Array], *arrays: Array) -> Array:
    """``function`` of arrays (runs, ...), which works on each run by itself, block by block."""
    runs = len(arrays[0])
    out: Array | None = None
    for here in blocks(runs, int(np.prod(arrays[0].shape[1:2]))):
        part = function(*(array[here] for array in arrays))
        if out is None:
            if len(part) == runs:
                return part
            out = np.empty((runs, *part.shape[1:]), part.dtype)
        out[here] = part
    assert out is not None
    return out
