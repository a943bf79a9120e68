"""EKF-SLAM, compiled. Equations and source: :mod:`consistency.bench.filters.textbook.ekf`."""

from __future__ import annotations

from typing import Any

from consistency.bench.filters.compiled import variants
from consistency.bench.filters.covariance_update.dense import Dense
from consistency.bench.filters.error.additive import Additive
from consistency.bench.filters.kernel.part_functions import Slam
from consistency.bench.filters.landmark.world_point import PlanarPoint, WorldPoint
from consistency.bench.filters.motion.unicycle import Unicycle
from consistency.bench.filters.point.at_estimate import AtEstimate
from consistency.bench.filters.sensor.models import RangeBearing, RelativeXy, Uvd, Xyz
from consistency.bench.filters.textbook.ekf import ExtendedKalman
from consistency.bench.filters.update.joint_update import Joint
from consistency.bench.protocols import Problem
from consistency.bench.scenario import PLANAR_SENSORS, Belief
from consistency.referee.types import Array


def sensor_of(belief: Belief, uvd: bool) -> Any:
    """Eq. 22 with the believed rig, a sensor of landmarks in the plane, or eq. 19."""
    sensor = belief.sensor
    mount = sensor.mount.packed()
    if uvd and sensor.model not in PLANAR_SENSORS:
        return Uvd(sensor.f or 0.0, sensor.B or 0.0, mount)
    return {"relative-xy": RelativeXy, "range-bearing": RangeBearing}.get(sensor.model, Xyz)(mount)


def parts(problem: Problem, controls: Array, uvd: bool) -> Slam:
    """Eq. 18 with the believed noise, the sensor, and points in the world, in its plane if no heights are measured."""
    belief = problem.belief
    landmark = PlanarPoint() if belief.sensor.model in PLANAR_SENSORS else WorldPoint()
    motion, sensor = Unicycle(belief.motion.sigma_v, belief.motion.sigma_omega), sensor_of(belief, uvd)
    return Slam(motion, sensor, landmark, Additive(), AtEstimate(), Joint(), Dense())


XYZ, UVD, XY, RB = variants(ExtendedKalman, "ekf", parts)
