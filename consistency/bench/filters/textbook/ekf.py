"""EKF-SLAM, Herath et al. (2007) eq. 9-13, on (x, y, z) or on (u, v, d)."""

from __future__ import annotations

from dataclasses import replace

from consistency.bench.filters.textbook import basics
from consistency.bench.filters.textbook.basics import SlamState
from consistency.bench.types import Control, Info
from consistency.referee.types import Array


class ExtendedKalman(basics.WorldPointFilter):
    """EKF-SLAM with the joint update of all landmarks seen in a step."""

    def predict(self, state: SlamState, control: Control) -> SlamState:
        return basics.predict_extended(state, control)

    def _correct(self, state: SlamState, seen: list[int], z: Array, R: Array) -> tuple[SlamState, Info]:
        zhat, H = basics.expect(state, seen, self.uvd)
        innovation = basics.innovation_of(state, z, zhat, self.uvd)
        S, W = basics.gain(state.P, H, basics.block_diagonal(R))
        return replace(state, x=state.x + W @ innovation, P=state.P - W @ S @ W.T), Info(innovation, S, W)
