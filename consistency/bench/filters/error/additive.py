"""Truth minus estimate, variable by variable: the error of the textbook EKF, in world coordinates."""

from __future__ import annotations

from typing import NamedTuple

from consistency.bench.filters.compiler.dispatch import implement, part
from consistency.bench.filters.kernel.arrays import copy_matrix
from consistency.bench.filters.kernel.blas import add_transposed_times
from consistency.bench.filters.kernel.part_functions import (
    Slam,
    State,
    expands,
    motion_point,
    pose_covariance,
    propagate,
    propagate_covariance_at,
    retract,
)
from consistency.bench.filters.kernel.work_arrays import Work
from consistency.bench.filters.motion.unicycle import add_motion_noise, move, move_about
from consistency.referee.types import Array


@part()
class Additive(NamedTuple):
    """No parameters."""


@implement(propagate, Additive)
def propagate_additive(
    error: Additive, slam: Slam, state: State, k: int, u: Array, Phi: Array, work: Work[NamedTuple]
) -> None:
    """One step of motion, eq. 9 and 10: x <- f(x) and P <- F P F' + G Q G' in the robot's rows."""
    pose = state.x[:3]
    at = motion_point(slam.point, pose, k)
    propagate_covariance_at(slam.point, slam, state, k, u, Phi, work)
    add_motion_noise(slam.motion, at, u, state.P)
    if expands(slam.point):
        move_about(at, u, pose)
    else:
        move(pose, u, pose)


@implement(retract, Additive)
def retract_additive(error: Additive, slam: Slam, state: State, A: Array, y: Array, work: Work[NamedTuple]) -> None:
    add_transposed_times(A, y, state.x[: state.n])


@implement(pose_covariance, Additive)
def additive_pose_covariance(error: Additive, x: Array, P: Array, out: Array) -> None:
    copy_matrix(P, out)
