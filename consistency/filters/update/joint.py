"""One joint update with all landmarks seen in a step, Herath et al. (2007) eq. 9-13."""

from __future__ import annotations

from typing import NamedTuple

from consistency.filters.kernel.dispatch import implement, part
from consistency.filters.kernel.gain import (
    add_noise,
    apply,
    combine_seen,
    gather,
    innovate,
    leave_marginal,
    linearise_seen,
    marginal,
    whiten,
)
from consistency.filters.kernel.local_state import Factors
from consistency.filters.kernel.slam import Data, Slam, State, correct, foresee, make_room, predict, propagate
from consistency.filters.kernel.work import Work
from consistency.types import Array


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


@implement(correct, Joint)
def correct_joint(
    update: Joint, slam: Slam, state: State, data: Data, k: int, m: int, local: Factors, work: Work[NoRoom]
) -> tuple[int, float]:
    """One update with Jacobians at the prediction, eq. 11-13."""
    gather(slam, state, m, local, work)
    linearise_seen(slam, state, k, m, work)
    combine_seen(slam, state, m, work)
    innovate(slam, state, data, m, work)
    code, nis = whiten(slam, state, data, m, work)
    if code == 0:
        apply(slam, state, m, local, work)
    return code, nis


@implement(foresee, Joint)
def foresee_linearised(
    update: NamedTuple, slam: Slam, state: State, data: Data, k: int, m: int, local: Factors, work: Work[NamedTuple]
) -> tuple[int, int]:
    """Innovation and S with Jacobians at the prediction, which is also where an iterated update begins."""
    seen = marginal(slam, state, m, work)
    linearise_seen(slam, seen, k, m, work)
    combine_seen(slam, seen, m, work)
    innovate(slam, seen, data, m, work)
    add_noise(slam, seen, data, m, work)
    return 0, leave_marginal(slam, m, work)
