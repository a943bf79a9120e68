"""Cubature SLAM, compiled. Equations and source: :mod:`consistency.filters.textbook.ckf`."""

from __future__ import annotations

from consistency.bench.filters.compiled import variants
from consistency.bench.filters.kernel.part_functions import Slam
from consistency.bench.filters.methods import ekf
from consistency.bench.filters.textbook.ckf import CUBATURE, CubatureKalman
from consistency.bench.filters.update.unscented import Unscented
from consistency.bench.protocols import Problem
from consistency.referee.types import Array


def parts(problem: Problem, controls: Array, uvd: bool) -> Slam:
    """Those of the EKF, and the update."""
    return ekf.parts(problem, controls, uvd)._replace(update=Unscented(CUBATURE.alpha, CUBATURE.beta, CUBATURE.kappa))


XYZ, UVD = variants(CubatureKalman, "ckf", parts, "xyz uvd")
