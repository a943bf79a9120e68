"""EKF-SLAM, Herath et al. (2007) eq. 9-13, on (x, y, z) or on (u, v, d)."""

from __future__ import annotations

from dataclasses import replace

from consistency.bench.filters import plain
from consistency.bench.filters.compiled import Compiled, planar
from consistency.bench.filters.covariance_update.dense import Dense
from consistency.bench.filters.error.additive import Additive
from consistency.bench.filters.kernel.slam import Slam
from consistency.bench.filters.parts import landmark_of, motion_of, sensor_of
from consistency.bench.filters.plain import SlamState
from consistency.bench.filters.point.at_estimate import AtEstimate
from consistency.bench.filters.update.joint import Joint
from consistency.bench.protocols import Problem
from consistency.bench.types import Control, Info
from consistency.referee.types import Array


class ExtendedKalman(plain.WorldPointTwin):
    """EKF-SLAM with the joint update of all landmarks seen in a step."""

    def predict(self, state: SlamState, control: Control) -> SlamState:
        return plain.predict_extended(state, control)

    def _correct(self, state: SlamState, seen: list[int], z: Array, R: Array) -> tuple[SlamState, Info]:
        zhat, H = plain.expect(state, seen, self.uvd)
        innovation = plain.innovation_of(state, z, zhat, self.uvd)
        S, W = plain.gain(state.P, H, plain.block_diagonal(R))
        return replace(state, x=state.x + W @ innovation, P=state.P - W @ S @ W.T), Info(innovation, S, W)


def xyz_parts(problem: Problem, controls: Array) -> Slam:
    """Parts of ``ekf-xyz``, and with landmarks in the plane where the sensor has them."""
    belief = problem.belief
    sensor = sensor_of(belief, uvd=False)
    return Slam(motion_of(belief), sensor, landmark_of(belief), Additive(), AtEstimate(), Joint(), Dense())


def uvd_parts(problem: Problem, controls: Array) -> Slam:
    """Parts of ``ekf-uvd``."""
    return xyz_parts(problem, controls)._replace(sensor=sensor_of(problem.belief, uvd=True))


XYZ = Compiled(ExtendedKalman("ekf-xyz", uvd=False), xyz_parts, sensors=("xyz", "uvd"), uvd=False)
UVD = Compiled(ExtendedKalman("ekf-uvd", uvd=True), uvd_parts, sensors=("uvd",), uvd=True)
XY, RB = planar(ExtendedKalman, "ekf", xyz_parts)
