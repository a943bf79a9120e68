"""Right-invariant EKF-SLAM, Barrau & Bonnabel (2015), "An EKF-SLAM algorithm with consistency properties".

Robot and landmarks are one element X of SE_{1+K}(2), and the error is Log(X X^-1), truth before estimate: a turn of
everything about the world's origin, and the shifts that are left. With J the quarter turn, additive errors follow
from it by dp = xi_p + J p xi_heading and dl = xi_l + J l xi_heading. The error of the estimate does not change in
motion (F = I), and an observation does not see a turn of everything, at whatever estimate it is linearised: what the
EKF wrongly gains about the heading is never gained. Heights are additive.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import expm

from consistency.bench.filters import plain
from consistency.bench.filters.compiled import Compiled, planar
from consistency.bench.filters.error.planar import exponential, shifted_covariance
from consistency.bench.filters.kernel.arrays import fill
from consistency.bench.filters.kernel.blas import add_gram, add_transposed_times
from consistency.bench.filters.kernel.dispatch import implement, part
from consistency.bench.filters.kernel.jit import inner
from consistency.bench.filters.kernel.slam import (
    Slam,
    State,
    insert_error,
    landmark_width,
    move,
    noise_columns,
    pose_covariance,
    propagate,
    retract,
    to_error,
)
from consistency.bench.filters.kernel.work import Work
from consistency.bench.filters.methods import ekf
from consistency.bench.filters.plain import SlamState
from consistency.bench.protocols import Problem
from consistency.bench.types import Control, Gaussian, Info, Observation
from consistency.referee.types import Array


@part(motion="Unicycle", landmark="WorldPoint PlanarPoint", point="AtEstimate", update="Joint", covariance="Dense")
class RightInvariant(NamedTuple):
    """No parameters. Motion moves the error of every landmark, so updating is dense."""


@implement(propagate, RightInvariant)
def propagate_right(
    error: RightInvariant, slam: Slam, state: State, k: int, u: Array, Phi: Array, work: Work[NamedTuple]
) -> None:
    """x <- f(x) and P <- P + Ad G Q G' Ad': F is the identity, and the noise turns with the world, (n, q)."""
    x, P, n, w, G = state.x, state.P, state.n, landmark_width(slam.landmark), work.small
    columns = noise_columns(slam.motion, x[:3], u, G)
    move(slam.motion, x[:3], u, x[:3])
    noise = work.rows[:columns, :n]
    for c in range(columns):
        turn = G[2, c]
        noise[c, 0], noise[c, 1], noise[c, 2] = G[0, c] + x[1] * turn, G[1, c] - x[0] * turn, turn
        for o in range(3, n, w):
            noise[c, o], noise[c, o + 1] = x[o + 1] * turn, -x[o] * turn
            fill(noise[c, o + 2 : o + w], 0.0)
    add_gram(1.0, noise, P[:n, :n])
    for a in range(3):
        for b in range(a):
            P[a, b] = P[b, a]


@implement(to_error, RightInvariant)
def to_right(error: RightInvariant, pose: Array, values: Array, Hp: Array, Hl: Array) -> None:
    for a in range(len(Hp)):
        Hp[a, 2] += pose[0] * Hp[a, 1] - pose[1] * Hp[a, 0] + values[0] * Hl[a, 1] - values[1] * Hl[a, 0]


@implement(insert_error, RightInvariant)
def insert_right(error: RightInvariant, pose: Array, values: Array, Jp: Array) -> None:
    """Jp (w, 3) <- Jacobian between the errors of the robot and of a new landmark."""
    for a in range(len(Jp)):
        Jp[a, 2] += pose[0] * Jp[a, 1] - pose[1] * Jp[a, 0]
    Jp[0, 2] += values[1]
    Jp[1, 2] -= values[0]


@implement(retract, RightInvariant)
def retract_right(error: RightInvariant, slam: Slam, state: State, A: Array, y: Array, work: Work[NamedTuple]) -> None:
    """x (n,) <- exp(A' y) x, of the robot and of every landmark, with A (k, n) and y (k,)."""
    x, delta = state.x, work.delta[: state.n]
    fill(delta, 0.0)
    add_transposed_times(A, y, delta)
    c, s, along, across = exponential(delta[2])
    _move(x, delta, 0, c, s, along, across)
    x[2] += delta[2]
    w = landmark_width(slam.landmark)
    for o in range(3, state.n, w):
        _move(x, delta, o, c, s, along, across)
        for a in range(2, w):
            x[o + a] += delta[o + a]


@inner
def _move(x: Array, delta: Array, o: int, c: float, s: float, along: float, across: float) -> None:
    """x, y at ``o`` <- R x + V delta, the planar exponential."""
    x0, x1, d0, d1 = x[o], x[o + 1], delta[o], delta[o + 1]
    x[o] = c * x0 - s * x1 + along * d0 - across * d1
    x[o + 1] = s * x0 + c * x1 + across * d0 + along * d1


@implement(pose_covariance, RightInvariant)
def right_pose_covariance(error: RightInvariant, x: Array, P: Array, out: Array) -> None:
    shifted_covariance(x, P, out)


class RightInvariantKalman(plain.SlamTwin):
    """EKF-SLAM in the right-invariant error, every Jacobian by its definition: T maps the error to the additive one."""

    error = "right"
    robot = plain.Unicycle()

    def __init__(self, name: str, uvd: bool) -> None:
        self.name, self.uvd = name, uvd

    def init(self, problem: Problem) -> SlamState:
        return plain.start(problem)

    def predict(self, state: SlamState, control: Control) -> SlamState:
        n, x = len(state.x), state.x.copy()
        F, G = np.eye(n), np.zeros((n, 2))
        F[:3, :3], G[:3] = self.robot.jacobians(x[:3], control)
        x[:3] = self.robot.move(x[:3], control)
        back, w = np.linalg.inv(additive_from_right(x, state.width)), state.width
        F, G = back @ F @ additive_from_right(state.x, w), back @ G
        return replace(state, x=x, P=F @ state.P @ F.T + plain.process_noise(G, state.problem.belief))

    def update(self, state: SlamState, observation: Observation) -> tuple[SlamState, Info]:
        return plain.update_jointly(state, observation, self.uvd, self._correct, self._locate)

    def _correct(self, state: SlamState, seen: list[int], z: Array, R: Array) -> tuple[SlamState, Info]:
        zhat, H = plain.expect(state, seen, self.uvd)
        innovation = plain.innovation_of(state, z, zhat, self.uvd)
        S, W = plain.gain(state.P, H @ additive_from_right(state.x, state.width), plain.block_diagonal(R))
        moved = moved_by_right(state.x, W @ innovation, state.width)
        return replace(state, x=moved, P=state.P - W @ S @ W.T), Info(innovation, S, W)

    def _locate(self, state: SlamState, label: int, z: Array) -> tuple[Array, Array, Array]:
        landmark, Jp, Jz = plain.locate_point(state, z, self.uvd)
        Jp = Jp @ additive_from_right(state.x[:3])
        Jp[:2, 2] -= plain.quarter_turn(landmark[:2])
        return landmark, Jp, Jz

    def pose(self, state: SlamState) -> Gaussian:
        T = additive_from_right(state.x[:3])
        return Gaussian(state.x[:3], T @ state.P[:3, :3] @ T.T)

    def own_covariance(self, state: SlamState) -> Array:
        """Covariance (3, 3) of the right-invariant error of the pose."""
        return state.P[:3, :3]

    def map(self, state: SlamState) -> dict[int, Gaussian]:
        return plain.map_of(_additive(state))

    def joint(self, state: SlamState) -> Gaussian:
        return plain.joint_of(_additive(state))


def _additive(state: SlamState) -> SlamState:
    """The state with the covariance of its additive error."""
    T = additive_from_right(state.x, state.width)
    return replace(state, P=T @ state.P @ T.T)


def additive_from_right(x: Array, width: int = 3) -> Array:
    """T (n, n) with additive error = T right-invariant error, at the state x (n,), landmarks of ``width``."""
    T = np.eye(len(x))
    for o in (0, *range(3, len(x), width)):
        T[o, 2], T[o + 1, 2] = -x[o + 1], x[o]
    T[2, 2] = 1.0
    return T


def moved_by_right(x: Array, xi: Array, width: int = 3) -> Array:
    """Exp(xi) X: state (n,) moved by a right-invariant error (n,), each point by an exponential of SE(2)."""
    moved = x + xi  # heading and heights are additive
    for o in (0, *range(3, len(x), width)):
        E = expm(np.array([[0.0, -xi[2], xi[o]], [xi[2], 0.0, xi[o + 1]], [0.0, 0.0, 0.0]]))
        moved[o : o + 2] = (E @ [x[o], x[o + 1], 1.0])[:2]
    return moved


def xyz_parts(problem: Problem, controls: Array) -> Slam:
    """Parts of ``ri-ekf-xyz``, and with landmarks in the plane where the sensor has them."""
    return ekf.xyz_parts(problem, controls)._replace(error=RightInvariant())


def uvd_parts(problem: Problem, controls: Array) -> Slam:
    """Parts of ``ri-ekf-uvd``."""
    return ekf.uvd_parts(problem, controls)._replace(error=RightInvariant())


XYZ = Compiled(
    RightInvariantKalman("ri-ekf-xyz", uvd=False), xyz_parts, sensors=("xyz", "uvd"), uvd=False, error="right"
)
UVD = Compiled(RightInvariantKalman("ri-ekf-uvd", uvd=True), uvd_parts, sensors=("uvd",), uvd=True, error="right")
XY, RB = planar(RightInvariantKalman, "ri-ekf", xyz_parts, error="right")
