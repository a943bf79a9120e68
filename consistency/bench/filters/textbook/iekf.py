"""Iterated EKF-SLAM: the update linearised again where it led to, Bell & Cathey (1993).

Each pass linearises h at the result of the one before and solves from the same prior; what it converges to is the
most probable state. The covariance is that of the last pass, from the prior.
"""

from __future__ import annotations

from dataclasses import replace

from consistency.bench.filters.textbook import basics
from consistency.bench.filters.textbook.basics import SlamState
from consistency.bench.types import Control, Info
from consistency.referee.types import Array

PASSES = 5  # linearisations of an update; the first is the EKF's


class IteratedKalman(basics.WorldPointFilter):
    """EKF-SLAM whose update is a Gauss-Newton iteration."""

    def __init__(self, name: str, uvd: bool, passes: int = PASSES) -> None:
        super().__init__(name, uvd)
        self.passes = passes

    def predict(self, state: SlamState, control: Control) -> SlamState:
        return basics.predict_extended(state, control)

    def _correct(self, state: SlamState, seen: list[int], z: Array, R: Array) -> tuple[SlamState, Info]:
        x, infos = state.x, []
        for _ in range(self.passes):
            zhat, H = basics.expect(replace(state, x=x), seen, self.uvd)
            innovation = basics.innovation_of(state, z, zhat, self.uvd) - H @ (state.x - x)
            S, W = basics.gain(state.P, H, basics.block_diagonal(R))
            x = state.x + W @ innovation
            infos.append(Info(innovation, S, W))
        return replace(state, x=x, P=state.P - W @ S @ W.T), infos[0]
