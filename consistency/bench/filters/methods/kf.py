"""The linear Kalman filter, compiled. Equations and source: :mod:`consistency.filters.textbook.kf`."""

from __future__ import annotations

import numpy as np

from consistency.bench.filters.belief_parts import motion_of, sensor_of
from consistency.bench.filters.compiled import Compiled
from consistency.bench.filters.covariance_update.dense import Dense
from consistency.bench.filters.error.additive import Additive
from consistency.bench.filters.kernel.part_functions import Slam
from consistency.bench.filters.landmark.world_point import WorldPoint
from consistency.bench.filters.point.reference import Reference
from consistency.bench.filters.textbook import basics
from consistency.bench.filters.textbook.kf import LinearKalman
from consistency.bench.filters.update.joint_update import Joint
from consistency.bench.models.motion import dead_reckoning
from consistency.bench.protocols import Problem
from consistency.referee.types import Array


def parts(problem: Problem, controls: Array) -> Slam:
    """Parts of the filter; the reference is the path that the controls plan."""
    belief, landmarks = problem.belief, basics.require_landmarks(problem, "kf")
    reference = Reference(dead_reckoning(problem.start, controls), np.array(landmarks, float))
    return Slam(motion_of(belief), sensor_of(belief, uvd=False), WorldPoint(), Additive(), reference, Joint(), Dense())


FILTER = Compiled(LinearKalman(), parts, sensors=("linear",), uvd=False, innovations="optimal")
