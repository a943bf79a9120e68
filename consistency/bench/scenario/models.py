"""Motion and observation models f, h, their inverses and Jacobians; equations of Herath, Kodagoda & Dissanayake (2007).

Noise-free pure functions of components: each takes and returns plain numbers or equally shaped NumPy arrays (complex
ones too, which the complex-step tests use). Those that are :func:`jitable` can be called from a compiled kernel. Motion
is that of a differential drive, eq. 18; points are seen from a planar robot by stereo, eq. 19, 21 and 22, or by range
and bearing. Pixels are relative to the principal point: u grows to the right, v downwards, d is the disparity. No
randomness, no filter and no scenario belongs here.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import numpy as np

from consistency.referee.types import Array

F = TypeVar("F", bound=Callable[..., Any])
Number = TypeVar("Number", float, Array)  # what a model takes and gives: numbers, or arrays of one shape
Nine = tuple[Number, Number, Number, Number, Number, Number, Number, Number, Number]
Four = tuple[Number, Number, Number, Number]
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


class Mounting(NamedTuple):
    """Pose of a sensor in the robot frame: position in m, and the rotation whose columns are the sensor's axes."""

    x: float
    y: float
    z: float
    xx: float
    xy: float
    xz: float
    yx: float
    yy: float
    yz: float
    zx: float
    zy: float
    zz: float


@jitable
def to_robot(
    px: Number, py: Number, heading: Number, lx: Number, ly: Number, lz: Number
) -> tuple[Number, Number, Number]:
    """Landmark in the robot frame (x forward, y left, z up), all in m."""
    return turned_to_robot(px, py, np.cos(heading), np.sin(heading), lx, ly, lz)


@jitable
def turned_to_robot(
    px: Number, py: Number, c: Number, s: Number, lx: Number, ly: Number, lz: Number
) -> tuple[Number, Number, Number]:
    """:func:`to_robot` for many landmarks: cosine and sine of the heading are given."""
    dx, dy = lx - px, ly - py
    return c * dx + s * dy, -s * dx + c * dy, lz


@jitable
def to_world(
    px: Number, py: Number, heading: Number, bx: Number, by: Number, bz: Number
) -> tuple[Number, Number, Number]:
    """Inverse of :func:`to_robot`."""
    return turned_to_world(px, py, np.cos(heading), np.sin(heading), bx, by, bz)


@jitable
def turned_to_world(
    px: Number, py: Number, c: Number, s: Number, bx: Number, by: Number, bz: Number
) -> tuple[Number, Number, Number]:
    """Inverse of :func:`turned_to_robot`."""
    return px + c * bx - s * by, py + s * bx + c * by, bz


@jitable
def to_sensor(bx: Number, by: Number, bz: Number, mount: Mounting) -> tuple[Number, Number, Number]:
    """Robot frame to the frame of a mounted sensor."""
    dx, dy, dz = bx - mount.x, by - mount.y, bz - mount.z
    return (
        mount.xx * dx + mount.yx * dy + mount.zx * dz,
        mount.xy * dx + mount.yy * dy + mount.zy * dz,
        mount.xz * dx + mount.yz * dy + mount.zz * dz,
    )


@jitable
def from_sensor(cx: Number, cy: Number, cz: Number, mount: Mounting) -> tuple[Number, Number, Number]:
    """Inverse of :func:`to_sensor`."""
    return (
        mount.x + mount.xx * cx + mount.xy * cy + mount.xz * cz,
        mount.y + mount.yx * cx + mount.yy * cy + mount.yz * cz,
        mount.z + mount.zx * cx + mount.zy * cy + mount.zz * cz,
    )


@jitable
def project(x: Number, y: Number, z: Number, f: float, B: float) -> tuple[Number, Number, Number]:
    """Eq. 22: point in the sensor frame (m) to (u, v, d) in px; f in px, baseline B in m."""
    return -f * y / x, -f * z / x, f * B / x


@jitable
def project_jacobian(x: Number, y: Number, z: Number, f: float, B: float) -> Nine[Number]:
    """d(u, v, d) / d(x, y, z) by rows."""
    g = f / x
    return g * y / x, -g, 0.0 * g, g * z / x, 0.0 * g, -g, -g * B / x, 0.0 * g, 0.0 * g


@jitable
def triangulate(u: Number, v: Number, d: Number, f: float, B: float) -> tuple[Number, Number, Number]:
    """Eq. 21: (u, v, d) in px to the point in the sensor frame (m)."""
    return B * f / d, -B * u / d, -B * v / d


@jitable
def triangulate_jacobian(u: Number, v: Number, d: Number, f: float, B: float) -> Nine[Number]:
    """d(x, y, z) / d(u, v, d) by rows."""
    g = B / d
    return 0.0 * g, 0.0 * g, -g * f / d, -g, 0.0 * g, g * u / d, 0.0 * g, -g, g * v / d


@jitable
def range_bearing(x: Number, y: Number) -> tuple[Number, Number]:
    """Point in the sensor frame (m) to range (m) and bearing (rad, counter-clockwise from x, within a half turn)."""
    return np.sqrt(x * x + y * y), np.arctan2(y, x)


@jitable
def range_bearing_jacobian(x: Number, y: Number) -> Four[Number]:
    """d(range, bearing) / d(x, y) by rows."""
    square = x * x + y * y
    distance = np.sqrt(square)
    return x / distance, y / distance, -y / square, x / square


@jitable
def at_range_bearing(distance: Number, bearing: Number) -> tuple[Number, Number]:
    """Inverse of :func:`range_bearing`: the point in the sensor frame (m)."""
    return distance * np.cos(bearing), distance * np.sin(bearing)


@jitable
def at_range_bearing_jacobian(distance: Number, bearing: Number) -> Four[Number]:
    """d(x, y) / d(range, bearing) by rows."""
    c, s = np.cos(bearing), np.sin(bearing)
    return c, -distance * s, s, distance * c
