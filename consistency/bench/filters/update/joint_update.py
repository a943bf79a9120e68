"""One joint update with all landmarks seen in a step, Herath et al. (2007) eq. 9-13."""

from __future__ import annotations

from typing import NamedTuple

from consistency.bench.filters.compiler.dispatch import implement, part
from consistency.bench.filters.kernel.gain import (
    add_noise,
    combine_seen,
    correct_at_once,
    gather,
    innovate,
    linearise_seen,
)
from consistency.bench.filters.kernel.local_state import Factors
from consistency.bench.filters.kernel.part_functions import (
    Data,
    Slam,
    State,
    correct,
    make_room,
    predict,
    predict_innovation,
    propagate,
)
from consistency.bench.filters.kernel.work_arrays import Work
from consistency.referee.types import Array


@part()
class Joint(NamedTuple):
    """No parameters."""


class NoRoom(NamedTuple):
    """No arrays."""


@implement(make_room, Joint)
def joint_room(update: Joint, r: int, w: int, s: int, m: int, n: int) -> NoRoom:
    return NoRoom()


@implement(predict, Joint)
def predict_by_error(
    update: NamedTuple, slam: Slam, state: State, k: int, u: Array, local: Factors, work: Work[NamedTuple]
) -> None:
    """Motion as the part ``error`` has it, for every update that linearises."""
    propagate(slam.error, slam, state, k, u, local.Phi, work)


implement(correct, Joint)(correct_at_once)


@implement(predict_innovation, Joint)
def predict_innovation_linearised(
    update: NamedTuple, slam: Slam, state: State, data: Data, k: int, m: int, local: Factors, work: Work[NamedTuple]
) -> tuple[int, float]:
    """Innovation and S with Jacobians at the prediction, eq. 11; an iterated update begins there, too."""
    gather(slam, state, m, local, work)
    linearise_seen(slam, state, k, m, work)
    combine_seen(slam, state, m, work)
    innovate(slam, state, data, m, work)
    return 0, add_noise(slam, state, data, m, work)
