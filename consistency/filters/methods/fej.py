"""EKF-SLAM with first-estimates Jacobians (FEJ): Huang, Mourikis & Roumeliotis (2010), IJRR 29(5).

The EKF linearises one variable at several estimates, and the linearised system then seems to tell the heading of
robot and map together, which no relative observation does. With every Jacobian at first estimates
(``point/first_estimate.py``) its unobservable directions are as many as those of SLAM. The price is a linearisation
at estimates that are not the best ones.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from consistency.filters import plain
from consistency.filters.compiled import Compiled
from consistency.filters.kernel.slam import Slam
from consistency.filters.methods import ekf
from consistency.filters.plain import SlamState
from consistency.filters.point.first_estimate import FirstEstimate
from consistency.protocols import Problem
from consistency.types import Array, Control, Gaussian, Info, Observation


@dataclass(frozen=True)
class FirstState:
    """The state of the EKF and the first estimates of its variables."""

    slam: SlamState
    first: Array  # (n,), of the pose the prediction in this step


class FirstEstimateKalman:
    """EKF-SLAM with every variable linearised at its first estimate."""

    robot = plain.Unicycle()

    def __init__(self, name: str, uvd: bool) -> None:
        self.name, self.uvd = name, uvd

    def init(self, problem: Problem) -> FirstState:
        return FirstState(plain.start(problem), problem.start.copy())

    def predict(self, state: FirstState, control: Control) -> FirstState:
        x, F = state.slam.x.copy(), np.eye(len(state.slam.x))
        _, G = self.robot.jacobians(x[:3], control)
        x[:3] = self.robot.move(x[:3], control)
        F[:2, 2] = plain.quarter_turn(x[:2] - state.first[:2])
        P = F @ state.slam.P @ F.T
        P[:3, :3] += plain.process_noise(G, state.slam.problem.belief)
        return FirstState(replace(state.slam, x=x, P=P), np.concatenate([x[:3], state.first[3:]]))

    def update(self, state: FirstState, observation: Observation) -> tuple[FirstState, Info]:
        first, known = state.first, len(state.slam.x)

        def correct(slam: SlamState, seen: list[int], z: Array, R: Array) -> tuple[SlamState, Info]:
            zhat, _ = plain.expect(slam, seen, self.uvd)
            _, H = plain.expect(replace(slam, x=first), seen, self.uvd)
            innovation = z.ravel() - zhat
            S, W = plain.gain(slam.P, H, plain.block_diagonal(R))
            return replace(slam, x=slam.x + W @ innovation, P=slam.P - W @ S @ W.T), Info(innovation, S, W)

        def locate(slam: SlamState, label: int, z: Array) -> tuple[Array, Array, Array]:
            landmark, Jp, Jz = plain.locate_point(slam, z, self.uvd)
            Jp[:2, 2] = plain.quarter_turn(landmark[:2] - first[:2])
            return landmark, Jp, Jz

        slam, info = plain.update_jointly(state.slam, observation, self.uvd, correct, locate)
        return FirstState(slam, np.concatenate([first, slam.x[known:]])), info

    def pose(self, state: FirstState) -> Gaussian:
        return plain.pose_of(state.slam)

    def map(self, state: FirstState) -> dict[int, Gaussian]:
        return plain.map_of(state.slam)

    def joint(self, state: FirstState) -> Gaussian:
        return plain.joint_of(state.slam)


def xyz_parts(problem: Problem, controls: Array) -> Slam:
    """Parts of ``fej-ekf-xyz``."""
    return ekf.xyz_parts(problem, controls)._replace(point=FirstEstimate())


def uvd_parts(problem: Problem, controls: Array) -> Slam:
    """Parts of ``fej-ekf-uvd``."""
    return ekf.uvd_parts(problem, controls)._replace(point=FirstEstimate())


XYZ = Compiled(FirstEstimateKalman("fej-ekf-xyz", uvd=False), xyz_parts, sensors=("xyz", "uvd"), uvd=False)
UVD = Compiled(FirstEstimateKalman("fej-ekf-uvd", uvd=True), uvd_parts, sensors=("uvd",), uvd=True)
