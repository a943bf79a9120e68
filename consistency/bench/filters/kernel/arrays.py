"""Arrays of kernels, and what is done with them in loops, which compile in a fraction of the time of NumPy's functions.

NumPy's constructors are compiled again for each kind of shape, so that kernels call those of this module. Where no
value is given, an array has any. ``copy`` and ``fill`` write to the whole of their target.
"""

from __future__ import annotations

import numpy as np

from consistency.bench.filters.compiler.jit import inner
from consistency.referee.types import Array, Indices


@inner
def copy(source: Array, target: Array) -> None:
    for i in range(len(target)):
        target[i] = source[i]


@inner
def copy_matrix(source: Array, target: Array) -> None:
    for i in range(target.shape[0]):
        for j in range(target.shape[1]):
            target[i, j] = source[i, j]


@inner
def fill(target: Array, value: float) -> None:
    for i in range(len(target)):
        target[i] = value


@inner
def fill_matrix(target: Array, value: float) -> None:
    for i in range(target.shape[0]):
        for j in range(target.shape[1]):
            target[i, j] = value


@inner
def vector(n: int) -> Array:
    return np.empty(n)


@inner
def matrix(m: int, n: int) -> Array:
    return np.empty((m, n))


@inner
def blocks(count: int, m: int, n: int) -> Array:
    return np.empty((count, m, n))


@inner
def integers(n: int, value: int) -> Indices:
    new = np.empty(n, np.int64)
    for i in range(n):
        new[i] = value
    return new


@inner
def filled(n: int, value: float) -> Array:
    new = vector(n)
    fill(new, value)
    return new


@inner
def filled_matrix(m: int, n: int, value: float) -> Array:
    new = matrix(m, n)
    fill_matrix(new, value)
    return new


@inner
def filled_blocks(count: int, m: int, n: int, value: float) -> Array:
    new = blocks(count, m, n)
    for i in range(count):
        fill_matrix(new[i], value)
    return new


@inner
def sum_of(values: Array) -> float:
    """Sum of ``values`` (n,), from the first to the last."""
    result = 0.0
    for i in range(len(values)):
        result += values[i]
    return result
