"""Differential-drive motion, Herath, Kodagoda & Dissanayake (2007) eq. 18, and what kernels may call."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np

from consistency.referee.types import Array

F = TypeVar("F", bound=Callable[..., Any])
Number = TypeVar("Number", float, Array)  # what a model takes and gives: numbers, or arrays of one shape
_waiting: list[Callable[..., Any]] = []


def jitable(function: F) -> F:
    """Decorator: the function stays plain Python, and Numba compiles it where a kernel calls it."""
    _waiting.append(function)
    return function


@jitable
def unicycle(
    x: Number, y: Number, heading: Number, dt: Number, v: Number, omega: Number
) -> tuple[Number, Number, Number]:
    """Pose (m, m, rad) after one Euler step of eq. 18, the heading taken at its beginning."""
    return x + dt * v * np.cos(heading), y + dt * v * np.sin(heading), heading + dt * omega


@jitable
def unicycle_jacobian(heading: Number, dt: Number, v: Number) -> tuple[Number, Number]:
    """The two entries of F = d f / d pose that differ from the identity: F[0, 2] and F[1, 2]."""
    return -dt * v * np.sin(heading), dt * v * np.cos(heading)


@jitable
def unicycle_noise(
    heading: Number, dt: Number, sigma_v: float, sigma_omega: float
) -> tuple[Number, Number, Number, Number]:
    """G Q G' for Q = diag(sigma_v^2, sigma_omega^2): its entries xx, xy, yy and hh; the rest is 0."""
    along = (dt * sigma_v) ** 2
    c, s = np.cos(heading), np.sin(heading)
    return along * c * c, along * c * s, along * s * s, (dt * sigma_omega) ** 2


def dead_reckoning(start: Array, controls: Array) -> Array:
    """Poses 0..T, shape (T + 1, 3), of eq. 18 from ``start`` (3,) under ``controls`` (T, 3): dt, v, omega."""
    dt, v, omega = controls.T
    heading = start[2] + np.concatenate([[0.0], np.cumsum(dt * omega)])
    dx, dy, _ = unicycle(0.0, 0.0, heading[:-1], dt, v, omega)
    x = start[0] + np.concatenate([[0.0], np.cumsum(dx)])
    y = start[1] + np.concatenate([[0.0], np.cumsum(dy)])
    return np.column_stack([x, y, heading])


def register_jitables() -> None:
    """Tell Numba of what is jitable, before a kernel is compiled: Numba is slow to load, and verdicts do without it."""
    from numba.extending import register_jitable

    while _waiting:
        register_jitable(no_cpython_wrapper=True, no_cfunc_wrapper=True)(_waiting.pop())
