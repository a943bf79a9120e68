"""Marks a plain function as callable from compiled kernels, and leaves it what it is."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from consistency.referee.types import Array

F = TypeVar("F", bound=Callable[..., Any])
Number = TypeVar("Number", float, Array)  # what a model takes and gives: numbers, or arrays of one shape


_waiting: list[Callable[..., Any]] = []


def jitable(function: F) -> F:
    """Decorator: the function stays plain Python, and Numba compiles it where a kernel calls it."""
    _waiting.append(function)
    return function


def register_jitables() -> None:
    """Tell Numba of what is jitable, before a kernel is compiled: Numba is slow to load, and verdicts do without it."""
    from numba.extending import register_jitable

    while _waiting:
        register_jitable(no_cpython_wrapper=True, no_cfunc_wrapper=True)(_waiting.pop())
