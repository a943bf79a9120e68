"""EKF-SLAM with first-estimates Jacobians (FEJ): Huang, Mourikis & Roumeliotis (2010), IJRR 29(5).

The EKF linearises one variable at several estimates, and the linearised system then seems to tell the heading of
robot and map together, which no relative observation does. With every Jacobian at first estimates
(``methods/fej.py``) its unobservable directions are as many as those of SLAM. The price is a linearisation
at estimates that are not the best ones.
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


class FirstEstimateKalman(ExtendedKalman):
    """``points`` of the state are the first estimates of its variables (n,); of the pose that is its prediction."""

    def init(self, problem: Problem) -> SlamState:
        return replace(basics.start(problem), points=problem.start.copy())

    def predict(self, state: SlamState, control: Control) -> SlamState:
        predicted = basics.pose_after(state.x[:3], control)
        after = basics.predict_by(state, control, predicted[:2] - state.points[:2], state.x[:3])
        return replace(after, points=np.concatenate([predicted, state.points[3:]]))

    def update(self, state: SlamState, observation: Observation) -> tuple[SlamState, Info]:
        after, info = super().update(state, observation)
        return replace(after, points=np.concatenate([state.points, after.x[len(state.x) :]])), info

    def _correct(self, state: SlamState, seen: list[int], z: Array, R: Array) -> tuple[SlamState, Info]:
        return basics.correct_about(state, state.points, seen, z, R, self.uvd)

    def _locate(self, state: SlamState, label: int, z: Array) -> tuple[Array, Array, Array]:
        landmark, Jp, Jz = basics.locate_point(state, z, self.uvd)
        Jp[:2, 2] = basics.quarter_turn(landmark[:2] - state.points[:2])
        return landmark, Jp, Jz

    def forget(self, state: SlamState, landmark: int) -> SlamState:
        return replace(basics.without(state, landmark), points=state.points[state.beside(landmark)])
