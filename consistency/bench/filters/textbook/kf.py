"""The linear Kalman filter, exact in a linear-Gaussian world, Herath et al. (2007) eq. 1-8."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from consistency.bench.filters.textbook import basics
from consistency.bench.filters.textbook.basics import PointSensor, SlamState
from consistency.bench.protocols import Problem
from consistency.bench.types import Control, Info, Observation
from consistency.referee.types import Array


@dataclass(frozen=True)
class LinearState:
    """State of a linear world, and the dead-reckoned pose at which it is linearised."""

    slam: SlamState
    reference: Array  # (3,)


class LinearKalman(basics.WrappedFilter):
    """Kalman filter of a linear world: every Jacobian at the known reference."""

    innovations = "optimal"

    def init(self, problem: Problem) -> LinearState:
        basics.require_landmarks(problem, self.name)
        return LinearState(basics.start(problem), problem.start.copy())

    def predict(self, state: LinearState, control: Control) -> LinearState:
        F, G = basics.motion_jacobians(state.reference, control)
        reference = basics.move(state.reference, control)
        x, P = state.slam.x.copy(), state.slam.P.copy()
        x[:3] = reference + F @ (x[:3] - state.reference)
        P[:3] = F @ P[:3]
        P[:, :3] = P[:, :3] @ F.T
        P[:3, :3] += basics.process_noise(G, state.slam.problem.belief)
        return LinearState(replace(state.slam, x=x, P=P), reference)

    def update(self, state: LinearState, observation: Observation) -> tuple[LinearState, Info]:
        reference, landmarks = state.reference, basics.require_landmarks(state.slam.problem, self.name)

        def correct(slam: SlamState, seen: list[int], z: Array, R: Array) -> tuple[SlamState, Info]:
            known = np.concatenate([reference, *(landmarks[label] for label in slam.landmarks)])
            zhat, H = basics.expect(replace(slam, x=known), seen, uvd=False)
            innovation = z.ravel() - (zhat + H @ (slam.x - known))
            return basics.corrected(slam, H, innovation, R)

        def locate(slam: SlamState, label: int, z: Array) -> tuple[Array, Array, Array]:
            sensor = PointSensor(slam.problem.belief.sensor, uvd=False)
            Hp, Hl = sensor.jacobians(reference, landmarks[label])
            Jz = np.linalg.inv(Hl)
            error = z - sensor.measure(reference, landmarks[label]) - Hp @ (slam.x[:3] - reference)
            return landmarks[label] + Jz @ error, -Jz @ Hp, Jz

        slam, info = basics.update_jointly(state.slam, observation, False, correct, locate)
        return replace(state, slam=slam), info
