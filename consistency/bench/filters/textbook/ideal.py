"""EKF-SLAM with every Jacobian at the truth, Huang, Mourikis & Roumeliotis (2010), IJRR 29(5): the ideal EKF.

f and h are evaluated at the estimate, as in the EKF. No robot knows where it is, so this is a bound and not a filter
to use (``realisable`` is False): it shows what is lost by linearising at estimates, and what no choice of points would
mend. It needs a trial whose truth is known, simulated or recorded.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from consistency.bench.filters.textbook import basics
from consistency.bench.filters.textbook.basics import SlamState, view
from consistency.bench.protocols import Problem, TrialTruth
from consistency.bench.types import Control, Info, Observation
from consistency.referee.errors import InputError
from consistency.referee.types import Array


@dataclass(frozen=True)
class IdealState:
    """The state of the EKF, and the step that the truth is taken of."""

    slam: SlamState
    truth: TrialTruth
    step: int


class IdealKalman(basics.WrappedFilter):
    realisable = False

    def init(self, problem: Problem) -> IdealState:
        return IdealState(basics.start(problem), truth_of(problem), 0)

    def predict(self, state: IdealState, control: Control) -> IdealState:
        before, after = state.truth.path[state.step : state.step + 2]
        slam = basics.predict_by(state.slam, control, after[:2] - before[:2], before)
        return replace(state, slam=slam, step=state.step + 1)

    def update(self, state: IdealState, observation: Observation) -> tuple[IdealState, Info]:
        pose, landmarks = state.truth.path[state.step], state.truth.landmarks[:, : state.slam.width]
        sensor = view(state.slam.problem.belief.sensor, self.uvd)

        def correct(slam: SlamState, seen: list[int], z: Array, R: Array) -> tuple[SlamState, Info]:
            true = np.concatenate([pose, *(landmarks[label] for label in slam.landmarks)])
            return basics.correct_about(slam, true, seen, z, R, self.uvd)

        def locate(slam: SlamState, label: int, z: Array) -> tuple[Array, Array, Array]:
            landmark, _, _ = basics.locate_point(slam, z, self.uvd)
            Hp, Hl = sensor.jacobians(pose, landmarks[label])
            Jz = np.linalg.inv(Hl)
            return landmark, -Jz @ Hp, Jz

        slam, info = basics.update_jointly(state.slam, observation, self.uvd, correct, locate)
        return replace(state, slam=slam), info


def truth_of(problem: Problem) -> TrialTruth:
    """The truth that a problem carries.

    Raises
    ------
    InputError
        It carries none: measurements alone are not enough for this filter.
    """
    if problem.truth is None:
        raise InputError(
            "the ideal EKF takes its Jacobians at the truth and cannot be stepped on measurements alone; "
            "give it a trial with truth, by run(trial, belief)"
        )
    return problem.truth
