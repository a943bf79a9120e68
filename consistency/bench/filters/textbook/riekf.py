"""Right-invariant EKF-SLAM, Barrau & Bonnabel (2015), "An EKF-SLAM algorithm with consistency properties".

Robot and landmarks are one element X of SE_{1+K}(2), and the error is Log(X X^-1), truth before estimate: a turn of
everything about the world's origin, and the shifts that are left. With J the quarter turn, additive errors follow
from it by dp = xi_p + J p xi_heading and dl = xi_l + J l xi_heading. The error of the estimate does not change in
motion (F = I), and an observation does not see a turn of everything, at whatever estimate it is linearised: what the
EKF wrongly gains about the heading is never gained. Heights are additive.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.linalg import expm

from consistency.bench.filters.textbook import basics
from consistency.bench.filters.textbook.basics import SlamState
from consistency.bench.filters.textbook.ekf import ExtendedKalman
from consistency.bench.types import Control, Gaussian, Info
from consistency.referee.types import Array


class RightInvariantKalman(ExtendedKalman):
    """EKF-SLAM in the right-invariant error, every Jacobian by its definition: T maps the error to the additive one."""

    error = "right"

    def predict(self, state: SlamState, control: Control) -> SlamState:
        n, x = len(state.x), state.x.copy()
        F, G = np.eye(n), np.zeros((n, 2))
        F[:3, :3], G[:3] = basics.motion_jacobians(x[:3], control)
        x[:3] = basics.pose_after(x[:3], control)
        back, w = np.linalg.inv(additive_from_right(x, state.width)), state.width
        F, G = back @ F @ additive_from_right(state.x, w), back @ G
        return replace(state, x=x, P=F @ state.P @ F.T + basics.process_noise(G, state.problem.belief))

    def _correct(self, state: SlamState, seen: list[int], z: Array, R: Array) -> tuple[SlamState, Info]:
        zhat, H = basics.expect(state, seen, self.uvd)
        innovation = basics.innovation_of(state, z, zhat, self.uvd)
        after, info = basics.corrected(state, H @ additive_from_right(state.x, state.width), innovation, R)
        return replace(after, x=moved_by_right(state.x, info.gain @ innovation, state.width)), info

    def _locate(self, state: SlamState, label: int, z: Array) -> tuple[Array, Array, Array]:
        landmark, Jp, Jz = basics.locate_point(state, z, self.uvd)
        Jp = Jp @ additive_from_right(state.x[:3])
        Jp[:2, 2] -= basics.quarter_turn(landmark[:2])
        return landmark, Jp, Jz

    def pose(self, state: SlamState) -> Gaussian:
        T = additive_from_right(state.x[:3])
        return Gaussian(state.x[:3], T @ state.P[:3, :3] @ T.T)

    def own_covariance(self, state: SlamState) -> Array:
        return state.P[:3, :3]

    def map(self, state: SlamState) -> dict[int, Gaussian]:
        return basics.map_of_state(_additive(state))

    def joint(self, state: SlamState) -> Gaussian:
        return basics.joint_of(_additive(state))


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
