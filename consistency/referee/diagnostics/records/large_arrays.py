"""Large arrays in little memory: symmetric matrices stored by entry, and work done block by block."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from consistency.referee.types import Array


class Symmetric:
    """Matrices (..., n, n) as one array (...) for each entry, where (i, j) and (j, i) may be the same array.

    Each entry of all matrices is contiguous in memory, so that code that needs only the variances reads no more.
    Indices of the leading axes select matrices; ``np.asarray`` gives all of them as (..., n, n).
    """

    def __init__(self, entries: Sequence[Sequence[Array]]) -> None:
        self._entries = entries  # n rows of n arrays (...)

    @classmethod
    def of(cls, matrices: Array | Symmetric) -> Symmetric:
        """Matrices of an array (..., n, n), which is not copied."""
        if isinstance(matrices, Symmetric):
            return matrices
        P = np.asarray(matrices, float)
        return cls([[P[..., i, j] for j in range(P.shape[-1])] for i in range(P.shape[-1])])

    @classmethod
    def filled(cls, shape: tuple[int, ...], n: int, value: float = np.nan) -> Symmetric:
        """Matrices (``shape``, n, n) of one value, to be written by :meth:`entry`."""
        half = {(i, j): np.full(shape, value) for i in range(n) for j in range(i, n)}
        return cls([[half[min(i, j), max(i, j)] for j in range(n)] for i in range(n)])

    def entry(self, i: int, j: int) -> Array:
        """Entry (i, j) of all matrices, (...); writing to it changes them."""
        return self._entries[i][j]

    @property
    def n(self) -> int:
        return len(self._entries)

    @property
    def shape(self) -> tuple[int, ...]:
        return (*self._entries[0][0].shape, self.n, self.n)

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, here: Any) -> Any:
        if isinstance(here, tuple) and len(here) == len(self.shape):
            return self.entry(here[-2], here[-1])[here[:-2]]
        return self._each(lambda entry: entry[here])

    def without(self, some: Array) -> Symmetric:
        """NaN where ``some`` (...) is true."""
        return self._each(lambda entry: np.where(some, np.nan, entry))

    def part(self, index: Sequence[int]) -> Symmetric:
        """Rows and columns ``index`` of all matrices."""
        return Symmetric([[self.entry(i, j) for j in index] for i in index])

    def broadcast(self, shape: tuple[int, ...]) -> Symmetric:
        """Matrices broadcast to leading axes ``shape``."""
        return self._each(lambda entry: np.broadcast_to(entry, shape))

    @property
    def variances(self) -> Array:
        """Diagonals, (..., n), in an array of their own."""
        return np.stack([self.entry(i, i) for i in range(self.n)], axis=-1)

    def where_all(self, holds: Callable[[Array], Array]) -> Array:
        """Where ``holds``, asked of arrays (...), is true of every entry; (...) of bool."""
        out = np.ones(self.shape[:-2], bool)
        for entry in self._different().values():
            out &= holds(entry)
        return out

    def _different(self) -> dict[int, Array]:
        return {id(entry): entry for row in self._entries for entry in row}

    def _each(self, function: Callable[[Array], Array]) -> Symmetric:
        """``function`` of each entry; those that were the same array still are."""
        new = {key: function(entry) for key, entry in self._different().items()}
        return Symmetric([[new[id(entry)] for entry in row] for row in self._entries])

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> Array:
        return np.stack([np.stack(row, axis=-1) for row in self._entries], axis=-2).astype(dtype or float, copy=False)


def diagonal(deviations: Array) -> Array:
    """Covariances of standard deviations without cross terms, (..., n) -> (..., n, n); indefinite of a negative one."""
    sigma = np.asarray(deviations, float)
    return np.asarray((sigma * np.abs(sigma))[..., None] * np.eye(sigma.shape[-1]))


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
