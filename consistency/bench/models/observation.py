"""Points as sensors see them, with Jacobians: stereo and range and bearing, from a planar robot.

The equations are 19, 21 and 22 of Herath, Kodagoda & Dissanayake (2007). Pixels are relative to the principal point: u
grows to the right, v downwards, d is the disparity.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from consistency.bench.models.motion import Number, jitable

Nine = tuple[Number, Number, Number, Number, Number, Number, Number, Number, Number]
Four = tuple[Number, Number, Number, Number]


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
