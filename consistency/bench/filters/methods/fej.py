"""EKF-SLAM with first-estimates Jacobians, compiled. Equations and source: :mod:`consistency.filters.textbook.fej`."""

from __future__ import annotations

from consistency.bench.filters.compiled import variants
from consistency.bench.filters.kernel.part_functions import Slam
from consistency.bench.filters.methods import ekf
from consistency.bench.filters.point.first_estimate import FirstEstimate
from consistency.bench.filters.textbook.fej import FirstEstimateKalman
from consistency.bench.protocols import Problem
from consistency.referee.types import Array


def parts(problem: Problem, controls: Array, uvd: bool) -> Slam:
    """Those of the EKF, and the point."""
    return ekf.parts(problem, controls, uvd)._replace(point=FirstEstimate())


XYZ, UVD, XY, RB = variants(FirstEstimateKalman, "fej-ekf", parts)
