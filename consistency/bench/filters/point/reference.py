"""f and h to first order about a known reference: the Kalman filter of a linear world, Herath et al. (2007) eq. 1-8."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from consistency.bench.filters.compiler.dispatch import implement, part
from consistency.bench.filters.kernel.arrays import copy_matrix, matrix, vector
from consistency.bench.filters.kernel.observation_model import linearise_at
from consistency.bench.filters.kernel.part_functions import (
    Slam,
    State,
    expands,
    landmark_point,
    motion_point,
    observation_point,
    place,
    propagate_covariance_at,
)
from consistency.bench.filters.kernel.work_arrays import Work
from consistency.bench.filters.motion.unicycle import propagate_covariance, robot_frame
from consistency.referee.types import Array


@part(sensor="Xyz", landmark="WorldPoint", error="Additive", update="Joint")
class Reference(NamedTuple):
    """Where the world is linearised."""

    path: Array  # (T + 1, r)
    landmarks: Array  # (n_landmarks, w)


@implement(expands, Reference)
def reference_is_expanded(point: Reference) -> bool:
    """True: f and h are affine functions."""
    return True


@implement(motion_point, Reference)
def motion_at_reference(point: Reference, pose: Array, k: int) -> Array:
    """Reference pose (r,) of step k, before the step."""
    return point.path[k]


@implement(propagate_covariance_at, Reference)
def propagate_covariance_at_reference(
    point: Reference, slam: Slam, state: State, k: int, u: Array, Phi: Array, work: Work[NamedTuple]
) -> None:
    """F at the reference pose before the step."""
    propagate_covariance(point.path[k], u, state.P, state.n, Phi, state.base)


@implement(observation_point, Reference)
def observation_at_reference(point: Reference, pose: Array, k: int) -> Array:
    """Reference pose (r,) of step k + 1."""
    return point.path[k + 1]


@implement(landmark_point, Reference)
def landmark_at_reference(point: Reference, values: Array, label: int, work: Work[NamedTuple]) -> Array:
    """Reference (w,) of landmark ``label``."""
    return point.landmarks[label]


@implement(place, Reference)
def place_about_reference(
    point: Reference, slam: Slam, state: State, k: int, label: int, z: Array, work: Work[NamedTuple]
) -> None:
    """x[n:n + w] <- the landmark that solves the expanded h for z (3,), where w = 3; Jz = Hl^-1 and Jp = -Hl^-1 Hp."""
    pose, landmark, n = point.path[k + 1], point.landmarks[label], state.n
    r = 3
    z0, Hp, Hl = vector(3), matrix(3, r), matrix(3, len(landmark))
    linearise_at(slam, robot_frame(pose), landmark, z0, Hp, Hl)
    copy_matrix(np.linalg.inv(Hl), work.Jz)
    copy_matrix(-np.dot(work.Jz, Hp), work.Jp)
    for i in range(len(landmark)):
        state.x[n + i] = landmark[i]
        for j in range(3):
            state.x[n + i] += work.Jz[i, j] * (z[j] - z0[j]) + work.Jp[i, j] * (state.x[j] - pose[j])
