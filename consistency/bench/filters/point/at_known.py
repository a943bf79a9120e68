"""Jacobians at poses and landmarks that are known beforehand: a reference, or the truth."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from consistency.bench.filters.compiler.dispatch import implement, part
from consistency.bench.filters.compiler.jit import inner
from consistency.bench.filters.kernel.arrays import copy_matrix, matrix, vector
from consistency.bench.filters.kernel.part_functions import (
    Slam,
    State,
    expands,
    landmark_point,
    landmark_width,
    motion_point,
    observation_point,
    observed_width,
    place,
    propagate_covariance_at,
)
from consistency.bench.filters.kernel.update_steps import linearise_at, place_observed
from consistency.bench.filters.kernel.work_arrays import Work
from consistency.bench.filters.motion.unicycle import propagate_covariance, propagate_covariance_by, robot_frame
from consistency.referee.types import Array


@part(sensor="Xyz", landmark="WorldPoint", error="Additive", update="Joint")
class Reference(NamedTuple):
    """f and h to first order about it: the Kalman filter of a linear world, Herath et al. (2007) eq. 1-8."""

    path: Array  # (T + 1, 3)
    landmarks: Array  # (n_landmarks, w)


@part(landmark="WorldPoint PlanarPoint", error="Additive", update="Joint")
class AtTruth(NamedTuple):
    """Where robot and landmarks are: a bound on what a choice of points can give, since no filter knows it.

    f and h are those of the estimate. F has in its column of the heading J (p_k+1 - p_k) with the true positions and J
    the quarter turn: the Jacobian of f at the true pose and the true motion. A new landmark has those of h, inverted.
    """

    path: Array  # (T + 1, 3)
    landmarks: Array  # (n_landmarks, w)


@implement(expands, Reference)
def reference_is_expanded(point: Reference) -> bool:
    return True


@implement(motion_point, AtTruth)
@implement(motion_point, Reference)
def motion_at_known(point: Any, pose: Array, k: int) -> Array:
    return point.path[k]


@implement(observation_point, AtTruth)
@implement(observation_point, Reference)
def observation_at_known(point: Any, pose: Array, k: int) -> Array:
    return point.path[k + 1]


@implement(landmark_point, AtTruth)
@implement(landmark_point, Reference)
def landmark_at_known(point: Any, values: Array, label: int, work: Work[NamedTuple]) -> Array:
    return point.landmarks[label]


@implement(propagate_covariance_at, Reference)
def propagate_covariance_at_reference(
    point: Reference, slam: Slam, state: State, k: int, u: Array, Phi: Array, work: Work[NamedTuple]
) -> None:
    propagate_covariance(point.path[k], u, state.P, state.n, Phi, state.base)


@implement(propagate_covariance_at, AtTruth)
def propagate_covariance_at_truth(
    point: AtTruth, slam: Slam, state: State, k: int, u: Array, Phi: Array, work: Work[NamedTuple]
) -> None:
    """F by the true displacement of the robot."""
    before, after = point.path[k], point.path[k + 1]
    propagate_covariance_by(after[0] - before[0], after[1] - before[1], state.P, state.n, Phi, state.base)


@inner
def _invert_at(point: Any, slam: Slam, k: int, label: int, work: Work[NamedTuple]) -> Array:
    """``work.Jz`` <- Hl^-1 and ``work.Jp`` <- -Hl^-1 Hp at the point; returns h (s,) there."""
    w, s = landmark_width(slam.landmark), observed_width(slam.sensor)
    expected, Hp, Hl = vector(s), matrix(s, 3), matrix(s, w)
    linearise_at(slam, robot_frame(point.path[k + 1]), point.landmarks[label], expected, Hp, Hl)
    copy_matrix(np.linalg.inv(Hl), work.Jz)
    copy_matrix(-np.dot(work.Jz, Hp), work.Jp)
    return expected


@implement(place, Reference)
def place_about_reference(
    point: Reference, slam: Slam, state: State, k: int, label: int, z: Array, work: Work[NamedTuple]
) -> None:
    """By the landmark that solves the expanded h for z (3,), where w = 3."""
    pose, landmark, n = point.path[k + 1], point.landmarks[label], state.n
    expected = _invert_at(point, slam, k, label, work)
    for i in range(len(landmark)):
        state.x[n + i] = landmark[i]
        for j in range(3):
            state.x[n + i] += work.Jz[i, j] * (z[j] - expected[j]) + work.Jp[i, j] * (state.x[j] - pose[j])


@implement(place, AtTruth)
def place_at_truth(
    point: AtTruth, slam: Slam, state: State, k: int, label: int, z: Array, work: Work[NamedTuple]
) -> None:
    place_observed(slam, state.x[:3], z, state.x[state.n : state.n + landmark_width(slam.landmark)], work)
    _invert_at(point, slam, k, label, work)
