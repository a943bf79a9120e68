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
from consistency.bench.filters.kernel.part_functions import Data, Factors, Slam, State, correct, predict_innovation
from consistency.bench.filters.kernel.work_arrays import Work


@part()
class Joint(NamedTuple):
    """No parameters."""


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
