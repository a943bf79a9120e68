"""Cubature SLAM, compiled. Equations and source: :mod:`consistency.filters.textbook.ckf`."""

from __future__ import annotations

from consistency.bench.filters.compiled import Compiled
from consistency.bench.filters.kernel.part_functions import Slam
from consistency.bench.filters.methods import ukf
from consistency.bench.filters.textbook.ckf import CUBATURE, CubatureKalman
from consistency.bench.filters.update.unscented import Unscented
from consistency.bench.protocols import Problem
from consistency.referee.types import Array


def xyz_parts(problem: Problem, controls: Array) -> Slam:
    """Parts of ``ckf-xyz``."""
    points = Unscented(CUBATURE.alpha, CUBATURE.beta, CUBATURE.kappa)
    return ukf.xyz_parts(problem, controls)._replace(update=points)


def uvd_parts(problem: Problem, controls: Array) -> Slam:
    """Parts of ``ckf-uvd``."""
    return xyz_parts(problem, controls)._replace(sensor=ukf.uvd_parts(problem, controls).sensor)


XYZ = Compiled(CubatureKalman("ckf-xyz", uvd=False), xyz_parts, sensors=("xyz", "uvd"), uvd=False)
UVD = Compiled(CubatureKalman("ckf-uvd", uvd=True), uvd_parts, sensors=("uvd",), uvd=True)
