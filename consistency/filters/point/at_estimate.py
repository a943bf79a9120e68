"""Jacobians at the current estimate, the EKF's choice: Herath et al. (2007) eq. 9-13."""

from __future__ import annotations

from typing import NamedTuple

from consistency.filters.kernel.dispatch import implement, part
from consistency.filters.kernel.measuring import place_observed
from consistency.filters.kernel.slam import (
    Slam,
    State,
    expands,
    landmark_point,
    motion_point,
    observation_point,
    place,
    robot_width,
)
from consistency.filters.kernel.work import Work
from consistency.types import Array


@part()
class AtEstimate(NamedTuple):
    """No parameters."""


@implement(expands, AtEstimate)
def estimate_is_not_expanded(point: AtEstimate) -> bool:
    """False: f and h are evaluated at the estimate itself."""
    return False


@implement(motion_point, AtEstimate)
def motion_at_estimate(point: AtEstimate, pose: Array, k: int) -> Array:
    """The estimate ``pose`` (r,), before the step."""
    return pose


@implement(observation_point, AtEstimate)
def observation_at_estimate(point: AtEstimate, pose: Array, k: int) -> Array:
    """The estimate ``pose`` (r,), after the prediction."""
    return pose


@implement(landmark_point, AtEstimate)
def landmark_at_estimate(point: AtEstimate, values: Array, label: int) -> Array:
    return values


@implement(place, AtEstimate)
def place_at_estimate(
    point: AtEstimate, slam: Slam, state: State, k: int, label: int, z: Array, work: Work[NamedTuple]
) -> None:
    """x[n:n + w] <- the inverse of h at the estimated pose, with its Jacobians."""
    place_observed(slam, state.x[: robot_width(slam.motion)], z, state.x[state.n :], work)
