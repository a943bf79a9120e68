"""Parts that carry what a filter believes."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from consistency.bench.filters.landmark.world_point import PlanarPoint, WorldPoint
from consistency.bench.filters.motion.unicycle import Unicycle
from consistency.bench.filters.sensor.models import RangeBearing, RelativeXy, Uvd, Xyz
from consistency.bench.models.point import Mounting
from consistency.bench.scenario import Belief

PLANAR: dict[str, Callable[[Mounting], NamedTuple]] = {
    "relative-xy": RelativeXy,
    "range-bearing": RangeBearing,
}  # sensors of landmarks in the plane, by model


def motion_of(belief: Belief) -> Unicycle:
    """Eq. 18 with the believed noise."""
    return Unicycle(belief.motion.sigma_v, belief.motion.sigma_omega)


def sensor_of(belief: Belief, uvd: bool) -> NamedTuple:
    """Eq. 22 with the believed rig, a sensor of landmarks in the plane, or eq. 19."""
    sensor = belief.sensor
    if sensor.model in PLANAR:
        return PLANAR[sensor.model](sensor.mount.packed())
    if uvd:
        return Uvd(sensor.f or 0.0, sensor.B or 0.0, sensor.mount.packed())
    return Xyz(sensor.mount.packed())


def landmark_of(belief: Belief) -> PlanarPoint | WorldPoint:
    """A point in the world, in the plane where the sensor measures no heights."""
    return PlanarPoint() if belief.sensor.model in PLANAR else WorldPoint()
