"""UKF-SLAM and cubature SLAM, compiled. Equations and source: :mod:`consistency.bench.filters.textbook.ukf`."""

from __future__ import annotations

from functools import partial

from consistency.bench.filters.compiled import variants
from consistency.bench.filters.kernel.part_functions import Slam
from consistency.bench.filters.methods import ekf
from consistency.bench.filters.textbook.ukf import CUBATURE, UnscentedKalman
from consistency.bench.filters.update.unscented import Unscented
from consistency.bench.protocols import Problem
from consistency.referee.types import Array


def parts(problem: Problem, controls: Array, uvd: bool) -> Slam:
    points = problem.belief.sigma_points
    return ekf.parts(problem, controls, uvd)._replace(update=Unscented(points.alpha, points.beta, points.kappa))


XYZ, UVD, XY, RB = variants(UnscentedKalman, "ukf", parts)
CKF_XYZ, CKF_UVD = variants(
    partial(UnscentedKalman, points=CUBATURE), "ckf", ekf.parts, "xyz uvd",
    update=Unscented(CUBATURE.alpha, CUBATURE.beta, CUBATURE.kappa),
)  # fmt: skip
