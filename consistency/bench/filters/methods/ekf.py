"""EKF-SLAM, compiled. Equations and source: :mod:`consistency.bench.filters.textbook.ekf`."""

from __future__ import annotations

from consistency.bench.filters.belief_parts import landmark_of, motion_of, sensor_of
from consistency.bench.filters.compiled import variants
from consistency.bench.filters.covariance_update.dense import Dense
from consistency.bench.filters.error.additive import Additive
from consistency.bench.filters.kernel.part_functions import Slam
from consistency.bench.filters.point.at_estimate import AtEstimate
from consistency.bench.filters.textbook.ekf import ExtendedKalman
from consistency.bench.filters.update.joint_update import Joint
from consistency.bench.protocols import Problem
from consistency.referee.types import Array


def parts(problem: Problem, controls: Array, uvd: bool) -> Slam:
    """Parts of the EKF on pixels, or on points, with landmarks in the plane where the sensor has them."""
    belief = problem.belief
    sensor = sensor_of(belief, uvd)
    return Slam(motion_of(belief), sensor, landmark_of(belief), Additive(), AtEstimate(), Joint(), Dense())


XYZ, UVD, XY, RB = variants(ExtendedKalman, "ekf", parts)
