"""Marks a plain function as callable from compiled kernels, and leaves it what it is."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

from numba.extending import register_jitable

from consistency.referee.types import Array

F = TypeVar("F", bound=Callable[..., Any])
Number = TypeVar("Number", float, Array)  # what a model takes and gives: numbers, or arrays of one shape


def jitable(function: F) -> F:
    """Decorator: the function stays plain Python, and Numba compiles it where a kernel calls it."""
    register_jitable(no_cpython_wrapper=True, no_cfunc_wrapper=True)(function)
    return function
