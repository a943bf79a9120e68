"""EKF-SLAM, compiled. Equations and source: :mod:`consistency.filters.textbook.ekf`."""

from __future__ import annotations

from consistency.bench.filters.belief_parts import landmark_of, motion_of, sensor_of
from consistency.bench.filters.compiled import Compiled, planar
from consistency.bench.filters.covariance_update.dense import Dense
from consistency.bench.filters.error.additive import Additive
from consistency.bench.filters.kernel.part_functions import Slam
from consistency.bench.filters.point.at_estimate import AtEstimate
from consistency.bench.filters.textbook.ekf import ExtendedKalman
from consistency.bench.filters.update.joint_update import Joint
from consistency.bench.protocols import Problem
from consistency.referee.types import Array


def xyz_parts(problem: Problem, controls: Array) -> Slam:
    """Parts of ``ekf-xyz``, and with landmarks in the plane where the sensor has them."""
    belief = problem.belief
    sensor = sensor_of(belief, uvd=False)
    return Slam(motion_of(belief), sensor, landmark_of(belief), Additive(), AtEstimate(), Joint(), Dense())


def uvd_parts(problem: Problem, controls: Array) -> Slam:
    """Parts of ``ekf-uvd``."""
    return xyz_parts(problem, controls)._replace(sensor=sensor_of(problem.belief, uvd=True))


XYZ = Compiled(ExtendedKalman("ekf-xyz", uvd=False), xyz_parts, sensors=("xyz", "uvd"), uvd=False)
UVD = Compiled(ExtendedKalman("ekf-uvd", uvd=True), uvd_parts, sensors=("uvd",), uvd=True)
XY, RB = planar(ExtendedKalman, "ekf", xyz_parts)
