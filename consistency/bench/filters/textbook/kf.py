"""The linear Kalman filter, exact in a linear-Gaussian world, Herath et al. (2007) eq. 1-8."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from consistency.bench.filters.textbook import basics
from consistency.bench.filters.textbook.basics import PointSensor, SlamState
from consistency.bench.filters.textbook.ekf import ExtendedKalman
from consistency.bench.protocols import Problem
from consistency.bench.types import Control, Info
from consistency.referee.types import Array


class LinearKalman(ExtendedKalman):
    """Kalman filter of a linear world: every Jacobian at the known reference.

    ``points`` of the state is the reference of the robot (3,): its dead-reckoned pose.
    """

    innovations = "optimal"

    def init(self, problem: Problem) -> SlamState:
        basics.require_landmarks(problem, self.name)
        return replace(basics.start(problem), points=problem.start.copy())

    def predict(self, state: SlamState, control: Control) -> SlamState:
        F, G = basics.motion_jacobians(state.points, control)
        reference = basics.pose_after(state.points, control)
        x, P = state.x.copy(), state.P.copy()
        x[:3] = reference + F @ (x[:3] - state.points)
        P[:3] = F @ P[:3]
        P[:, :3] = P[:, :3] @ F.T
        P[:3, :3] += basics.process_noise(G, state.problem.belief)
        return replace(state, x=x, P=P, points=reference)

    def _correct(self, state: SlamState, seen: list[int], z: Array, R: Array) -> tuple[SlamState, Info]:
        landmarks = basics.require_landmarks(state.problem, self.name)
        known = np.concatenate([state.points, *(landmarks[label] for label in state.landmarks)])
        zhat, H = basics.expect(replace(state, x=known), seen, uvd=False)
        innovation = z.ravel() - (zhat + H @ (state.x - known))
        return basics.corrected(state, H, innovation, R)

    def _locate(self, state: SlamState, label: int, z: Array) -> tuple[Array, Array, Array]:
        reference, landmark = state.points, basics.require_landmarks(state.problem, self.name)[label]
        sensor = PointSensor(state.problem.belief.sensor, uvd=False)
        Hp, Hl = sensor.jacobians(reference, landmark)
        Jz = np.linalg.inv(Hl)
        error = z - sensor.measure(reference, landmark) - Hp @ (state.x[:3] - reference)
        return landmark + Jz @ error, -Jz @ Hp, Jz
