"""A point landmark in world coordinates, seen from a planar robot: Herath et al. (2007) eq. 19."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from consistency.bench.models.jitable import Number, jitable


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
