"""Jacobians at the truth: a bound on what a choice of points can give, since no filter knows it.

f and h are those of the estimate. F has in its column of the heading J (p_k+1 - p_k) with the true positions and J the
quarter turn: the Jacobian of f at the true pose and the true motion. A new landmark has those of h, inverted.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from consistency.bench.filters.compiler.dispatch import implement, part
from consistency.bench.filters.kernel.arrays import copy_matrix, matrix, vector
from consistency.bench.filters.kernel.observation_model import linearise_at, place_observed
from consistency.bench.filters.kernel.part_functions import (
    Slam,
    State,
    landmark_point,
    landmark_width,
    motion_point,
    observation_point,
    observed_width,
    place,
    propagate_covariance_at,
    stands_apart,
)
from consistency.bench.filters.kernel.work_arrays import Work
from consistency.bench.filters.motion.unicycle import propagate_covariance_by, robot_frame
from consistency.referee.types import Array


@part(landmark="WorldPoint PlanarPoint", error="Additive", update="Joint")
class AtTruth(NamedTuple):
    """Where robot and landmarks are."""

    path: Array  # (T + 1, 3)
    landmarks: Array  # (n_landmarks, w)


@implement(stands_apart, AtTruth)
def truth_stands_apart(point: AtTruth) -> bool:
    """True: the Jacobians are taken elsewhere."""
    return True


@implement(motion_point, AtTruth)
def motion_at_truth(point: AtTruth, pose: Array, k: int) -> Array:
    """True pose (r,) before the step."""
    return point.path[k]


@implement(propagate_covariance_at, AtTruth)
def propagate_covariance_at_truth(
    point: AtTruth, slam: Slam, state: State, k: int, u: Array, Phi: Array, work: Work[NamedTuple]
) -> None:
    """F by the true displacement of the robot."""
    before, after = point.path[k], point.path[k + 1]
    propagate_covariance_by(after[0] - before[0], after[1] - before[1], state.P, state.n, Phi, state.base)


@implement(observation_point, AtTruth)
def observation_at_truth(point: AtTruth, pose: Array, k: int) -> Array:
    """True pose (r,) of step k + 1."""
    return point.path[k + 1]


@implement(landmark_point, AtTruth)
def landmark_at_truth(point: AtTruth, values: Array, label: int, work: Work[NamedTuple]) -> Array:
    """True position (w,) of landmark ``label``."""
    return point.landmarks[label]


@implement(place, AtTruth)
def place_at_truth(
    point: AtTruth, slam: Slam, state: State, k: int, label: int, z: Array, work: Work[NamedTuple]
) -> None:
    """x[n:n + w] <- the inverse of h at the estimated pose; Jz = Hl^-1 and Jp = -Hl^-1 Hp at the truth."""
    w, s = landmark_width(slam.landmark), observed_width(slam.sensor)
    place_observed(slam, state.x[:3], z, state.x[state.n : state.n + w], work)
    expected, Hp, Hl = vector(s), matrix(s, 3), matrix(s, w)
    linearise_at(slam, robot_frame(point.path[k + 1]), point.landmarks[label], expected, Hp, Hl)
    copy_matrix(np.linalg.inv(Hl), work.Jz)
    copy_matrix(-np.dot(work.Jz, Hp), work.Jp)
