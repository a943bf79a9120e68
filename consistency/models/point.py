"""A point landmark in world coordinates, seen from a planar robot: Herath et al. (2007) eq. 19."""

from __future__ import annotations

from typing import Any

import numpy as np

from consistency.models.jitable import jitable


@jitable
def to_robot(px: Any, py: Any, heading: Any, lx: Any, ly: Any, lz: Any) -> tuple[Any, Any, Any]:
    """Landmark in the robot frame (x forward, y left, z up), all in m."""
    return turned_to_robot(px, py, np.cos(heading), np.sin(heading), lx, ly, lz)


@jitable
def turned_to_robot(px: Any, py: Any, c: Any, s: Any, lx: Any, ly: Any, lz: Any) -> tuple[Any, Any, Any]:
    """:func:`to_robot` for many landmarks: cosine and sine of the heading are given."""
    dx, dy = lx - px, ly - py
    return c * dx + s * dy, -s * dx + c * dy, lz


@jitable
def to_world(px: Any, py: Any, heading: Any, bx: Any, by: Any, bz: Any) -> tuple[Any, Any, Any]:
    """Inverse of :func:`to_robot`."""
    c, s = np.cos(heading), np.sin(heading)
    return px + c * bx - s * by, py + s * bx + c * by, bz


@jitable
def to_sensor(bx: Any, by: Any, bz: Any, mount: Any) -> tuple[Any, Any, Any]:
    """Robot frame to the frame of a sensor at ``mount``: 12 numbers, position and rotation by rows."""
    dx, dy, dz = bx - mount[0], by - mount[1], bz - mount[2]
    return (
        mount[3] * dx + mount[6] * dy + mount[9] * dz,
        mount[4] * dx + mount[7] * dy + mount[10] * dz,
        mount[5] * dx + mount[8] * dy + mount[11] * dz,
    )


@jitable
def from_sensor(cx: Any, cy: Any, cz: Any, mount: Any) -> tuple[Any, Any, Any]:
    """Inverse of :func:`to_sensor`."""
    return (
        mount[0] + mount[3] * cx + mount[4] * cy + mount[5] * cz,
        mount[1] + mount[6] * cx + mount[7] * cy + mount[8] * cz,
        mount[2] + mount[9] * cx + mount[10] * cy + mount[11] * cz,
    )
