"""Every step works on the whole state."""

from __future__ import annotations

from typing import NamedTuple

from consistency.bench.filters.compiler.dispatch import implement, part
from consistency.bench.filters.kernel.local_state import Factors, make_factors
from consistency.bench.filters.kernel.part_functions import (
    Data,
    Slam,
    State,
    append,
    held_at,
    make_local,
    prepare,
    settle,
    spare_width,
    withhold,
)
from consistency.bench.filters.kernel.work_arrays import Work
from consistency.referee.types import Array, Indices


@part()
class Dense(NamedTuple):
    """No parameters."""


@implement(spare_width, Dense)
def dense_spares_nothing(covariance: Dense, steps: int, n_landmarks: int) -> int:
    return 0


@implement(held_at, Dense)
def held_by_robot(covariance: Dense, label: int, local: Factors) -> int:
    return 0


@implement(make_local, Dense)
def make_no_factors(covariance: Dense, r: int, w: int, n: int, steps: int, n_landmarks: int) -> Factors:
    return make_factors(r, r, 1)


@implement(prepare, Dense)
def prepare_all(
    covariance: Dense, slam: Slam, whole: State, state: State, labels: Indices, local: Factors
) -> tuple[State, State]:
    """The state as it is."""
    return whole, state


@implement(append, Dense)
def append_nothing(
    covariance: Dense, slam: Slam, state: State, label: int, local: Factors, work: Work[NamedTuple]
) -> None:
    pass


@implement(settle, Dense)
def settle_nothing(covariance: Dense, slam: Slam, whole: State, state: State, local: Factors) -> None:
    """Nothing to do: every step has worked on the whole state."""


@implement(withhold, Dense)
def withhold_nothing(
    covariance: Dense, state: State, data: Data, k: int, rejected: Array, anew: Array, local: Factors
) -> None:
    """Nothing was noted of what is seen."""
