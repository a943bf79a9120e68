"""A point in the frame of the sensor, Herath et al. (2007) eq. 19."""

from __future__ import annotations

from typing import NamedTuple

from consistency.bench.filters.compiler.dispatch import implement, part
from consistency.bench.filters.kernel.part_functions import (
    Nine,
    Triple,
    locate,
    locate_jacobian,
    measure,
    measure_jacobian,
    observed_width,
)
from consistency.bench.models.point import Mounting
from consistency.referee.types import Array


@part()
class Xyz(NamedTuple):
    """Where the sensor is mounted."""

    mount: Mounting


@implement(observed_width, Xyz)
def xyz_width(sensor: Xyz) -> int:
    """3: x, y, z in m."""
    return 3


@implement(measure, Xyz)
def measure_xyz(sensor: Xyz, x: float, y: float, z: float) -> Triple:
    """The point itself, in m."""
    return x, y, z


@implement(measure_jacobian, Xyz)
def measure_xyz_jacobian(sensor: Xyz, x: float, y: float, z: float) -> Nine:
    """Identity (3, 3), row after row."""
    return 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0


@implement(locate, Xyz)
def locate_xyz(sensor: Xyz, z: Array) -> Triple:
    """The observation itself, in m."""
    return z[0], z[1], z[2]


@implement(locate_jacobian, Xyz)
def locate_xyz_jacobian(sensor: Xyz, z: Array) -> Nine:
    """Identity (3, 3), row after row."""
    return 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0
