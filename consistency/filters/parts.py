"""Parts that carry what a filter believes."""

from __future__ import annotations

from consistency.filters.kernel.slam import Sensor
from consistency.filters.motion.unicycle import Unicycle
from consistency.filters.sensor.uvd import Uvd
from consistency.filters.sensor.xyz import Xyz
from consistency.scenario import Belief


def motion_of(belief: Belief) -> Unicycle:
    """Eq. 18 with the believed noise."""
    return Unicycle(belief.motion.sigma_v, belief.motion.sigma_omega)


def sensor_of(belief: Belief, uvd: bool) -> Sensor:
    """Eq. 22 with the believed rig, or eq. 19."""
    sensor = belief.sensor
    if uvd:
        return Uvd(sensor.f or 0.0, sensor.B or 0.0, sensor.mount.packed())
    return Xyz(sensor.mount.packed())
