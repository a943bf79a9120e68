"""EKF-SLAM with first-estimates Jacobians (FEJ): Huang, Mourikis & Roumeliotis (2010), IJRR 29(5).

The EKF linearises one variable at several estimates, and the linearised system then seems to tell the heading of
robot and map together, which no relative observation does. With every Jacobian at first estimates
(``point/first_estimate.py``) its unobservable directions are as many as those of SLAM. The price is a linearisation
at estimates that are not the best ones.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from consistency.bench.filters.textbook import basics
from consistency.bench.filters.textbook.basics import SlamState
from consistency.bench.protocols import Problem
from consistency.bench.types import Control, Info, Observation
from consistency.referee.types import Array


@dataclass(frozen=True)
class FirstState:
    """The state of the EKF and the first estimates of its variables."""

    slam: SlamState
    first: Array  # (n,), of the pose the prediction in this step


class FirstEstimateKalman(basics.WrappedFilter):
    def init(self, problem: Problem) -> FirstState:
        return FirstState(basics.start(problem), problem.start.copy())

    def predict(self, state: FirstState, control: Control) -> FirstState:
        pose = state.slam.x[:3]
        predicted = basics.move(pose, control)
        slam = basics.predict_by(state.slam, control, predicted[:2] - state.first[:2], pose)
        return FirstState(slam, np.concatenate([predicted, state.first[3:]]))

    def update(self, state: FirstState, observation: Observation) -> tuple[FirstState, Info]:
        first, known = state.first, len(state.slam.x)

        def correct(slam: SlamState, seen: list[int], z: Array, R: Array) -> tuple[SlamState, Info]:
            return basics.correct_about(slam, first, seen, z, R, self.uvd)

        def locate(slam: SlamState, label: int, z: Array) -> tuple[Array, Array, Array]:
            landmark, Jp, Jz = basics.locate_point(slam, z, self.uvd)
            Jp[:2, 2] = basics.quarter_turn(landmark[:2] - first[:2])
            return landmark, Jp, Jz

        slam, info = basics.update_jointly(state.slam, observation, self.uvd, correct, locate)
        return FirstState(slam, np.concatenate([first, slam.x[known:]])), info

    def forget(self, state: FirstState, landmark: int) -> FirstState:
        return FirstState(basics.without(state.slam, landmark), state.first[state.slam.beside(landmark)])
