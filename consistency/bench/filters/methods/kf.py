"""The linear Kalman filter, exact in a linear-Gaussian world, Herath et al. (2007) eq. 1-8."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from consistency.bench.filters import plain
from consistency.bench.filters.compiled import Compiled
from consistency.bench.filters.covariance_update.dense import Dense
from consistency.bench.filters.error.additive import Additive
from consistency.bench.filters.kernel.slam import Slam
from consistency.bench.filters.landmark.world_point import WorldPoint
from consistency.bench.filters.parts import motion_of, sensor_of
from consistency.bench.filters.plain import SlamState
from consistency.bench.filters.plain_sensors import PointSensor
from consistency.bench.filters.point.reference import Reference
from consistency.bench.filters.update.joint import Joint
from consistency.bench.models.motion import dead_reckoning
from consistency.bench.protocols import Problem
from consistency.bench.types import Control, Gaussian, Info, Observation
from consistency.referee.types import Array


@dataclass(frozen=True)
class LinearState:
    """State of a linear world, and the dead-reckoned pose at which it is linearised."""

    slam: SlamState
    reference: Array  # (3,)


class LinearKalman:
    """Kalman filter of a linear world: every Jacobian at the known reference."""

    name = "kf"
    robot = plain.Unicycle()

    def init(self, problem: Problem) -> LinearState:
        plain.require_landmarks(problem, self.name)
        return LinearState(plain.start(problem), problem.start.copy())

    def predict(self, state: LinearState, control: Control) -> LinearState:
        F, G = self.robot.jacobians(state.reference, control)
        reference = self.robot.move(state.reference, control)
        x, P = state.slam.x.copy(), state.slam.P.copy()
        x[:3] = reference + F @ (x[:3] - state.reference)
        P[:3] = F @ P[:3]
        P[:, :3] = P[:, :3] @ F.T
        P[:3, :3] += plain.process_noise(G, state.slam.problem.belief)
        return LinearState(replace(state.slam, x=x, P=P), reference)

    def update(self, state: LinearState, observation: Observation) -> tuple[LinearState, Info]:
        reference, landmarks = state.reference, plain.require_landmarks(state.slam.problem, self.name)

        def correct(slam: SlamState, seen: list[int], z: Array, R: Array) -> tuple[SlamState, Info]:
            known = np.concatenate([reference, *(landmarks[label] for label in slam.landmarks)])
            zhat, H = plain.expect(replace(slam, x=known), seen, uvd=False)
            innovation = z.ravel() - (zhat + H @ (slam.x - known))
            S, W = plain.gain(slam.P, H, plain.block_diagonal(R))
            return replace(slam, x=slam.x + W @ innovation, P=slam.P - W @ S @ W.T), Info(innovation, S, W)

        def locate(slam: SlamState, label: int, z: Array) -> tuple[Array, Array, Array]:
            sensor = PointSensor(slam.problem.belief.sensor, uvd=False)
            Hp, Hl = sensor.jacobians(reference, landmarks[label])
            Jz = np.linalg.inv(Hl)
            error = z - sensor.measure(reference, landmarks[label]) - Hp @ (slam.x[:3] - reference)
            return landmarks[label] + Jz @ error, -Jz @ Hp, Jz

        slam, info = plain.update_jointly(state.slam, observation, False, correct, locate)
        return replace(state, slam=slam), info

    def forget(self, state: LinearState, landmark: int) -> LinearState:
        return replace(state, slam=plain.without(state.slam, landmark))

    def pose(self, state: LinearState) -> Gaussian:
        return plain.pose_of(state.slam)

    def map(self, state: LinearState) -> dict[int, Gaussian]:
        return plain.map_of(state.slam)

    def joint(self, state: LinearState) -> Gaussian:
        return plain.joint_of(state.slam)


def parts(problem: Problem, controls: Array) -> Slam:
    """Parts of the filter; the reference is the path that the controls plan."""
    belief, landmarks = problem.belief, plain.require_landmarks(problem, "kf")
    reference = Reference(dead_reckoning(problem.start, controls), np.array(landmarks, float))
    return Slam(motion_of(belief), sensor_of(belief, uvd=False), WorldPoint(), Additive(), reference, Joint(), Dense())


FILTER = Compiled(LinearKalman(), parts, sensors=("linear",), uvd=False, innovations="optimal")
