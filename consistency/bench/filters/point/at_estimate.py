"""Jacobians at the current estimate, the EKF's choice: Herath et al. (2007) eq. 9-13."""

from __future__ import annotations

from typing import NamedTuple

from consistency.bench.filters.compiler.dispatch import implement, part
from consistency.bench.filters.kernel.observation_model import place_observed
from consistency.bench.filters.kernel.part_functions import (
    Slam,
    State,
    expands,
    landmark_point,
    make_notes,
    motion_point,
    observation_point,
    place,
    propagate_covariance,
    propagate_covariance_at,
    robot_width,
    stands_apart,
)
from consistency.bench.filters.kernel.work_arrays import NoNotes, Work
from consistency.referee.types import Array


@part()
class AtEstimate(NamedTuple):
    """No parameters."""


@implement(expands, AtEstimate)
def estimate_is_not_expanded(point: AtEstimate) -> bool:
    """False: f and h are evaluated at the estimate itself."""
    return False


@implement(stands_apart, AtEstimate)
def estimate_stands_apart(point: AtEstimate) -> bool:
    return False


@implement(make_notes, AtEstimate)
def no_notes_estimate(point: AtEstimate, r: int, w: int, steps: int, labels: int) -> NoNotes:
    return NoNotes()


@implement(motion_point, AtEstimate)
def motion_at_estimate(point: AtEstimate, pose: Array, k: int) -> Array:
    """The estimate ``pose`` (r,), before the step."""
    return pose


@implement(propagate_covariance_at, AtEstimate)
def propagate_covariance_at_estimate(
    point: AtEstimate, slam: Slam, state: State, k: int, u: Array, Phi: Array, work: Work[NamedTuple]
) -> None:
    """F at the estimate before the step."""
    propagate_covariance(slam.motion, state.x[: robot_width(slam.motion)], u, state.P, state.n, Phi, state.base)


@implement(observation_point, AtEstimate)
def observation_at_estimate(point: AtEstimate, pose: Array, k: int) -> Array:
    """The estimate ``pose`` (r,), after the prediction."""
    return pose


@implement(landmark_point, AtEstimate)
def landmark_at_estimate(point: AtEstimate, values: Array, label: int, work: Work[NamedTuple]) -> Array:
    """The estimate ``values`` (w,)."""
    return values


@implement(place, AtEstimate)
def place_at_estimate(
    point: AtEstimate, slam: Slam, state: State, k: int, label: int, z: Array, work: Work[NamedTuple]
) -> None:
    """x[n:n + w] <- the inverse of h at the estimated pose, with its Jacobians."""
    place_observed(slam, state.x[: robot_width(slam.motion)], z, state.x[state.n :], work)
