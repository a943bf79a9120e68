"""What the plain twins have in common: SLAM as a textbook writes it, dense and in NumPy, for reading and as oracle.

Herath, Kodagoda & Dissanayake (2007) eq. 1-13. Nothing is shared with the kernels but the models. Each twin is a
class of its own in ``methods``, made of the functions here; those on world points with an additive error share
:class:`WorldPointTwin`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

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
    P: Array  # (n, n), covariance of the error in which the filter is written
    landmarks: tuple[int, ...]
    problem: Problem
    width: int = 3  # variables of a landmark

    def at(self, landmark: int) -> int:
        """Offset of a landmark in x."""
        return 3 + self.width * self.landmarks.index(landmark)


def start(problem: Problem, width: int = 3) -> SlamState:
    """The state before step 1: the robot alone, known exactly."""
    return SlamState(problem.start.copy(), np.zeros((3, 3)), (), problem, width)


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
        """Pose (3,) after a step."""
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
        self.turn = np.reshape(self.mount[3:], (3, 3))  # sensor axes in the robot frame

    def measure(self, pose: Array, landmark: Array) -> Array:
        """h: observations (..., 3) of landmarks (..., 3), m, from poses (..., 3)."""
        body = point.to_robot(*np.moveaxis(pose, -1, 0), *np.moveaxis(landmark, -1, 0))
        x, y, z = point.to_sensor(*body, self.mount)
        return np.stack(stereo.project(x, y, z, self.f, self.B) if self.uvd else (x, y, z), axis=-1)

    def jacobians(self, pose: Array, landmark: Array) -> tuple[Array, Array]:
        """Derivatives of h by the pose (3,) and by the landmark (3,), each (3, 3)."""
        body = point.to_robot(*pose, *landmark)
        c = point.to_sensor(*body, self.mount)
        J = np.reshape(stereo.project_jacobian(*c, self.f, self.B), (3, 3)) if self.uvd else np.eye(3)
        world_to_robot = heading_matrix(pose[2]).T
        d_body = np.column_stack([-world_to_robot[:, 0], -world_to_robot[:, 1], [body[1], -body[0], 0.0]])
        return J @ self.turn.T @ d_body, J @ self.turn.T @ world_to_robot

    def locate(self, pose: Array, z: Array) -> tuple[Array, Array, Array]:
        """Landmark (3,) in m from one observation z (3,) at ``pose`` (3,), with its Jacobians (3, 3) by pose and z."""
        c, J = z, np.eye(3)
        if self.uvd:
            u, v, d = z
            c = np.array(stereo.triangulate(u, v, d, self.f, self.B))
            J = np.reshape(stereo.triangulate_jacobian(u, v, d, self.f, self.B), (3, 3))
        body = point.from_sensor(c[0], c[1], c[2], self.mount)
        robot_to_world = heading_matrix(pose[2])
        d_heading = robot_to_world @ [-body[1], body[0], 0.0]
        d_pose = np.column_stack([[1.0, 0, 0], [0, 1.0, 0], d_heading])
        return np.array(point.to_world(pose[0], pose[1], pose[2], *body)), d_pose, robot_to_world @ self.turn @ J


def heading_matrix(heading: float) -> Array:
    """Rotation (3, 3) from the robot frame to the world."""
    c, s = np.cos(heading), np.sin(heading)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])


def quarter_turn(v: Array) -> Array:
    """J v of a vector (2,) in the plane: by how much a small turn moves its tip."""
    return np.array([-v[1], v[0]])


def process_noise(G: Array, belief: Belief) -> Array:
    """G Q G' with Q = diag(sigma_v^2, sigma_omega^2), shape (3, 3)."""
    Q = np.diag(np.square([belief.motion.sigma_v, belief.motion.sigma_omega]))
    return np.asarray(G @ Q @ G.T)


def predict_extended(state: SlamState, control: Control) -> SlamState:
    """Eq. 9 and 10 with Jacobians at the estimate: the mean moves by f, P <- F P F' + G Q G'."""
    robot, x, F = Unicycle(), state.x.copy(), np.eye(len(state.x))
    F[:3, :3], G = robot.jacobians(x[:3], control)
    x[:3] = robot.move(x[:3], control)
    P = F @ state.P @ F.T
    P[:3, :3] += process_noise(G, state.problem.belief)
    return replace(state, x=x, P=P)


def predict_by(state: SlamState, control: Control, displacement: Array, at: Array) -> SlamState:
    """Eq. 9 and 10 with F of another ``displacement`` (2,) of the robot, in m, and G at the pose ``at`` (3,)."""
    robot, x, F = Unicycle(), state.x.copy(), np.eye(len(state.x))
    _, G = robot.jacobians(at, control)
    x[:3] = robot.move(x[:3], control)
    F[:2, 2] = quarter_turn(displacement)
    P = F @ state.P @ F.T
    P[:3, :3] += process_noise(G, state.problem.belief)
    return replace(state, x=x, P=P)


class Correct(Protocol):
    """The update with landmarks already in the state: their labels, z (m, 3), R (m, 3, 3)."""

    def __call__(self, state: SlamState, seen: list[int], z: Array, R: Array, /) -> tuple[SlamState, Info]: ...


Locate = Callable[[SlamState, int, Array], tuple[Array, Array, Array]]


def update_jointly(
    state: SlamState, observation: Observation, uvd: bool, correct: Correct, locate: Locate
) -> tuple[SlamState, Info]:
    """One update with all landmarks in the state, then the new ones; raw (u, v, d) where ``uvd``, else eq. 21.

    ``locate`` gives a new landmark (w,) and its Jacobians with respect to the robot's error (w, 3) and z (w, 3).
    """
    sensor = state.problem.belief.sensor
    z, R = sensor_noise(observation.z, sensor, converted=sensor.model == "uvd" and not uvd)
    is_known = np.array([int(label) in state.landmarks for label in observation.landmarks], dtype=bool)
    seen = [int(label) for label in observation.landmarks[is_known]]
    info = Info(np.zeros(0), np.zeros((0, 0)), np.zeros((len(state.x), 0)))
    if seen:
        state, info = correct(state, seen, z[is_known], R[is_known])
    for i in np.flatnonzero(~is_known):
        label = int(observation.landmarks[i])
        state = augment(state, label, locate(state, label, z[i]), R[i])
    return state, info


def augment(state: SlamState, label: int, placed: tuple[Array, Array, Array], R: Array) -> SlamState:
    """The state with a new landmark (w,), its Jacobians (w, 3) by pose and z, and full cross-covariance; R (3, 3)."""
    landmark, Jp, Jz = placed
    n, w = len(state.x), len(landmark)
    J = np.zeros((n + w, n))
    J[:n] = np.eye(n)
    J[n:, :3] = Jp
    P = J @ state.P @ J.T
    P[n:, n:] += Jz @ R @ Jz.T
    return replace(state, x=np.append(state.x, landmark), P=P, landmarks=(*state.landmarks, label))


def expect(state: SlamState, seen: list[int], uvd: bool) -> tuple[Array, Array]:
    """h (3 m,) and its Jacobian H (3 m, n) at the state, landmarks as points in the world."""
    sensor = PointSensor(state.problem.belief.sensor, uvd)
    zhat, H = np.zeros(3 * len(seen)), np.zeros((3 * len(seen), len(state.x)))
    for i, label in enumerate(seen):
        rows, at = slice(3 * i, 3 * i + 3), slice(state.at(label), state.at(label) + 3)
        zhat[rows] = sensor.measure(state.x[:3], state.x[at])
        H[rows, :3], H[rows, at] = sensor.jacobians(state.x[:3], state.x[at])
    return zhat, H


def gain(P: Array, H: Array, R: Array) -> tuple[Array, Array]:
    """S = H P H' + R (k, k) and the gain P H' S^-1 (n, k), eq. 11 and 12; P (n, n), H (k, n)."""
    S = H @ P @ H.T + R
    return S, np.linalg.solve(S, H @ P).T


def correct_about(
    state: SlamState, at: Array, seen: list[int], z: Array, R: Array, uvd: bool
) -> tuple[SlamState, Info]:
    """The update of an EKF whose H is that of other values ``at`` (n,) than its estimate."""
    zhat, _ = expect(state, seen, uvd)
    _, H = expect(replace(state, x=at), seen, uvd)
    innovation = z.ravel() - zhat
    S, W = gain(state.P, H, block_diagonal(R))
    return replace(state, x=state.x + W @ innovation, P=state.P - W @ S @ W.T), Info(innovation, S, W)


def locate_point(state: SlamState, z: Array, uvd: bool) -> tuple[Array, Array, Array]:
    """A landmark (3,) as a point in the world, m, by eq. 21 from the estimated pose; Jacobians (3, 3) by pose and z."""
    return PointSensor(state.problem.belief.sensor, uvd).locate(state.x[:3], z)


def pose_of(state: SlamState) -> Gaussian:
    """Pose (3,) and covariance (3, 3) of a state whose error is additive."""
    return Gaussian(state.x[:3], state.P[:3, :3])


def map_of(state: SlamState) -> dict[int, Gaussian]:
    """Landmarks (3,) by label, m, with covariance (3, 3), of a state of world points whose error is additive."""
    blocks = {label: slice(state.at(label), state.at(label) + 3) for label in state.landmarks}
    return {label: Gaussian(state.x[at], state.P[at, at]) for label, at in blocks.items()}


def joint_of(state: SlamState) -> Gaussian:
    """Robot and landmarks together, (n,) and (n, n), of a state whose error is additive."""
    return Gaussian(state.x, state.P)


class Noting(Protocol):
    """A state of world points with notes beside it."""

    @property
    def slam(self) -> SlamState: ...


class NotingTwin:
    """What a twin says of a state that is a ``SlamState`` with notes beside it."""

    def __init__(self, name: str, uvd: bool) -> None:
        self.name, self.uvd = name, uvd

    def pose(self, state: Noting) -> Gaussian:
        return pose_of(state.slam)

    def map(self, state: Noting) -> dict[int, Gaussian]:
        return map_of(state.slam)

    def joint(self, state: Noting) -> Gaussian:
        return joint_of(state.slam)


class WorldPointTwin(ABC):
    """SLAM on points in the world with an additive error; a twin adds how it predicts and how it corrects."""

    def __init__(self, name: str, uvd: bool) -> None:
        self.name, self.uvd = name, uvd

    def init(self, problem: Problem) -> SlamState:
        return start(problem)

    @abstractmethod
    def predict(self, state: SlamState, control: Control) -> SlamState: ...

    def update(self, state: SlamState, observation: Observation) -> tuple[SlamState, Info]:
        return update_jointly(state, observation, self.uvd, self._correct, self._locate)

    @abstractmethod
    def _correct(self, state: SlamState, seen: list[int], z: Array, R: Array) -> tuple[SlamState, Info]: ...

    def _locate(self, state: SlamState, label: int, z: Array) -> tuple[Array, Array, Array]:
        return locate_point(state, z, self.uvd)

    def pose(self, state: SlamState) -> Gaussian:
        return pose_of(state)

    def map(self, state: SlamState) -> dict[int, Gaussian]:
        return map_of(state)

    def joint(self, state: SlamState) -> Gaussian:
        return joint_of(state)


def require_landmarks(problem: Problem, name: str) -> Array:
    """Landmarks (N, 3) about which a linear world is expanded.

    Raises
    ------
    InputError
        There are none.
    """
    if problem.landmarks is None:
        raise InputError(f"filter '{name}' needs the landmarks that its world is linearised about")
    return problem.landmarks


def block_diagonal(blocks: Array) -> Array:
    """(m, 3, 3) -> (3 m, 3 m)."""
    out = np.zeros((3 * len(blocks), 3 * len(blocks)))
    for i, block in enumerate(blocks):
        out[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = block
    return out
