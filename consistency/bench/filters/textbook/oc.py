"""EKF-SLAM under observability constraints (OC), after Huang, Mourikis & Roumeliotis (2010), IJRR 29(5).

As many directions stay unobserved as in SLAM, and the Jacobians are taken as near to the estimates as that allows
(``point/observability_constrained.py`` has the derivation). First estimates keep the same directions and are far from
the best estimates; these points follow them where robot and map move together.
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
class ConstrainedState:
    """The state of the EKF, and the direction (J a, 1, J l_1, ...) in which it must not be observed."""

    slam: SlamState
    turned: Array  # (1 + m, 2): a, l_1, ..., l_m


class ConstrainedKalman(basics.WrappedFilter):
    def init(self, problem: Problem) -> ConstrainedState:
        return ConstrainedState(basics.start(problem), problem.start[None, :2])

    def predict(self, state: ConstrainedState, control: Control) -> ConstrainedState:
        x, turned = state.slam.x, state.turned.copy()
        shift = np.mean(x[state.slam.positions] - turned, axis=0)
        predicted = basics.move(x[:3], control)
        slam = basics.predict_by(state.slam, control, predicted[:2] - (turned[0] + shift), x[:3])  # predicted less p*
        turned[0] = predicted[:2] - shift
        return ConstrainedState(slam, turned)

    def update(self, state: ConstrainedState, observation: Observation) -> tuple[ConstrainedState, Info]:
        turned, predicted = list(state.turned), state.slam.x[:2]

        def correct(slam: SlamState, seen: list[int], z: Array, R: Array) -> tuple[SlamState, Info]:
            at = slam.x.copy()
            at[slam.positions] = state.turned + (predicted - state.turned[0])
            return basics.correct_about(slam, at, seen, z, R, self.uvd)

        def locate(slam: SlamState, label: int, z: Array) -> tuple[Array, Array, Array]:
            placed = basics.locate_point(slam, z, self.uvd)
            turned.append(turned[0] + placed[0][:2] - slam.x[:2])
            return placed

        slam, info = basics.update_jointly(state.slam, observation, self.uvd, correct, locate)
        return ConstrainedState(slam, np.array(turned)), info

    def forget(self, state: ConstrainedState, landmark: int) -> ConstrainedState:
        turned = np.delete(state.turned, 1 + state.slam.landmarks.index(landmark), axis=0)
        return ConstrainedState(basics.without(state.slam, landmark), turned)
