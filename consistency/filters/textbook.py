"""The plain twins: SLAM filters as a textbook writes them, dense and in NumPy, for reading and as oracles.

Herath, Kodagoda & Dissanayake (2007) eq. 1-13; sigma points after Julier & Uhlmann (2004) over the
whole state. Nothing is shared with the kernels but the models.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from consistency.errors import InputError
from consistency.models import motion, point, stereo
from consistency.protocols import Problem
from consistency.scenario import Belief, BelievedSensor
from consistency.types import Array, Control, Gaussian, Info, Observation


@dataclass(frozen=True)
class SlamState:
    """Robot, then landmarks in the order in which they were first seen."""

    x: Array  # (n,)
    P: Array  # (n, n)
    landmarks: tuple[int, ...]
    problem: Problem
    reference: Array  # (3,), dead-reckoned pose: the linearisation point of a linear world

    def at(self, landmark: int) -> int:
        """Offset of a landmark in x."""
        return 3 + 3 * self.landmarks.index(landmark)


def sensor_noise(z: Array, sensor: BelievedSensor, converted: bool) -> tuple[Array, Array]:
    """Observations (M, 3) and their noise (M, 3, 3), for an xyz filter on uvd data by eq. 21.

    The transformed noise is J diag(sigma^2) J' with J the Jacobian of eq. 21 at the measurement.
    """
    variance = np.diag(np.square(sensor.sigma))
    if not converted:
        return z, np.broadcast_to(variance, (len(z), 3, 3)).copy()
    f, B = sensor.f or 0.0, sensor.B or 0.0
    u, v, d = z.T
    J = np.stack(np.broadcast_arrays(*stereo.triangulate_jacobian(u, v, d, f, B)), axis=-1).reshape(-1, 3, 3)
    return np.column_stack(stereo.triangulate(u, v, d, f, B)), J @ variance @ np.swapaxes(J, 1, 2)


class Unicycle:
    """Eq. 18."""

    def move(self, pose: Array, control: Control) -> Array:
        return np.array(motion.unicycle(pose[0], pose[1], pose[2], control.dt, control.v, control.omega))

    def jacobians(self, pose: Array, control: Control) -> tuple[Array, Array]:
        """F (3, 3) with respect to the pose and G (3, 2) with respect to (v, omega)."""
        c, s, dt = np.cos(pose[2]), np.sin(pose[2]), control.dt
        F = np.array([[1, 0, -dt * control.v * s], [0, 1, dt * control.v * c], [0, 0, 1]])
        G = np.array([[dt * c, 0], [dt * s, 0], [0, dt]])
        return F, G


class PointSensor:
    """Eq. 19 (``xyz``) or eq. 22 (``uvd``) from a mounted sensor."""

    def __init__(self, sensor: BelievedSensor, uvd: bool) -> None:
        self.f, self.B, self.uvd = sensor.f or 0.0, sensor.B or 0.0, uvd
        self.mount = sensor.mount.packed()
        self.turn = self.mount[3:].reshape(3, 3)  # sensor axes in the robot frame

    def measure(self, pose: Array, landmark: Array) -> Array:
        """h: landmarks (..., 3) seen from poses (..., 3)."""
        body = point.to_robot(*np.moveaxis(pose, -1, 0), *np.moveaxis(landmark, -1, 0))
        x, y, z = point.to_sensor(*body, self.mount)
        return np.stack(stereo.project(x, y, z, self.f, self.B) if self.uvd else (x, y, z), axis=-1)

    def jacobians(self, pose: Array, landmark: Array) -> tuple[Array, Array]:
        """dh/d pose and dh/d landmark, each (3, 3)."""
        body = point.to_robot(*pose, *landmark)
        c = point.to_sensor(*body, self.mount)
        J = np.reshape(stereo.project_jacobian(*c, self.f, self.B), (3, 3)) if self.uvd else np.eye(3)
        world_to_robot = _heading_matrix(pose[2]).T
        d_body = np.column_stack([-world_to_robot[:, 0], -world_to_robot[:, 1], [body[1], -body[0], 0.0]])
        return J @ self.turn.T @ d_body, J @ self.turn.T @ world_to_robot

    def locate(self, pose: Array, z: Array) -> tuple[Array, Array, Array]:
        """Landmark (3,) from one observation, with its Jacobians with respect to pose and z."""
        c, J = z, np.eye(3)
        if self.uvd:
            u, v, d = z
            c = np.array(stereo.triangulate(u, v, d, self.f, self.B))
            J = np.reshape(stereo.triangulate_jacobian(u, v, d, self.f, self.B), (3, 3))
        body = point.from_sensor(c[0], c[1], c[2], self.mount)
        robot_to_world = _heading_matrix(pose[2])
        d_heading = robot_to_world @ [-body[1], body[0], 0.0]
        d_pose = np.column_stack([[1.0, 0, 0], [0, 1.0, 0], d_heading])
        return np.array(point.to_world(pose[0], pose[1], pose[2], *body)), d_pose, robot_to_world @ self.turn @ J


def _heading_matrix(heading: float) -> Array:
    c, s = np.cos(heading), np.sin(heading)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])


def process_noise(G: Array, belief: Belief) -> Array:
    """G Q G' with Q = diag(sigma_v^2, sigma_omega^2), shape (3, 3)."""
    Q = np.diag(np.square([belief.motion.sigma_v, belief.motion.sigma_omega]))
    return np.asarray(G @ Q @ G.T)


class ExtendedKalman:
    """EKF-SLAM, eq. 9-13, with the joint update of all landmarks seen in a step."""

    def __init__(self, name: str, uvd: bool) -> None:
        self.name, self.uvd = name, uvd
        self.motion = Unicycle()

    def init(self, problem: Problem) -> SlamState:
        if problem.belief.sensor.model == "linear" and problem.landmarks is None:
            raise InputError(f"filter '{self.name}' needs the landmarks that its world is linearised about")
        return SlamState(problem.start.copy(), np.zeros((3, 3)), (), problem, problem.start.copy())

    def pose(self, state: SlamState) -> Gaussian:
        return Gaussian(state.x[:3], state.P[:3, :3])

    def predict(self, state: SlamState, control: Control) -> SlamState:
        x, n = state.x.copy(), len(state.x)
        F = np.eye(n)
        F[:3, :3], G = self.motion.jacobians(x[:3], control)
        x[:3] = self.motion.move(x[:3], control)
        P = F @ state.P @ F.T
        P[:3, :3] += process_noise(G, state.problem.belief)
        return replace(state, x=x, P=P, reference=self.motion.move(state.reference, control))

    def update(self, state: SlamState, observation: Observation) -> tuple[SlamState, Info]:
        sensor = state.problem.belief.sensor
        z, R = sensor_noise(observation.z, sensor, converted=sensor.model == "uvd" and not self.uvd)
        is_known = np.array([int(label) in state.landmarks for label in observation.landmarks], dtype=bool)
        seen = [int(label) for label in observation.landmarks[is_known]]
        info = Info(np.zeros(0), np.zeros((0, 0)), np.zeros((len(state.x), 0)))
        if seen:
            state, info = self._correct(state, seen, z[is_known], _block_diagonal(R[is_known]))
        for i in np.flatnonzero(~is_known):
            state = self._augment(state, int(observation.landmarks[i]), z[i], R[i])
        return state, info

    def _correct(self, state: SlamState, seen: list[int], z: Array, R: Array) -> tuple[SlamState, Info]:
        zhat, H = self._expected(state, seen)
        innovation = z.ravel() - zhat
        S = H @ state.P @ H.T + R
        W = np.linalg.solve(S, H @ state.P).T
        x, P = state.x + W @ innovation, state.P - W @ S @ W.T
        return replace(state, x=x, P=P), Info(innovation, S, W)

    def _expected(self, state: SlamState, seen: list[int]) -> tuple[Array, Array]:
        """h (3 m,) and its Jacobian H (3 m, n) at the predicted state."""
        sensor = PointSensor(state.problem.belief.sensor, self.uvd)
        zhat, H = np.zeros(3 * len(seen)), np.zeros((3 * len(seen), len(state.x)))
        for i, label in enumerate(seen):
            rows, at = slice(3 * i, 3 * i + 3), slice(state.at(label), state.at(label) + 3)
            zhat[rows] = sensor.measure(state.x[:3], state.x[at])
            H[rows, :3], H[rows, at] = sensor.jacobians(state.x[:3], state.x[at])
        return zhat, H

    def _augment(self, state: SlamState, label: int, z: Array, R: Array) -> SlamState:
        """A new landmark by eq. 21, with its full cross-covariance."""
        landmark, Jp, Jz = self._locate(state, label, z)
        n = len(state.x)
        J = np.zeros((n + 3, n))
        J[:n] = np.eye(n)
        J[n:, :3] = Jp
        P = J @ state.P @ J.T
        P[n:, n:] += Jz @ R @ Jz.T
        return replace(state, x=np.append(state.x, landmark), P=P, landmarks=(*state.landmarks, label))

    def _locate(self, state: SlamState, label: int, z: Array) -> tuple[Array, Array, Array]:
        return PointSensor(state.problem.belief.sensor, self.uvd).locate(state.x[:3], z)


class LinearKalman(ExtendedKalman):
    """The Kalman filter, eq. 1-8, of a linear world: every Jacobian at the known reference."""

    def predict(self, state: SlamState, control: Control) -> SlamState:
        F, G = self.motion.jacobians(state.reference, control)
        reference = self.motion.move(state.reference, control)
        x, P = state.x.copy(), state.P.copy()
        x[:3] = reference + F @ (state.x[:3] - state.reference)
        P[:3] = F @ P[:3]
        P[:, :3] = P[:, :3] @ F.T
        P[:3, :3] += process_noise(G, state.problem.belief)
        return replace(state, x=x, P=P, reference=reference)

    def _expected(self, state: SlamState, seen: list[int]) -> tuple[Array, Array]:
        assert state.problem.landmarks is not None
        known = np.concatenate([state.reference, *(state.problem.landmarks[label] for label in state.landmarks)])
        zhat, H = super()._expected(replace(state, x=known), seen)
        return zhat + H @ (state.x - known), H

    def _locate(self, state: SlamState, label: int, z: Array) -> tuple[Array, Array, Array]:
        assert state.problem.landmarks is not None
        landmark = state.problem.landmarks[label]
        sensor = PointSensor(state.problem.belief.sensor, uvd=False)
        Hp, Hl = sensor.jacobians(state.reference, landmark)
        Jz = np.linalg.inv(Hl)
        error = z - sensor.measure(state.reference, landmark) - Hp @ (state.x[:3] - state.reference)
        return landmark + Jz @ error, -Jz @ Hp, Jz


class Unscented(ExtendedKalman):
    """UKF-SLAM over the whole state.

    The variables are ordered robot, landmarks seen in this step (as observed), the rest before the
    Cholesky square root is taken; spread and centre weight are those of the L variables involved. New
    landmarks are initialised to first order: with a spread of sqrt(L) standard deviations a sigma point
    of a landmark below about 2 px of disparity would lie behind the camera.
    """

    def predict(self, state: SlamState, control: Control) -> SlamState:
        points, wm, wc = sigma_points(state.x, state.P, np.arange(3), state.problem.belief)
        moved = points.copy()
        moved[:, :3] = [self.motion.move(p[:3], control) for p in points]
        x = wm @ moved
        P = (moved - x).T @ (wc[:, None] * (moved - x))
        _, G = self.motion.jacobians(state.x[:3], control)
        P[:3, :3] += process_noise(G, state.problem.belief)
        return replace(state, x=x, P=P, reference=self.motion.move(state.reference, control))

    def _correct(self, state: SlamState, seen: list[int], z: Array, R: Array) -> tuple[SlamState, Info]:
        at = np.array([state.at(label) for label in seen])[:, None] + np.arange(3)
        involved = np.concatenate([np.arange(3), at.ravel()])
        points, wm, wc = sigma_points(state.x, state.P, involved, state.problem.belief)
        sensor = PointSensor(state.problem.belief.sensor, self.uvd)
        Z = sensor.measure(points[:, None, :3], points[:, at]).reshape(len(points), -1)
        zhat = wm @ Z
        S = (Z - zhat).T @ (wc[:, None] * (Z - zhat)) + R
        W = np.linalg.solve(S, (Z - zhat).T @ (wc[:, None] * (points - state.x))).T
        innovation = z.ravel() - zhat
        x, P = state.x + W @ innovation, state.P - W @ S @ W.T
        return replace(state, x=x, P=P), Info(innovation, S, W)


def sigma_points(x: Array, P: Array, involved: Array, belief: Belief) -> tuple[Array, Array, Array]:
    """2 n + 1 points (2 n + 1, n) of the whole state, and their weights for mean and covariance.

    The spread alpha sqrt(L + kappa) counts the L ``involved`` variables, which come first in the square
    root. The centre weight is what makes the weights sum to one over all n.
    """
    n, L, set_ = len(x), len(involved), belief.sigma_points
    spread2 = set_.alpha**2 * (L + set_.kappa)
    steps = np.sqrt(spread2) * ordered_root(P, involved).T
    wm = np.full(2 * n + 1, 0.5 / spread2)
    wm[0] = 1.0 - n / spread2
    wc = wm.copy()
    wc[0] += 1.0 - set_.alpha**2 + set_.beta
    return np.concatenate([[x], x + steps, x - steps]), wm, wc


def ordered_root(P: Array, first: Array) -> Array:
    """Root C with C C' = P, lower triangular once the variables ``first`` are put first."""
    order = np.concatenate([first, np.setdiff1d(np.arange(len(P)), first)])
    root = np.empty_like(P)
    root[order] = square_root(P[np.ix_(order, order)])
    return root


def square_root(P: Array) -> Array:
    """Lower C with C C' = P for a positive semidefinite P; where a pivot vanishes so does its column.

    Raises
    ------
    numpy.linalg.LinAlgError
        P is indefinite or not finite.
    """
    A, C = P.copy(), np.zeros_like(P)
    scale = np.diag(P)
    for j in range(len(P)):
        if not A[j, j] >= -1e-12 * abs(scale[j]):
            raise np.linalg.LinAlgError("the state covariance is not positive semidefinite")
        if A[j, j] > 1e-12 * scale[j]:
            C[j:, j] = A[j:, j] / np.sqrt(A[j, j])
            A[j:, j:] -= np.outer(C[j:, j], C[j:, j])
    return C


def _block_diagonal(blocks: Array) -> Array:
    out = np.zeros((3 * len(blocks), 3 * len(blocks)))
    for i, block in enumerate(blocks):
        out[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = block
    return out
