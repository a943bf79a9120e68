"""The ideal EKF, compiled. Equations and source: :mod:`consistency.bench.filters.textbook.ideal`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from consistency.bench.filters.compiled import variants
from consistency.bench.filters.compiler.dispatch import implement, part
from consistency.bench.filters.kernel.part_functions import (
    Slam,
    State,
    landmark_point,
    landmark_width,
    motion_point,
    observation_point,
    place,
    propagate_covariance_at,
    propagate_covariance_by,
)
from consistency.bench.filters.kernel.update_steps import Scratch, place_observed
from consistency.bench.filters.methods import ekf
from consistency.bench.filters.methods.kf import invert_at, landmark_at_known, motion_at_known, observation_at_known
from consistency.bench.filters.textbook.ideal import IdealKalman, truth_of
from consistency.bench.protocols import Problem
from consistency.referee.types import Array


@part(landmark="WorldPoint PlanarPoint", error="Additive", update="Joint")
class AtTruth(NamedTuple):
    """Where robot and landmarks are: a bound on what a choice of points can give, since no filter knows it.

    f and h are those of the estimate. F has in its column of the heading J (p_k+1 - p_k) with the true positions and J
    the quarter turn: the Jacobian of f at the true pose and the true motion. A new landmark has those of h, inverted.
    """

    path: Array  # (T + 1, 3)
    landmarks: Array  # (n_landmarks, w)


implement(motion_point, AtTruth)(motion_at_known)
implement(observation_point, AtTruth)(observation_at_known)
implement(landmark_point, AtTruth)(landmark_at_known)


@implement(propagate_covariance_at, AtTruth)
def propagate_covariance_at_truth(
    point: AtTruth, slam: Slam, state: State, k: int, u: Array, Phi: Array, scratch: Scratch[NamedTuple]
) -> None:
    """F by the true displacement of the robot."""
    before, after = point.path[k], point.path[k + 1]
    propagate_covariance_by(after[0] - before[0], after[1] - before[1], state.P, state.n, Phi, state.base)


@implement(place, AtTruth)
def place_at_truth(
    point: AtTruth, slam: Slam, state: State, k: int, label: int, z: Array, scratch: Scratch[NamedTuple]
) -> None:
    place_observed(slam, state.x[:3], z, state.x[state.n : state.n + landmark_width(slam.landmark)], scratch)
    invert_at(point, slam, k, label, scratch)


def parts(problem: Problem, controls: Array, uvd: bool) -> Slam:
    truth, slam = truth_of(problem), ekf.parts(problem, controls, uvd)
    width = landmark_width(slam.landmark)
    point = AtTruth(np.array(truth.path, float), np.array(truth.landmarks[:, :width], float, order="C"))
    return slam._replace(point=point)


FILTERS = variants(IdealKalman, "ideal-ekf", parts)
