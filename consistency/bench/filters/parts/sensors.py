"""What a mounted sensor measures of a point: h, its inverse and their Jacobians."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from consistency.bench.filters.compiler.dispatch import implement, part
from consistency.bench.filters.compiler.jit import inner
from consistency.bench.filters.kernel.part_functions import (
    Nine,
    Pair,
    Six,
    Triple,
    locate,
    locate_jacobian,
    measure,
    measure_jacobian,
    observed_width,
    wrap_residual,
)
from consistency.bench.scenario import BelievedSensor, models
from consistency.bench.scenario.models import Mounting
from consistency.referee.types import Array


@part()
class Xyz(NamedTuple):
    """A point in the frame of the sensor, m, Herath et al. (2007) eq. 19; where the sensor is mounted."""

    mount: Mounting


@part()
class Uvd(NamedTuple):
    """Rectified stereo (u, v, disparity) in px, eq. 21, 22: focal length in px, baseline in m, where it is mounted."""

    f: float
    B: float
    mount: Mounting


@part(landmark="PlanarPoint")
class RelativeXy(NamedTuple):
    """Position of a landmark in the plane in the frame of the sensor, dx and dy in m, and where the sensor is mounted.

    Huang, Mourikis & Roumeliotis (2010) eq. 5.
    """

    mount: Mounting


@part(landmark="PlanarPoint")
class RangeBearing(NamedTuple):
    """Range in m and bearing in rad of a landmark in the plane, counter-clockwise from the axis of the sensor."""

    mount: Mounting


class Growth(NamedTuple):
    """Ratio of the noise of a disparity to its sigma, linear between nodes and constant beyond them."""

    disparity: Array  # (K,), px, increasing
    ratio: Array  # (K,)


def growth_of(sensor: BelievedSensor) -> Growth:
    """The growth that a belief holds; 1 everywhere if it holds none."""
    growth = sensor.disparity_growth
    if growth is None:
        return Growth(np.ones(1), np.ones(1))
    return Growth(np.array(growth.disparity), np.array(growth.ratio))


@inner
def ratio_at(growth: Growth, d: float) -> float:
    """The ratio at a disparity d in px."""
    nodes, ratio = growth.disparity, growth.ratio
    value: float = ratio[len(nodes) - 1]
    for i in range(len(nodes) - 1, 0, -1):
        if d < nodes[i]:
            value = ratio[i - 1] + (ratio[i] - ratio[i - 1]) / (nodes[i] - nodes[i - 1]) * (d - nodes[i - 1])
    if d <= nodes[0]:
        value = ratio[0]
    return value


@implement(observed_width, Uvd)
@implement(observed_width, Xyz)
def three_values(sensor: NamedTuple) -> int:
    return 3


@implement(observed_width, RangeBearing)
@implement(observed_width, RelativeXy)
def two_values(sensor: NamedTuple) -> int:
    return 2


@implement(measure, Xyz)
def measure_xyz(sensor: Xyz, x: float, y: float, z: float) -> Triple:
    return x, y, z


@implement(measure_jacobian, Xyz)
def measure_xyz_jacobian(sensor: Xyz, x: float, y: float, z: float) -> Nine:
    return 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0


@implement(locate, Xyz)
def locate_xyz(sensor: Xyz, z: Array) -> Triple:
    return z[0], z[1], z[2]


@implement(locate_jacobian, Xyz)
def locate_xyz_jacobian(sensor: Xyz, z: Array) -> Nine:
    return 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0


@implement(measure, Uvd)
def measure_uvd(sensor: Uvd, x: float, y: float, z: float) -> Triple:
    return models.project(x, y, z, sensor.f, sensor.B)


@implement(measure_jacobian, Uvd)
def measure_uvd_jacobian(sensor: Uvd, x: float, y: float, z: float) -> Nine:
    return models.project_jacobian(x, y, z, sensor.f, sensor.B)


@implement(locate, Uvd)
def locate_uvd(sensor: Uvd, z: Array) -> Triple:
    return models.triangulate(z[0], z[1], z[2], sensor.f, sensor.B)


@implement(locate_jacobian, Uvd)
def locate_uvd_jacobian(sensor: Uvd, z: Array) -> Nine:
    return models.triangulate_jacobian(z[0], z[1], z[2], sensor.f, sensor.B)


@implement(measure, RelativeXy)
def measure_relative_xy(sensor: RelativeXy, x: float, y: float, z: float) -> Pair:
    return x, y


@implement(measure_jacobian, RelativeXy)
def measure_relative_xy_jacobian(sensor: RelativeXy, x: float, y: float, z: float) -> Six:
    return 1.0, 0.0, 0.0, 0.0, 1.0, 0.0


@implement(locate, RelativeXy)
def locate_relative_xy(sensor: RelativeXy, z: Array) -> Triple:
    return z[0], z[1], 0.0


@implement(locate_jacobian, RelativeXy)
def locate_relative_xy_jacobian(sensor: RelativeXy, z: Array) -> Six:
    return 1.0, 0.0, 0.0, 1.0, 0.0, 0.0


@implement(wrap_residual, RangeBearing)
def wrap_bearing(sensor: RangeBearing, z: Array, about: Array) -> None:
    z[1] += 2.0 * np.pi * np.rint((about[1] - z[1]) / (2.0 * np.pi))


@implement(measure, RangeBearing)
def measure_range_bearing(sensor: RangeBearing, x: float, y: float, z: float) -> Pair:
    return models.range_bearing(x, y)


@implement(measure_jacobian, RangeBearing)
def measure_range_bearing_jacobian(sensor: RangeBearing, x: float, y: float, z: float) -> Six:
    rx, ry, bx, by = models.range_bearing_jacobian(x, y)
    return rx, ry, 0.0, bx, by, 0.0


@implement(locate, RangeBearing)
def locate_range_bearing(sensor: RangeBearing, z: Array) -> Triple:
    x, y = models.at_range_bearing(z[0], z[1])
    return x, y, 0.0


@implement(locate_jacobian, RangeBearing)
def locate_range_bearing_jacobian(sensor: RangeBearing, z: Array) -> Six:
    xr, xb, yr, yb = models.at_range_bearing_jacobian(z[0], z[1])
    return xr, xb, yr, yb, 0.0, 0.0
