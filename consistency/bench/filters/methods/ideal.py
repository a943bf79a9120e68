"""The ideal EKF, compiled. Equations and source: :mod:`consistency.bench.filters.textbook.ideal`."""

from __future__ import annotations

import numpy as np

from consistency.bench.filters.compiled import variants
from consistency.bench.filters.kernel.part_functions import Slam, landmark_width
from consistency.bench.filters.methods import ekf
from consistency.bench.filters.point.at_known import AtTruth
from consistency.bench.filters.textbook.ideal import IdealKalman, truth_of
from consistency.bench.protocols import Problem
from consistency.referee.types import Array


def parts(problem: Problem, controls: Array, uvd: bool) -> Slam:
    truth, slam = truth_of(problem), ekf.parts(problem, controls, uvd)
    width = landmark_width(slam.landmark)
    point = AtTruth(np.array(truth.path, float), np.array(truth.landmarks[:, :width], float, order="C"))
    return slam._replace(point=point)


XYZ, UVD, XY, RB = variants(IdealKalman, "ideal-ekf", parts)
