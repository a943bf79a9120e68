"""Position of a landmark in the frame of the sensor, dx and dy in m: Huang, Mourikis & Roumeliotis (2010) eq. 5."""

from __future__ import annotations

from typing import NamedTuple

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
)
from consistency.bench.models.point import Mounting
from consistency.referee.types import Array


@part(landmark="PlanarPoint")
class RelativeXy(NamedTuple):
    """Where the sensor is mounted."""

    mount: Mounting


@implement(observed_width, RelativeXy)
def relative_xy_width(sensor: RelativeXy) -> int:
    """2: dx, dy in m."""
    return 2


@implement(measure, RelativeXy)
def measure_relative_xy(sensor: RelativeXy, x: float, y: float, z: float) -> Pair:
    """The point itself, in m; its height has no part in it."""
    return x, y


@implement(measure_jacobian, RelativeXy)
def measure_relative_xy_jacobian(sensor: RelativeXy, x: float, y: float, z: float) -> Six:
    """The first two rows of the identity."""
    return 1.0, 0.0, 0.0, 0.0, 1.0, 0.0


@implement(locate, RelativeXy)
def locate_relative_xy(sensor: RelativeXy, z: Array) -> Triple:
    """The observation itself, in m, at the height of the sensor."""
    return z[0], z[1], 0.0


@implement(locate_jacobian, RelativeXy)
def locate_relative_xy_jacobian(sensor: RelativeXy, z: Array) -> Six:
    """The first two columns of the identity, row after row."""
    return 1.0, 0.0, 0.0, 1.0, 0.0, 0.0
