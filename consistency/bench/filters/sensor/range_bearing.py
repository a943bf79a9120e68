"""Range in m and bearing in rad of a landmark in the plane, counter-clockwise from the axis of the sensor."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from consistency.bench.filters.compiler.dispatch import implement, part
from consistency.bench.filters.kernel.part_functions import (
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
from consistency.bench.models import planar
from consistency.bench.models.point import Mounting
from consistency.referee.types import Array


@part(landmark="PlanarPoint")
class RangeBearing(NamedTuple):
    """Where the sensor is mounted."""

    mount: Mounting


@implement(observed_width, RangeBearing)
def range_bearing_width(sensor: RangeBearing) -> int:
    """2: range in m, bearing in rad."""
    return 2


@implement(wrap_residual, RangeBearing)
def wrap_bearing(sensor: RangeBearing, z: Array, about: Array) -> None:
    """The bearing of z (2,) <- the same by full turns, within half a turn of that of ``about`` (2,)."""
    z[1] += 2.0 * np.pi * np.rint((about[1] - z[1]) / (2.0 * np.pi))


@implement(measure, RangeBearing)
def measure_range_bearing(sensor: RangeBearing, x: float, y: float, z: float) -> Pair:
    """Range and bearing of a point in m; its height has no part in it."""
    return planar.range_bearing(x, y)


@implement(measure_jacobian, RangeBearing)
def measure_range_bearing_jacobian(sensor: RangeBearing, x: float, y: float, z: float) -> Six:
    """Jacobian (2, 3), row after row."""
    rx, ry, bx, by = planar.range_bearing_jacobian(x, y)
    return rx, ry, 0.0, bx, by, 0.0


@implement(locate, RangeBearing)
def locate_range_bearing(sensor: RangeBearing, z: Array) -> Triple:
    """The point in m, at the height of the sensor."""
    x, y = planar.at_range_bearing(z[0], z[1])
    return x, y, 0.0


@implement(locate_jacobian, RangeBearing)
def locate_range_bearing_jacobian(sensor: RangeBearing, z: Array) -> Six:
    """Jacobian (3, 2), row after row."""
    xr, xb, yr, yb = planar.at_range_bearing_jacobian(z[0], z[1])
    return xr, xb, yr, yb, 0.0, 0.0
