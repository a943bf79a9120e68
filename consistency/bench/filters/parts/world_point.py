"""A point in world coordinates, m, in space or in the plane of a planar robot: Herath et al. (2007) eq. 19."""

from __future__ import annotations

from typing import NamedTuple

from consistency.bench.filters.compiler.dispatch import implement, part
from consistency.bench.filters.kernel.linalg import fill, fill_matrix
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
from consistency.bench.scenario import models
from consistency.bench.scenario.models import Mounting
from consistency.referee.types import Array


@part()
class WorldPoint(NamedTuple):
    """No parameters. x, y, z."""


@part(sensor="RelativeXy RangeBearing")
class PlanarPoint(NamedTuple):
    """No parameters. x, y at height zero."""


@implement(landmark_width, WorldPoint)
def world_point_width(landmark: WorldPoint) -> int:
    return 3


@implement(landmark_width, PlanarPoint)
def planar_point_width(landmark: PlanarPoint) -> int:
    return 2


@implement(to_body, PlanarPoint)
@implement(to_body, WorldPoint)
def to_body_of_point(landmark: NamedTuple, frame: Frame, values: Array) -> Triple:
    height = values[2] if len(values) > 2 else 0.0
    return models.turned_to_robot(frame.x, frame.y, frame.c, frame.s, values[0], values[1], height)


@implement(to_body_jacobian, PlanarPoint)
@implement(to_body_jacobian, WorldPoint)
def to_body_jacobian_of_point(
    landmark: NamedTuple, frame: Frame, values: Array, body: Triple, row: Triple, Hp: Array, Hl: Array
) -> None:
    """The ``row`` turned by the heading."""
    c, s, d0, d1 = frame.c, frame.s, row[0], row[1]
    Hl[0], Hl[1] = c * d0 - s * d1, s * d0 + c * d1
    if len(Hl) > 2:
        Hl[2] = row[2]
    Hp[0], Hp[1], Hp[2] = -Hl[0], -Hl[1], d0 * body[1] - d1 * body[0]


@implement(insert, PlanarPoint)
@implement(insert, WorldPoint)
def insert_point(
    landmark: NamedTuple, frame: Frame, body: Triple, Jb: Array, mount: Mounting, values: Array, Jp: Array, Jz: Array
) -> None:
    """By the inverse of eq. 19."""
    c, s, bx, by = frame.c, frame.s, body[0], body[1]
    values[0], values[1], height = models.turned_to_world(frame.x, frame.y, c, s, bx, by, body[2])
    fill_matrix(Jp, 0.0)
    Jp[0, 0] = Jp[1, 1] = 1.0
    Jp[0, 2], Jp[1, 2] = -s * bx - c * by, c * bx - s * by
    for j in range(Jz.shape[1]):
        Jz[0, j], Jz[1, j] = c * Jb[0, j] - s * Jb[1, j], s * Jb[0, j] + c * Jb[1, j]
        if len(Jz) > 2:
            values[2], Jz[2, j] = height, Jb[2, j]


@implement(world_point, PlanarPoint)
@implement(world_point, WorldPoint)
def point_itself(landmark: NamedTuple, frame: Frame, values: Array, point: Array, Dp: Array, Dl: Array) -> None:
    fill(point, 0.0)
    fill_matrix(Dp, 0.0)
    fill_matrix(Dl, 0.0)
    for a in range(len(values)):
        point[a], Dl[a, a] = values[a], 1.0


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
