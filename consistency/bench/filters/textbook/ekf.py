"""EKF-SLAM, Herath et al. (2007) eq. 9-13, on (x, y, z) or on (u, v, d)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from consistency.bench.filters.textbook import basics
from consistency.bench.filters.textbook.basics import SlamState
from consistency.bench.protocols import Problem
from consistency.bench.types import Control, Gaussian, Info, Observation
from consistency.referee.types import Array


class ExtendedKalman:
    """EKF-SLAM with the joint update of all landmarks seen in a step: world points, an additive error.

    Other methods with such a state say what they do otherwise.
    """

    def __init__(self, name: str, uvd: bool) -> None:
        self.name, self.uvd = name, uvd

    def init(self, problem: Problem) -> SlamState:
        return basics.start(problem)

    def predict(self, state: SlamState, control: Control) -> SlamState:
        """Eq. 9 and 10 with Jacobians at the estimate: the mean moves by f, P <- F P F' + G Q G'."""
        x, F = state.x.copy(), np.eye(len(state.x))
        F[:3, :3], G = basics.motion_jacobians(x[:3], control)
        x[:3] = basics.pose_after(x[:3], control)
        P = F @ state.P @ F.T
        P[:3, :3] += basics.process_noise(G, state.problem.belief)
        return replace(state, x=x, P=P)

    def update(self, state: SlamState, observation: Observation) -> tuple[SlamState, Info]:
        return basics.update_jointly(state, observation, self.uvd, self._correct, self._locate)

    def _correct(self, state: SlamState, seen: list[int], z: Array, R: Array) -> tuple[SlamState, Info]:
        zhat, H = basics.expect(state, seen, self.uvd)
        return basics.corrected(state, H, basics.innovation_of(state, z, zhat, self.uvd), R)

    def _locate(self, state: SlamState, label: int, z: Array) -> tuple[Array, Array, Array]:
        return basics.locate_point(state, z, self.uvd)

    def pose(self, state: SlamState) -> Gaussian:
        return basics.pose_of(state)

    def map(self, state: SlamState) -> dict[int, Gaussian]:
        return basics.map_of_state(state)

    def joint(self, state: SlamState) -> Gaussian:
        return basics.joint_of(state)

    def forget(self, state: SlamState, landmark: int) -> SlamState:
        return basics.without(state, landmark)
