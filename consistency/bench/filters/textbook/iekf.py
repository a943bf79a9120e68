"""Iterated EKF-SLAM: the update linearised again where it led to, Bell & Cathey (1993).

Each pass linearises h at the result of the one before and solves from the same prior; what it converges to is the
most probable state. The covariance is that of the last pass, from the prior.
"""

from __future__ import annotations

from consistency.bench.filters.textbook import basics
from consistency.bench.filters.textbook.basics import SlamState
from consistency.bench.filters.textbook.ekf import ExtendedKalman
from consistency.bench.types import Info
from consistency.referee.types import Array

PASSES = 5  # linearisations of an update; the first is the EKF's


class IteratedKalman(ExtendedKalman):
    def _correct(self, state: SlamState, seen: list[int], z: Array, R: Array) -> tuple[SlamState, Info]:
        after, infos = state, []
        for _ in range(PASSES):
            zhat, H = basics.expect(after, seen, self.uvd)
            innovation = basics.innovation_of(state, z, zhat, self.uvd) - H @ (state.x - after.x)
            after, info = basics.corrected(state, H, innovation, R)
            infos.append(info)
        return after, infos[0]
