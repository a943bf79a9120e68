"""EKF-SLAM on anchored inverse depths, compiled.

Equations and source: :mod:`consistency.bench.filters.textbook.anchored`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from consistency.bench.filters.compiled import variants
from consistency.bench.filters.compiler.dispatch import implement, part
from consistency.bench.filters.compiler.jit import inner
from consistency.bench.filters.kernel.part_functions import (
    Frame,
    Triple,
    insert,
    landmark_width,
    to_body,
    to_body_jacobian,
    world_point,
)
from consistency.bench.filters.methods import ekf
from consistency.bench.filters.textbook.anchored import AnchoredKalman
from consistency.bench.scenario.models import Mounting, turned_to_robot
from consistency.referee.types import Array


@part(error="Additive", point="AtEstimate", covariance="Dense")
class AnchoredInverseDepth(NamedTuple):
    """No parameters."""


@implement(landmark_width, AnchoredInverseDepth)
def anchored_width(landmark: AnchoredInverseDepth) -> int:
    return 6


@inner
def _ray(values: Array) -> Triple:
    """Unit vector in the world of values (6,)."""
    c = np.cos(values[4])
    return c * np.cos(values[3]), c * np.sin(values[3]), np.sin(values[4])


@implement(to_body, AnchoredInverseDepth)
def to_body_of_anchored(landmark: AnchoredInverseDepth, frame: Frame, values: Array) -> Triple:
    mx, my, mz = _ray(values)
    x, y, z = values[0] + mx / values[5], values[1] + my / values[5], values[2] + mz / values[5]
    return turned_to_robot(frame.x, frame.y, frame.c, frame.s, x, y, z)


@implement(to_body_jacobian, AnchoredInverseDepth)
def to_body_jacobian_of_anchored(
    landmark: AnchoredInverseDepth, frame: Frame, values: Array, body: Triple, row: Triple, Hp: Array, Hl: Array
) -> None:
    """Hp (3,) <- by x, y, heading, Hl (6,) <- by the six numbers, through the point in the world."""
    c, s, d0, d1, d2 = frame.c, frame.s, row[0], row[1], row[2]
    _by_values(values, c * d0 - s * d1, s * d0 + c * d1, d2, Hl)
    Hp[0], Hp[1], Hp[2] = -Hl[0], -Hl[1], d0 * body[1] - d1 * body[0]


@inner
def _by_values(values: Array, g0: float, g1: float, g2: float, row: Array) -> None:
    """``row`` (6,) <- derivatives by the six numbers of a function with gradient g by the point in the world."""
    mx, my, mz = _ray(values)
    cz, sz, cn, rho = np.cos(values[3]), np.sin(values[3]), np.cos(values[4]), values[5]
    row[0], row[1], row[2] = g0, g1, g2
    row[3] = (-g0 * my + g1 * mx) / rho
    row[4] = (-g0 * mz * cz - g1 * mz * sz + g2 * cn) / rho
    row[5] = -(g0 * mx + g1 * my + g2 * mz) / (rho * rho)


@implement(insert, AnchoredInverseDepth)
def insert_anchored(
    landmark: AnchoredInverseDepth,
    frame: Frame,
    body: Triple,
    Jb: Array,
    mount: Mounting,
    values: Array,
    Jp: Array,
    Jz: Array,
) -> None:
    """values (6,) <- anchor, direction and inverse length of the ray to ``body``; Jp (6, 3), Jz (6, 3) <- Jacobians."""
    c, s = frame.c, frame.s
    q0, q1, dz = body[0] - mount.x, body[1] - mount.y, body[2] - mount.z
    dx, dy = c * q0 - s * q1, s * q0 + c * q1
    flat2 = dx * dx + dy * dy
    flat, length2 = np.sqrt(flat2), flat2 + dz * dz
    values[0] = frame.x + c * mount.x - s * mount.y
    values[1] = frame.y + s * mount.x + c * mount.y
    values[2] = mount.z
    values[3], values[4], values[5] = np.arctan2(dy, dx), np.arctan2(dz, flat), 1.0 / np.sqrt(length2)
    for a in range(6):
        for j in range(3):
            Jp[a, j] = Jz[a, j] = 0.0
    Jp[0, 0] = Jp[1, 1] = Jp[3, 2] = 1.0
    Jp[0, 2], Jp[1, 2] = -s * mount.x - c * mount.y, c * mount.x - s * mount.y
    third = values[5] / length2
    for j in range(3):
        ex, ey, ez = c * Jb[0, j] - s * Jb[1, j], s * Jb[0, j] + c * Jb[1, j], Jb[2, j]
        Jz[3, j] = (dx * ey - dy * ex) / flat2
        Jz[4, j] = (flat * ez - dz * (dx * ex + dy * ey) / flat) / length2
        Jz[5, j] = -(dx * ex + dy * ey + dz * ez) * third


@implement(world_point, AnchoredInverseDepth)
def anchored_world_point(
    landmark: AnchoredInverseDepth, frame: Frame, values: Array, point: Array, Dp: Array, Dl: Array
) -> None:
    m = _ray(values)
    for a in range(3):
        point[a] = values[a] + m[a] / values[5]
        Dp[a, 0] = Dp[a, 1] = Dp[a, 2] = 0.0
        _by_values(values, 1.0 if a == 0 else 0.0, 1.0 if a == 1 else 0.0, 1.0 if a == 2 else 0.0, Dl[a])


FILTERS = variants(AnchoredKalman, "anchored-ekf", ekf.parts, "xyz uvd", landmark=AnchoredInverseDepth())
