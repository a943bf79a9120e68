"""Observability-constrained EKF-SLAM, compiled. Equations and source: :mod:`consistency.filters.textbook.oc`."""

from __future__ import annotations

from consistency.bench.filters.compiled import Compiled, planar
from consistency.bench.filters.kernel.part_functions import Slam
from consistency.bench.filters.methods import ekf
from consistency.bench.filters.point.observability_constrained import ObservabilityConstrained
from consistency.bench.filters.textbook.oc import ConstrainedKalman
from consistency.bench.protocols import Problem
from consistency.referee.types import Array


def xyz_parts(problem: Problem, controls: Array) -> Slam:
    """Parts of ``oc-ekf-xyz``, and with landmarks in the plane where the sensor has them."""
    return ekf.xyz_parts(problem, controls)._replace(point=ObservabilityConstrained())


def uvd_parts(problem: Problem, controls: Array) -> Slam:
    """Parts of ``oc-ekf-uvd``."""
    return ekf.uvd_parts(problem, controls)._replace(point=ObservabilityConstrained())


XYZ = Compiled(ConstrainedKalman("oc-ekf-xyz", uvd=False), xyz_parts, sensors=("xyz", "uvd"), uvd=False)
UVD = Compiled(ConstrainedKalman("oc-ekf-uvd", uvd=True), uvd_parts, sensors=("uvd",), uvd=True)
XY, RB = planar(ConstrainedKalman, "oc-ekf", xyz_parts)
