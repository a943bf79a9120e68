"""EKF-SLAM with first-estimates Jacobians, compiled. Equations and source: :mod:`consistency.filters.textbook.fej`."""

from __future__ import annotations

from consistency.bench.filters.compiled import Compiled, planar
from consistency.bench.filters.kernel.part_functions import Slam
from consistency.bench.filters.methods import ekf
from consistency.bench.filters.point.first_estimate import FirstEstimate
from consistency.bench.filters.textbook.fej import FirstEstimateKalman
from consistency.bench.protocols import Problem
from consistency.referee.types import Array


def xyz_parts(problem: Problem, controls: Array) -> Slam:
    """Parts of ``fej-ekf-xyz``, and with landmarks in the plane where the sensor has them."""
    return ekf.xyz_parts(problem, controls)._replace(point=FirstEstimate())


def uvd_parts(problem: Problem, controls: Array) -> Slam:
    """Parts of ``fej-ekf-uvd``."""
    return ekf.uvd_parts(problem, controls)._replace(point=FirstEstimate())


XYZ = Compiled(FirstEstimateKalman("fej-ekf-xyz", uvd=False), xyz_parts, sensors=("xyz", "uvd"), uvd=False)
UVD = Compiled(FirstEstimateKalman("fej-ekf-uvd", uvd=True), uvd_parts, sensors=("uvd",), uvd=True)
XY, RB = planar(FirstEstimateKalman, "fej-ekf", xyz_parts)
