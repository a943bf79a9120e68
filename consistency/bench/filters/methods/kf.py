"""The linear Kalman filter, compiled. Equations and source: :mod:`consistency.bench.filters.textbook.kf`.

Its points are known beforehand. What the ideal filter does alike stands here, too.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from consistency.bench.filters.compiled import Compiled
from consistency.bench.filters.compiler.dispatch import implement, part
from consistency.bench.filters.compiler.jit import inner
from consistency.bench.filters.kernel.linalg import copy_matrix, matrix, vector
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
    propagate_covariance,
    propagate_covariance_at,
    robot_frame,
)
from consistency.bench.filters.kernel.update_steps import Scratch, linearise_at
from consistency.bench.filters.methods import ekf
from consistency.bench.filters.textbook import basics
from consistency.bench.filters.textbook.kf import LinearKalman
from consistency.bench.protocols import Problem
from consistency.bench.scenario.models import dead_reckoning
from consistency.referee.types import Array


@part(sensor="Xyz", landmark="WorldPoint", error="Additive", update="Joint")
class Reference(NamedTuple):
    """f and h to first order about it: the Kalman filter of a linear world, Herath et al. (2007) eq. 1-8."""

    path: Array  # (T + 1, 3)
    landmarks: Array  # (n_landmarks, w)


@implement(expands, Reference)
def reference_is_expanded(point: Reference) -> bool:
    return True


@implement(motion_point, Reference)
def motion_at_known(point: Any, pose: Array, k: int) -> Array:
    return point.path[k]


@implement(observation_point, Reference)
def observation_at_known(point: Any, pose: Array, k: int) -> Array:
    return point.path[k + 1]


@implement(landmark_point, Reference)
def landmark_at_known(point: Any, values: Array, label: int, scratch: Scratch[NamedTuple]) -> Array:
    return point.landmarks[label]


@implement(propagate_covariance_at, Reference)
def propagate_covariance_at_reference(
    point: Reference, slam: Slam, state: State, k: int, u: Array, Phi: Array, scratch: Scratch[NamedTuple]
) -> None:
    propagate_covariance(point.path[k], u, state.P, state.n, Phi, state.base)


@inner
def invert_at(point: Any, slam: Slam, k: int, label: int, scratch: Scratch[NamedTuple]) -> Array:
    """``scratch.Jz`` <- Hl^-1 and ``scratch.Jp`` <- -Hl^-1 Hp at the point; returns h (s,) there."""
    w, s = landmark_width(slam.landmark), observed_width(slam.sensor)
    expected, Hp, Hl = vector(s), matrix(s, 3), matrix(s, w)
    linearise_at(slam, robot_frame(point.path[k + 1]), point.landmarks[label], expected, Hp, Hl)
    copy_matrix(np.linalg.inv(Hl), scratch.Jz)
    copy_matrix(-np.dot(scratch.Jz, Hp), scratch.Jp)
    return expected


@implement(place, Reference)
def place_about_reference(
    point: Reference, slam: Slam, state: State, k: int, label: int, z: Array, scratch: Scratch[NamedTuple]
) -> None:
    """By the landmark that solves the expanded h for z (3,), where w = 3."""
    pose, landmark, n = point.path[k + 1], point.landmarks[label], state.n
    expected = invert_at(point, slam, k, label, scratch)
    for i in range(len(landmark)):
        state.x[n + i] = landmark[i]
        for j in range(3):
            state.x[n + i] += scratch.Jz[i, j] * (z[j] - expected[j]) + scratch.Jp[i, j] * (state.x[j] - pose[j])


def parts(problem: Problem, controls: Array, uvd: bool) -> Slam:
    """Those of the EKF on points, and the reference, which is the path that the controls plan."""
    landmarks = basics.require_landmarks(problem, "kf")
    reference = Reference(dead_reckoning(problem.start, controls), np.array(landmarks, float))
    return ekf.parts(problem, controls, uvd)._replace(point=reference)


FILTERS = {"kf": Compiled(LinearKalman("kf", uvd=False), parts, ("linear",))}
