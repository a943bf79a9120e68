"""A point in the frame of the sensor, Herath et al. (2007) eq. 19."""

from __future__ import annotations

from typing import NamedTuple

from consistency.filters.kernel.dispatch import implement, part
from consistency.filters.kernel.slam import Nine, Triple, locate, locate_jacobian, measure, measure_jacobian
from consistency.models.point import Mounting


@part()
class Xyz(NamedTuple):
    """Where the sensor is mounted."""

    mount: Mounting


@implement(measure, Xyz)
def measure_xyz(sensor: Xyz, x: float, y: float, z: float) -> Triple:
    """The point itself, in m."""
    return x, y, z


@implement(measure_jacobian, Xyz)
def measure_xyz_jacobian(sensor: Xyz, x: float, y: float, z: float) -> Nine:
    """Identity (3, 3), row after row."""
    return 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0


@implement(locate, Xyz)
def locate_xyz(sensor: Xyz, z0: float, z1: float, z2: float) -> Triple:
    """The observation itself, in m."""
    return z0, z1, z2


@implement(locate_jacobian, Xyz)
def locate_xyz_jacobian(sensor: Xyz, z0: float, z1: float, z2: float) -> Nine:
    """Identity (3, 3), row after row."""
    return 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0
