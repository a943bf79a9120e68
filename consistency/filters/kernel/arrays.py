"""Copies and fills of kernels as loops, which compile in a fraction of the time of NumPy's assignment to slices."""

from __future__ import annotations

from consistency.filters.kernel.jit import inner
from consistency.types import Array


@inner
def copy(source: Array, target: Array) -> None:
    """``target`` (n,) <- ``source``."""
    for i in range(len(target)):
        target[i] = source[i]


@inner
def copy_matrix(source: Array, target: Array) -> None:
    """``target`` (m, n) <- ``source``."""
    for i in range(target.shape[0]):
        for j in range(target.shape[1]):
            target[i, j] = source[i, j]


@inner
def fill(target: Array, value: float) -> None:
    """``target`` (n,) <- ``value``."""
    for i in range(len(target)):
        target[i] = value


@inner
def fill_matrix(target: Array, value: float) -> None:
    """``target`` (m, n) <- ``value``."""
    for i in range(target.shape[0]):
        for j in range(target.shape[1]):
            target[i, j] = value
