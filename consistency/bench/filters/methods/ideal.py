"""The ideal EKF, compiled. Equations and source: :mod:`consistency.filters.textbook.ideal`."""

from __future__ import annotations

import numpy as np

from consistency.bench.filters.compiled import Compiled, planar
from consistency.bench.filters.kernel.part_functions import Slam, landmark_width
from consistency.bench.filters.methods import ekf
from consistency.bench.filters.point.truth import AtTruth
from consistency.bench.filters.textbook.ideal import IdealKalman, truth_of
from consistency.bench.protocols import Problem
from consistency.referee.types import Array


def xyz_parts(problem: Problem, controls: Array) -> Slam:
    """Parts of ``ideal-ekf-xyz``, and with landmarks in the plane where the sensor has them."""
    truth, slam = truth_of(problem), ekf.xyz_parts(problem, controls)
    width = landmark_width(slam.landmark)
    point = AtTruth(np.array(truth.path, float), np.array(truth.landmarks[:, :width], float, order="C"))
    return slam._replace(point=point)


def uvd_parts(problem: Problem, controls: Array) -> Slam:
    """Parts of ``ideal-ekf-uvd``."""
    return xyz_parts(problem, controls)._replace(sensor=ekf.uvd_parts(problem, controls).sensor)


XYZ = Compiled(IdealKalman("ideal-ekf-xyz", uvd=False), xyz_parts, sensors=("xyz", "uvd"), uvd=False)
UVD = Compiled(IdealKalman("ideal-ekf-uvd", uvd=True), uvd_parts, sensors=("uvd",), uvd=True)
XY, RB = planar(IdealKalman, "ideal-ekf", xyz_parts)
