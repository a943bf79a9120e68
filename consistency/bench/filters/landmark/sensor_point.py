"""A landmark as its position in the frame of the sensor, m, whose map moves, with the polar error of its symmetry.

The error is (left, up, s): turns about the axes across the line of sight, in rad, and the logarithm of the scale. See
``methods/equivariant.py``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from consistency.bench.filters.compiler.dispatch import implement, part
from consistency.bench.filters.compiler.jit import inner
from consistency.bench.filters.kernel.arrays import fill, fill_matrix
from consistency.bench.filters.kernel.part_functions import (
    Nine,
    Triple,
    combine,
    insert,
    landmark_width,
    to_body,
    to_body_jacobian,
    world_point,
)
from consistency.bench.filters.landmark.inverse_range import inward, outward
from consistency.bench.filters.landmark.world_point import combine_world_point
from consistency.bench.filters.motion.unicycle import Frame
from consistency.bench.models import point
from consistency.bench.models.point import Mounting
from consistency.referee.types import Array


@part(error="Polar", update="EquivariantOutput", covariance="Dense")
class SensorPoint(NamedTuple):
    """Where the sensor is mounted on the robot. A landmark is its position in the frame of the sensor, m."""

    mount: Mounting


@inner
def sight(q: Array) -> tuple[Nine, float]:
    """The unit vectors b1, b2, n of the line of sight to q (3,), and its length in m."""
    h = np.sqrt(q[0] * q[0] + q[1] * q[1])
    r = np.sqrt(h * h + q[2] * q[2])
    c, s = (q[0] / h, q[1] / h) if h > 0.0 else (1.0, 0.0)
    up, flat = q[2] / r, h / r
    return (-s, c, 0.0, -up * c, -up * s, flat, flat * c, flat * s, up), r


@implement(landmark_width, SensorPoint)
def sensor_point_width(landmark: SensorPoint) -> int:
    return 3


@implement(to_body, SensorPoint)
def to_body_of_sensor_point(landmark: SensorPoint, frame: Frame, values: Array) -> Triple:
    return point.from_sensor(values[0], values[1], values[2], landmark.mount)


@implement(to_body_jacobian, SensorPoint)
def to_body_jacobian_of_sensor_point(
    landmark: SensorPoint, frame: Frame, values: Array, body: Triple, row: Triple, Hp: Array, Hl: Array
) -> None:
    fill(Hp, 0.0)
    Hl[0], Hl[1], Hl[2] = inward(landmark.mount, row[0], row[1], row[2])


@implement(insert, SensorPoint)
def insert_sensor_point(
    landmark: SensorPoint, frame: Frame, body: Triple, Jb: Array, mount: Mounting, values: Array, Jp: Array, Jz: Array
) -> None:
    """``Jz`` (3, 3) is that of the polar error."""
    values[0], values[1], values[2] = point.to_sensor(body[0], body[1], body[2], mount)
    e, r = sight(values)
    fill_matrix(Jp, 0.0)
    for j in range(3):
        x, y, z = inward(mount, Jb[0, j], Jb[1, j], Jb[2, j])
        for a in range(3):
            Jz[a, j] = (e[3 * a] * x + e[3 * a + 1] * y + e[3 * a + 2] * z) / r


@implement(world_point, SensorPoint)
def sensor_point_in_world(
    landmark: SensorPoint, frame: Frame, values: Array, point_: Array, Dp: Array, Dl: Array
) -> None:
    mount, c, s = landmark.mount, frame.c, frame.s
    bx, by, bz = point.from_sensor(values[0], values[1], values[2], mount)
    point_[0], point_[1], point_[2] = point.turned_to_world(frame.x, frame.y, c, s, bx, by, bz)
    fill_matrix(Dp, 0.0)
    Dp[0, 0] = Dp[1, 1] = 1.0
    Dp[0, 2], Dp[1, 2] = frame.y - point_[1], point_[0] - frame.x
    for j in range(3):
        x, y, z = outward(mount, 1.0 if j == 0 else 0.0, 1.0 if j == 1 else 0.0, 1.0 if j == 2 else 0.0)
        Dl[0, j], Dl[1, j], Dl[2, j] = c * x - s * y, s * x + c * y, z


implement(combine, SensorPoint)(combine_world_point)
