"""A point in world coordinates, x, y, z in m, seen from a planar robot: Herath et al. (2007) eq. 19."""

from __future__ import annotations

from typing import NamedTuple

from consistency.bench.filters.compiler.dispatch import implement, part
from consistency.bench.filters.kernel.arrays import copy, fill_matrix
from consistency.bench.filters.kernel.part_functions import (
    Frame,
    Triple,
    combine,
    insert,
    landmark_width,
    to_body,
    to_body_jacobian,
    world_point,
)
from consistency.bench.models import point
from consistency.bench.models.point import Mounting
from consistency.referee.types import Array


@part()
class WorldPoint(NamedTuple):
    """No parameters."""


@implement(landmark_width, WorldPoint)
def world_point_width(landmark: WorldPoint) -> int:
    """3: x, y, z in m."""
    return 3


@implement(to_body, WorldPoint)
def to_body_of_world_point(landmark: WorldPoint, frame: Frame, values: Array) -> Triple:
    """The point in the frame of the robot, in m, eq. 19."""
    return point.turned_to_robot(frame.x, frame.y, frame.c, frame.s, values[0], values[1], values[2])


@implement(to_body_jacobian, WorldPoint)
def to_body_jacobian_of_world_point(
    landmark: WorldPoint, frame: Frame, values: Array, body: Triple, row: Triple, Hp: Array, Hl: Array
) -> None:
    """Hp (3,) <- by x, y, heading, Hl (3,) <- by the point in the world: the ``row`` turned by the heading."""
    c, s, d0, d1, d2 = frame.c, frame.s, row[0], row[1], row[2]
    Hl[0], Hl[1], Hl[2] = c * d0 - s * d1, s * d0 + c * d1, d2
    Hp[0], Hp[1], Hp[2] = -Hl[0], -Hl[1], d0 * body[1] - d1 * body[0]


@implement(insert, WorldPoint)
def insert_world_point(
    landmark: WorldPoint,
    frame: Frame,
    body: Triple,
    Jb: Array,
    mount: Mounting,
    values: Array,
    Jp: Array,
    Jz: Array,
) -> None:
    """values (3,) <- the inverse of eq. 19; Jp (3, 3), Jz (3, 3) <- its Jacobians."""
    c, s, bx, by = frame.c, frame.s, body[0], body[1]
    values[0], values[1], values[2] = point.turned_to_world(frame.x, frame.y, c, s, bx, by, body[2])
    fill_matrix(Jp, 0.0)
    Jp[0, 0] = Jp[1, 1] = 1.0
    Jp[0, 2], Jp[1, 2] = -s * bx - c * by, c * bx - s * by
    for j in range(3):
        Jz[0, j], Jz[1, j], Jz[2, j] = c * Jb[0, j] - s * Jb[1, j], s * Jb[0, j] + c * Jb[1, j], Jb[2, j]


@implement(world_point, WorldPoint)
def world_point_itself(landmark: WorldPoint, frame: Frame, values: Array, point: Array, Dp: Array, Dl: Array) -> None:
    """point (3,) <- values (3,); Dp (3, r) <- 0, Dl (3, 3) <- 1."""
    copy(values, point)
    fill_matrix(Dp, 0.0)
    fill_matrix(Dl, 0.0)
    Dl[0, 0] = Dl[1, 1] = Dl[2, 2] = 1.0


@implement(combine, WorldPoint)
def combine_world_point(landmark: WorldPoint, Hp: Array, Hl: Array, rows: Array, i: int, out: Array) -> None:
    """out (3, width) <- H P, written out for three variables each of robot and landmark."""
    p0, p1, p2 = rows[0], rows[1], rows[2]
    l0, l1, l2 = rows[3 * i + 3], rows[3 * i + 4], rows[3 * i + 5]
    for a in range(3):
        row = out[a]
        g0, g1, g2, h0, h1, h2 = Hp[a, 0], Hp[a, 1], Hp[a, 2], Hl[a, 0], Hl[a, 1], Hl[a, 2]
        for j in range(len(row)):
            row[j] = g0 * p0[j] + g1 * p1[j] + g2 * p2[j] + h0 * l0[j] + h1 * l1[j] + h2 * l2[j]
