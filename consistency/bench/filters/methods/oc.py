"""Observability-constrained EKF-SLAM, compiled. Equations and source: :mod:`consistency.filters.textbook.oc`."""

from __future__ import annotations

from consistency.bench.filters.compiled import variants
from consistency.bench.filters.kernel.part_functions import Slam
from consistency.bench.filters.methods import ekf
from consistency.bench.filters.point.observability_constrained import ObservabilityConstrained
from consistency.bench.filters.textbook.oc import ConstrainedKalman
from consistency.bench.protocols import Problem
from consistency.referee.types import Array


def parts(problem: Problem, controls: Array, uvd: bool) -> Slam:
    """Those of the EKF, and the point."""
    return ekf.parts(problem, controls, uvd)._replace(point=ObservabilityConstrained())


XYZ, UVD, XY, RB = variants(ConstrainedKalman, "oc-ekf", parts)
