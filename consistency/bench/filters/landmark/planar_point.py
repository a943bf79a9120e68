"""A point in the plane of a planar robot, x and y in m in world coordinates."""

from __future__ import annotations

from typing import NamedTuple

from consistency.bench.filters.compiler.dispatch import implement, part
from consistency.bench.filters.kernel.arrays import fill_matrix
from consistency.bench.filters.kernel.covariance import combine_rows
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


@part(sensor="RelativeXy RangeBearing")
class PlanarPoint(NamedTuple):
    """No parameters."""


@implement(landmark_width, PlanarPoint)
def planar_point_width(landmark: PlanarPoint) -> int:
    """2: x, y in m."""
    return 2


@implement(to_body, PlanarPoint)
def to_body_of_planar_point(landmark: PlanarPoint, frame: Frame, values: Array) -> Triple:
    """The point in the frame of the robot, in m, at height zero."""
    return point.turned_to_robot(frame.x, frame.y, frame.c, frame.s, values[0], values[1], 0.0)


@implement(to_body_jacobian, PlanarPoint)
def to_body_jacobian_of_planar_point(
    landmark: PlanarPoint, frame: Frame, values: Array, body: Triple, row: Triple, Hp: Array, Hl: Array
) -> None:
    """Hp (3,) <- by x, y, heading, Hl (2,) <- by the point in the world: the ``row`` turned by the heading."""
    c, s, d0, d1 = frame.c, frame.s, row[0], row[1]
    Hl[0], Hl[1] = c * d0 - s * d1, s * d0 + c * d1
    Hp[0], Hp[1], Hp[2] = -Hl[0], -Hl[1], d0 * body[1] - d1 * body[0]


@implement(insert, PlanarPoint)
def insert_planar_point(
    landmark: PlanarPoint,
    frame: Frame,
    body: Triple,
    Jb: Array,
    mount: Mounting,
    values: Array,
    Jp: Array,
    Jz: Array,
) -> None:
    """values (2,) <- the point in the world; Jp (2, 3), Jz (2, s) <- its Jacobians."""
    c, s, bx, by = frame.c, frame.s, body[0], body[1]
    values[0], values[1], _ = point.turned_to_world(frame.x, frame.y, c, s, bx, by, 0.0)
    fill_matrix(Jp, 0.0)
    Jp[0, 0] = Jp[1, 1] = 1.0
    Jp[0, 2], Jp[1, 2] = -s * bx - c * by, c * bx - s * by
    for j in range(Jz.shape[1]):
        Jz[0, j], Jz[1, j] = c * Jb[0, j] - s * Jb[1, j], s * Jb[0, j] + c * Jb[1, j]


@implement(world_point, PlanarPoint)
def planar_point_itself(landmark: PlanarPoint, frame: Frame, values: Array, point: Array, Dp: Array, Dl: Array) -> None:
    """point (3,) <- values (2,) at height zero; Dp (3, r) <- 0, Dl (3, 2) <- 1 in its first two rows."""
    point[0], point[1], point[2] = values[0], values[1], 0.0
    fill_matrix(Dp, 0.0)
    fill_matrix(Dl, 0.0)
    Dl[0, 0] = Dl[1, 1] = 1.0


@implement(combine, PlanarPoint)
def combine_planar_point(landmark: PlanarPoint, Hp: Array, Hl: Array, rows: Array, i: int, out: Array) -> None:
    """out (s, width) <- H P, by the version for any width."""
    combine_rows(Hp, Hl, rows, i, out)
