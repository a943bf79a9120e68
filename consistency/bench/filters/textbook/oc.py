"""EKF-SLAM under observability constraints (OC), after Huang, Mourikis & Roumeliotis (2010), IJRR 29(5).

As many directions stay unobserved as in SLAM, and the Jacobians are taken as near to the estimates as that allows
(``methods/oc.py`` has the derivation). First estimates keep the same directions and are far from
the best estimates; these points follow them where robot and map move together.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from consistency.bench.filters.textbook import basics
from consistency.bench.filters.textbook.basics import SlamState
from consistency.bench.filters.textbook.ekf import ExtendedKalman
from consistency.bench.protocols import Problem
from consistency.bench.types import Control, Info, Observation
from consistency.referee.types import Array


class ConstrainedKalman(ExtendedKalman):
    """``points`` of the state, (1 + m, 2), are a, l_1, ..., l_m of the direction in which it must not be observed.

    That is (J a, 1, J l_1, ...).
    """

    def init(self, problem: Problem) -> SlamState:
        return replace(basics.start(problem), points=problem.start[None, :2])

    def predict(self, state: SlamState, control: Control) -> SlamState:
        x, turned = state.x, state.points.copy()
        shift = np.mean(x[state.positions] - turned, axis=0)
        predicted = basics.pose_after(x[:3], control)
        after = basics.predict_by(state, control, predicted[:2] - (turned[0] + shift), x[:3])  # predicted less p*
        turned[0] = predicted[:2] - shift
        return replace(after, points=turned)

    def update(self, state: SlamState, observation: Observation) -> tuple[SlamState, Info]:
        after, info = super().update(state, observation)
        new = after.positions[len(state.points) :]
        return replace(after, points=np.vstack([state.points, state.points[0] + after.x[new] - after.x[:2]])), info

    def _correct(self, state: SlamState, seen: list[int], z: Array, R: Array) -> tuple[SlamState, Info]:
        at = state.x.copy()
        at[state.positions] = state.points + (state.x[:2] - state.points[0])
        return basics.correct_about(state, at, seen, z, R, self.uvd)

    def forget(self, state: SlamState, landmark: int) -> SlamState:
        turned = np.delete(state.points, 1 + state.landmarks.index(landmark), axis=0)
        return replace(basics.without(state, landmark), points=turned)
