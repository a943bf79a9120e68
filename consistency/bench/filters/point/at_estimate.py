"""Jacobians at the current estimate, the EKF's choice: Herath et al. (2007) eq. 9-13."""

from __future__ import annotations

from typing import NamedTuple

from consistency.bench.filters.compiler.dispatch import implement, part
from consistency.bench.filters.kernel.observation_model import place_observed
from consistency.bench.filters.kernel.part_functions import Slam, State, place, stands_apart
from consistency.bench.filters.kernel.work_arrays import Work
from consistency.referee.types import Array


@part()
class AtEstimate(NamedTuple):
    """No parameters."""


@implement(stands_apart, AtEstimate)
def estimate_stands_apart(point: AtEstimate) -> bool:
    return False


@implement(place, AtEstimate)
def place_at_estimate(
    point: AtEstimate, slam: Slam, state: State, k: int, label: int, z: Array, work: Work[NamedTuple]
) -> None:
    place_observed(slam, state.x[:3], z, state.x[state.n :], work)
