"""Rectified stereo (u, v, disparity) in px, Herath et al. (2007) eq. 21 and 22."""

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
from consistency.bench.models import stereo
from consistency.bench.models.point import Mounting
from consistency.referee.types import Array


@part()
class Uvd(NamedTuple):
    """Focal length in px, baseline in m, and where the sensor is mounted."""

    f: float
    B: float
    mount: Mounting


@implement(observed_width, Uvd)
def uvd_width(sensor: Uvd) -> int:
    """3: u, v, d in px."""
    return 3


@implement(measure, Uvd)
def measure_uvd(sensor: Uvd, x: float, y: float, z: float) -> Triple:
    """(u, v, d) in px of a point in m, eq. 22."""
    return stereo.project(x, y, z, sensor.f, sensor.B)


@implement(measure_jacobian, Uvd)
def measure_uvd_jacobian(sensor: Uvd, x: float, y: float, z: float) -> Nine:
    """Jacobian (3, 3) of eq. 22, px/m, row after row."""
    return stereo.project_jacobian(x, y, z, sensor.f, sensor.B)


@implement(locate, Uvd)
def locate_uvd(sensor: Uvd, z: Array) -> Triple:
    """Point in m of (u, v, d) in px, eq. 21."""
    return stereo.triangulate(z[0], z[1], z[2], sensor.f, sensor.B)


@implement(locate_jacobian, Uvd)
def locate_uvd_jacobian(sensor: Uvd, z: Array) -> Nine:
    """Jacobian (3, 3) of eq. 21, m/px, row after row."""
    return stereo.triangulate_jacobian(z[0], z[1], z[2], sensor.f, sensor.B)
