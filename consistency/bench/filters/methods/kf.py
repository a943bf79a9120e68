"""The linear Kalman filter, compiled. Equations and source: :mod:`consistency.bench.filters.textbook.kf`."""

from __future__ import annotations

import numpy as np

from consistency.bench.filters.compiled import Compiled
from consistency.bench.filters.kernel.part_functions import Slam
from consistency.bench.filters.methods import ekf
from consistency.bench.filters.point.at_known import Reference
from consistency.bench.filters.textbook import basics
from consistency.bench.filters.textbook.kf import LinearKalman
from consistency.bench.models.motion import dead_reckoning
from consistency.bench.protocols import Problem
from consistency.referee.types import Array


def parts(problem: Problem, controls: Array, uvd: bool) -> Slam:
    """Those of the EKF on points, and the reference, which is the path that the controls plan."""
    landmarks = basics.require_landmarks(problem, "kf")
    reference = Reference(dead_reckoning(problem.start, controls), np.array(landmarks, float))
    return ekf.parts(problem, controls, uvd)._replace(point=reference)


FILTER = Compiled(LinearKalman("kf", uvd=False), parts, ("linear",))
