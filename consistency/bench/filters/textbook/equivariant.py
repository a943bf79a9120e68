"""Equivariant filter SLAM: a robot-centred map in the polar symmetry of landmarks, van Goor & Mahony (2205.01980).

The symmetry group is SE(2) for the robot times SOT(3), turns and scalings, for each landmark. A landmark is its
position q in the frame of the sensor, m. Its error eps = (left, up, s) is the turn about the two axes across the line
of sight, and the logarithm of the scale, that take the estimate to the truth. With the unit vectors n of the line of
sight, b1 to the left of it and b2 up,

    q = e^s exp(left Omega_1 + up Omega_2) q_est,    Omega_1 = n x b1 = b2,    Omega_2 = n x b2 = -b1.

The error of the robot is right-invariant, T_true = Exp(xi) T. Motion does not change it (F = I). A landmark moves as
q -> A' (R' (A q + t - p) - t), for the displacement (R, p) of a robot on which the sensor sits at t with the axes A,
and its error by the derivative of this. The paper has the same group with SE(3), and velocities that an IMU gives.

An observation (u, v, d) of stereo is q in other coordinates, so the group acts on it, too: the output is equivariant.
With h the projection of eq. 22, h(q) - h(q_est) = C* eps + O(eps^3), where

    C* = 1/2 (h'(q_est) [Omega_1 x q_est, Omega_2 x q_est, q_est] + h'(y) [Omega_1 x y, Omega_2 x y, y])

and y is the point that the observation is of, eq. 21: the trapezoidal rule along the curve of the group from q_est to q
(van Goor, Hamel & Mahony, 2010.14666, who show it for bearings). The pose has no part in it. The first half alone
is the output matrix of an extended Kalman filter; y stands for q, so that noise enters C* at second order.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

from consistency.bench.filters.textbook import basics
from consistency.bench.filters.textbook.basics import PointSensor, SlamState, heading_matrix, mounted
from consistency.bench.filters.textbook.ekf import ExtendedKalman
from consistency.bench.filters.textbook.riekf import additive_from_right
from consistency.bench.scenario.models import Mounting
from consistency.bench.types import Control, Gaussian, Info
from consistency.referee.types import Array


class EquivariantKalman(ExtendedKalman):
    error = "right"

    def predict(self, state: SlamState, control: Control) -> SlamState:
        before, after = state.x[:3], basics.pose_after(state.x[:3], control)
        t, A = mounted(state.problem.belief.sensor)
        _, G = basics.motion_jacobians(before, control)
        to_sensor = A.T @ heading_matrix(after[2]).T  # of a direction in the world
        x, F, noise = [after], [np.eye(3)], [np.linalg.inv(additive_from_right(after)) @ G]
        for q in state.x[3:].reshape(-1, 3):
            world = _in_world(before, A @ q + t)
            moved = to_sensor @ (world - _in_world(after, t))
            back = np.linalg.inv(_along_group(moved, moved))
            x.append(moved)
            F.append(back @ to_sensor @ heading_matrix(before[2]) @ A @ _along_group(q, q))
            noise.append(-back @ to_sensor @ _by_pose(after, world) @ G)
        whole, G = block_diag(*F), np.concatenate(noise)
        P = whole @ state.P @ whole.T + basics.process_noise(G, state.problem.belief)
        return replace(state, x=np.concatenate(x), P=P)

    def _correct(self, state: SlamState, seen: list[int], z: Array, R: Array) -> tuple[SlamState, Info]:
        sensor = _in_own_frame(state)
        zhat, H = np.zeros_like(z), np.zeros((3 * len(seen), len(state.x)))
        for i, label in enumerate(seen):
            at = slice(state.at(label), state.at(label) + 3)
            q, y = state.x[at], sensor.locate(np.zeros(3), z[i])[0]
            zhat[i] = sensor.measure(np.zeros(3), q)
            halves = [sensor.jacobians(np.zeros(3), p)[1] @ _along_group(q, p) for p in (q, y)]
            H[3 * i : 3 * i + 3, at] = (halves[0] + halves[1]) / 2.0
        innovation = (z - zhat).ravel()
        after, info = basics.corrected(state, H, innovation, R)
        return replace(after, x=_moved(state.x, info.gain @ innovation)), info

    def _locate(self, state: SlamState, label: int, z: Array) -> tuple[Array, Array, Array]:
        q, _, J = _in_own_frame(state).locate(np.zeros(3), z)
        return q, np.zeros((3, 3)), np.linalg.inv(_along_group(q, q)) @ J

    def pose(self, state: SlamState) -> Gaussian:
        T = additive_from_right(state.x[:3])
        return Gaussian(state.x[:3], T @ state.P[:3, :3] @ T.T)

    def own_covariance(self, state: SlamState) -> Array:
        return state.P[:3, :3]

    def map(self, state: SlamState) -> dict[int, Gaussian]:
        joint = self.joint(state)
        blocks = {label: slice(state.at(label), state.at(label) + 3) for label in state.landmarks}
        return {label: Gaussian(joint.mean[at], joint.covariance[at, at]) for label, at in blocks.items()}

    def joint(self, state: SlamState) -> Gaussian:
        """Robot and landmarks in the world together, (n,) and (n, n), additive errors."""
        pose, mean, D = state.x[:3], state.x.copy(), np.zeros_like(state.P)
        t, A = mounted(state.problem.belief.sensor)
        D[:3, :3] = additive_from_right(pose)
        for label in state.landmarks:
            at = slice(state.at(label), state.at(label) + 3)
            q = state.x[at]
            mean[at] = _in_world(pose, A @ q + t)
            D[at, :3] = _by_pose(pose, mean[at]) @ D[:3, :3]
            D[at, at] = heading_matrix(pose[2]) @ A @ _along_group(q, q)
        return Gaussian(mean, D @ state.P @ D.T)


def _in_world(pose: Array, body: Array) -> Array:
    """A point (3,) in the frame of a robot at ``pose`` (3,), in the world, m."""
    return np.asarray(heading_matrix(pose[2]) @ body + [pose[0], pose[1], 0.0])


def _by_pose(pose: Array, world: Array) -> Array:
    """Derivative (3, 3) of a point ``world`` (3,) by the pose (3,) of a robot that carries it along."""
    return np.array([[1.0, 0.0, pose[1] - world[1]], [0.0, 1.0, world[0] - pose[0]], [0.0, 0.0, 0.0]])


def _in_own_frame(state: SlamState) -> PointSensor:
    """The sensor with its own frame for the robot's."""
    sensor = PointSensor(state.problem.belief.sensor, uvd=True)
    sensor.mount, sensor.turn = Mounting(0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1), np.eye(3)
    return sensor


def _turns(q: Array) -> tuple[Array, Array]:
    """Omega_1 and Omega_2 (3,) of the line of sight to q (3,)."""
    left = np.cross([0.0, 0.0, 1.0], q)
    left /= np.linalg.norm(left)
    return np.cross(q, left) / np.linalg.norm(q), -left


def _along_group(q: Array, p: Array) -> Array:
    """Derivative (3, 3) of the point p (3,) by an error about the estimate q (3,)."""
    return np.column_stack([*(np.cross(turn, p) for turn in _turns(q)), p])


def _moved(x: Array, error: Array) -> Array:
    """The state (n,) moved by an error (n,)."""
    moved = x.copy()
    E = Rotation.from_rotvec([0.0, 0.0, error[2]]).as_matrix()[:2, :2]
    c, s, t = np.cos(error[2]), np.sin(error[2]), error[2]
    V = np.array([[s, c - 1.0], [1.0 - c, s]]) / t if abs(t) > 1e-9 else np.eye(2)
    moved[:2], moved[2] = E @ x[:2] + V @ error[:2], x[2] + t
    for o in range(3, len(x), 3):
        one, two = _turns(x[o : o + 3])
        turn = Rotation.from_rotvec(error[o] * one + error[o + 1] * two)
        moved[o : o + 3] = np.exp(error[o + 2]) * turn.apply(x[o : o + 3])
    return moved
