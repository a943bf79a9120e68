"""State and steps that the methods have in common: SLAM after Herath, Kodagoda & Dissanayake (2007) eq. 1-13.

Nothing is shared with the kernels but the models. Each method is a class made of the functions here; those whose state
is a ``SlamState`` are variations of ``ExtendedKalman``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from consistency.bench.filters.filter_inputs import sensor_noise
from consistency.bench.protocols import Problem
from consistency.bench.scenario import PLANAR_SENSORS, Belief, BelievedSensor, models
from consistency.bench.types import Control, Gaussian, Info, Observation
from consistency.referee.errors import InputError
from consistency.referee.types import Array, Indices


class PointSensor:
    """Eq. 19 (``xyz``) or eq. 22 (``uvd``) from a mounted sensor."""

    size = width = 3  # numbers of an observation, and of a landmark

    def __init__(self, sensor: BelievedSensor, uvd: bool) -> None:
        self.f, self.B, self.uvd = sensor.f or 0.0, sensor.B or 0.0, uvd
        self.mount = sensor.mount.packed()
        self.turn = np.reshape(self.mount[3:], (3, 3))  # sensor axes in the robot frame

    def measure(self, pose: Array, landmark: Array) -> Array:
        """h: observations (..., 3) of landmarks (..., 3), m, from poses (..., 3)."""
        body = models.to_robot(*np.moveaxis(pose, -1, 0), *np.moveaxis(landmark, -1, 0))
        x, y, z = models.to_sensor(*body, self.mount)
        return np.stack(models.project(x, y, z, self.f, self.B) if self.uvd else (x, y, z), axis=-1)

    def jacobians(self, pose: Array, landmark: Array) -> tuple[Array, Array]:
        """Derivatives of h by the pose (3,) and by the landmark (3,), each (3, 3)."""
        body = models.to_robot(*pose, *landmark)
        c = models.to_sensor(*body, self.mount)
        J = np.reshape(models.project_jacobian(*c, self.f, self.B), (3, 3)) if self.uvd else np.eye(3)
        world_to_robot = heading_matrix(pose[2]).T
        d_body = np.column_stack([-world_to_robot[:, 0], -world_to_robot[:, 1], [body[1], -body[0], 0.0]])
        return J @ self.turn.T @ d_body, J @ self.turn.T @ world_to_robot

    def locate(self, pose: Array, z: Array) -> tuple[Array, Array, Array]:
        """Landmark (3,) in m from one observation z (3,) at ``pose`` (3,), with its Jacobians (3, 3) by pose and z."""
        c, J = z, np.eye(3)
        if self.uvd:
            u, v, d = z
            c = np.array(models.triangulate(u, v, d, self.f, self.B))
            J = np.reshape(models.triangulate_jacobian(u, v, d, self.f, self.B), (3, 3))
        body = models.from_sensor(c[0], c[1], c[2], self.mount)
        robot_to_world = heading_matrix(pose[2])
        d_heading = robot_to_world @ [-body[1], body[0], 0.0]
        d_pose = np.column_stack([[1.0, 0, 0], [0, 1.0, 0], d_heading])
        return np.array(models.to_world(pose[0], pose[1], pose[2], *body)), d_pose, robot_to_world @ self.turn @ J

    def less(self, z: Array, about: Array) -> Array:
        return np.asarray(z - about)


class PlanarSensor:
    """Relative position or range and bearing of landmarks in the plane, from a mounted sensor."""

    size = width = 2

    def __init__(self, sensor: BelievedSensor) -> None:
        self.space, self.bearing = PointSensor(sensor, uvd=False), sensor.model == "range-bearing"

    def measure(self, pose: Array, landmark: Array) -> Array:
        """h: observations (..., 2) of landmarks (..., 2), m, from poses (..., 3)."""
        x, y, _ = np.moveaxis(self.space.measure(pose, at_height_zero(landmark)), -1, 0)
        return np.stack(models.range_bearing(x, y) if self.bearing else (x, y), axis=-1)

    def jacobians(self, pose: Array, landmark: Array) -> tuple[Array, Array]:
        """Derivatives of h by the pose (3,) and by the landmark (2,), (2, 3) and (2, 2)."""
        here = at_height_zero(landmark)
        x, y, _ = self.space.measure(pose, here)
        J = np.reshape(models.range_bearing_jacobian(x, y), (2, 2)) if self.bearing else np.eye(2)
        Hp, Hl = self.space.jacobians(pose, here)
        return J @ Hp[:2], J @ Hl[:2, :2]

    def locate(self, pose: Array, z: Array) -> tuple[Array, Array, Array]:
        """Landmark (2,) in m from one observation z (2,) at ``pose`` (3,), with Jacobians (2, 3), (2, 2) by both."""
        c, J = z, np.eye(2)
        if self.bearing:
            c = np.array(models.at_range_bearing(z[0], z[1]))
            J = np.reshape(models.at_range_bearing_jacobian(z[0], z[1]), (2, 2))
        landmark, Jp, Jz = self.space.locate(pose, at_height_zero(c))
        return landmark[:2], Jp[:2], Jz[:2, :2] @ J

    def less(self, z: Array, about: Array) -> Array:
        """z (..., 2) less another observation (..., 2), a bearing by the shorter way round."""
        difference: Array = z - about
        if self.bearing:
            difference[..., 1] -= 2.0 * np.pi * np.rint(difference[..., 1] / (2.0 * np.pi))
        return difference


def mounted(sensor: BelievedSensor) -> tuple[Array, Array]:
    """Position (3,) of a sensor in the frame of the robot, m, and its axes (3, 3) as columns."""
    mount = np.array(sensor.mount.packed())
    return mount[:3], mount[3:].reshape(3, 3)


def view(sensor: BelievedSensor, uvd: bool) -> PointSensor | PlanarSensor:
    """What a filter takes the sensor to measure: raw (u, v, d) where ``uvd``, else what its model says, or points."""
    return PlanarSensor(sensor) if sensor.model in PLANAR_SENSORS else PointSensor(sensor, uvd)


def at_height_zero(point: Array) -> Array:
    """Points (..., 3) of points in the plane (..., 2)."""
    return np.concatenate([point, np.zeros_like(point[..., :1])], axis=-1)


def heading_matrix(heading: float) -> Array:
    """Rotation (3, 3) from the robot frame to the world."""
    c, s = np.cos(heading), np.sin(heading)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])


@dataclass(frozen=True)
class SlamState:
    """Robot, then landmarks in the order in which they were first seen."""

    x: Array  # (n,)
    P: Array  # (n, n), covariance of the error in which the filter is written
    landmarks: tuple[int, ...]
    problem: Problem
    width: int = 3  # variables of a landmark
    points: Any = None  # what a method keeps of the points at which its Jacobians are taken

    def at(self, landmark: int) -> int:
        """Offset of a landmark in x."""
        return 3 + self.width * self.landmarks.index(landmark)

    def beside(self, landmark: int) -> Indices:
        """Places in x of all but a landmark."""
        return np.delete(np.arange(len(self.x)), self.at(landmark) + np.arange(self.width))

    @property
    def positions(self) -> Indices:
        """Places in x of x and y of the robot and of each landmark, (1 + m, 2)."""
        first = np.array([0, *range(3, len(self.x), self.width)])
        return np.column_stack([first, first + 1])


def start(problem: Problem, width: int | None = None) -> SlamState:
    """The state before step 1: the robot alone, known exactly; landmarks of ``width``, or as the sensor sees them."""
    own = view(problem.belief.sensor, uvd=False).width
    return SlamState(problem.start.copy(), np.zeros((3, 3)), (), problem, width or own)


def pose_after(pose: Array, control: Control) -> Array:
    """Pose (3,) after a step, eq. 18."""
    return np.array(models.unicycle(pose[0], pose[1], pose[2], control.dt, control.v, control.omega))


def motion_jacobians(pose: Array, control: Control) -> tuple[Array, Array]:
    """F (3, 3) of eq. 18 with respect to the pose and G (3, 2) with respect to (v, omega)."""
    c, s, dt = np.cos(pose[2]), np.sin(pose[2]), control.dt
    F = np.array([[1, 0, -dt * control.v * s], [0, 1, dt * control.v * c], [0, 0, 1]])
    G = np.array([[dt * c, 0], [dt * s, 0], [0, dt]])
    return F, G


def quarter_turn(v: Array) -> Array:
    """J v of a vector (2,) in the plane: by how much a small turn moves its tip."""
    return np.array([-v[1], v[0]])


def process_noise(G: Array, belief: Belief) -> Array:
    """G Q G' with Q = diag(sigma_v^2, sigma_omega^2), shape (3, 3)."""
    Q = np.diag(np.square([belief.motion.sigma_v, belief.motion.sigma_omega]))
    return np.asarray(G @ Q @ G.T)


def predict_by(state: SlamState, control: Control, displacement: Array, at: Array) -> SlamState:
    """Eq. 9 and 10 with F of another ``displacement`` (2,) of the robot, in m, and G at the pose ``at`` (3,)."""
    x, F = state.x.copy(), np.eye(len(state.x))
    _, G = motion_jacobians(at, control)
    x[:3] = pose_after(x[:3], control)
    F[:2, 2] = quarter_turn(displacement)
    P = F @ state.P @ F.T
    P[:3, :3] += process_noise(G, state.problem.belief)
    return replace(state, x=x, P=P)


# The update with landmarks already in the state: their labels, z (m, s), R (m, s, s)
Correct = Callable[[SlamState, list[int], Array, Array], tuple[SlamState, Info]]
Locate = Callable[[SlamState, int, Array], tuple[Array, Array, Array]]


def update_jointly(
    state: SlamState, observation: Observation, uvd: bool, correct: Correct, locate: Locate
) -> tuple[SlamState, Info]:
    """One update with all landmarks in the state, then the new ones; raw (u, v, d) where ``uvd``, else eq. 21.

    ``locate`` gives a new landmark (w,) and its Jacobians with respect to the robot's error (w, 3) and z (w, s).
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
    """The state with a new landmark (w,), its Jacobians by pose (w, 3) and z (w, s), and full cross-covariance."""
    landmark, Jp, Jz = placed
    n, w = len(state.x), len(landmark)
    J = np.zeros((n + w, n))
    J[:n] = np.eye(n)
    J[n:, :3] = Jp
    P = J @ state.P @ J.T
    P[n:, n:] += Jz @ R @ Jz.T
    return replace(state, x=np.append(state.x, landmark), P=P, landmarks=(*state.landmarks, label))


def without(state: SlamState, landmark: int) -> SlamState:
    """The state without a landmark: what it says of all else stays as it is."""
    keep = state.beside(landmark)
    rest = tuple(label for label in state.landmarks if label != landmark)
    return replace(state, x=state.x[keep], P=state.P[np.ix_(keep, keep)], landmarks=rest)


def expect(state: SlamState, seen: list[int], uvd: bool) -> tuple[Array, Array]:
    """h (s m,) and its Jacobian H (s m, n) at the state, landmarks as points in the world."""
    sensor = view(state.problem.belief.sensor, uvd)
    s, w = sensor.size, sensor.width
    zhat, H = np.zeros(s * len(seen)), np.zeros((s * len(seen), len(state.x)))
    for i, label in enumerate(seen):
        rows, at = slice(s * i, s * i + s), slice(state.at(label), state.at(label) + w)
        zhat[rows] = sensor.measure(state.x[:3], state.x[at])
        H[rows, :3], H[rows, at] = sensor.jacobians(state.x[:3], state.x[at])
    return zhat, H


def innovation_of(state: SlamState, z: Array, zhat: Array, uvd: bool) -> Array:
    """z (m, s) less what is expected (s m,), as one vector (s m,)."""
    return view(state.problem.belief.sensor, uvd).less(z, zhat.reshape(z.shape)).ravel()


def corrected(state: SlamState, H: Array, innovation: Array, R: Array) -> tuple[SlamState, Info]:
    """Eq. 11 to 13: the update by an innovation (s m,) with H (s m, n) and the noise R (m, s, s)."""
    S, W = gain(state.P, H, block_diag(*R))
    return replace(state, x=state.x + W @ innovation, P=state.P - W @ S @ W.T), Info(innovation, S, W)


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
    return corrected(state, H, innovation_of(state, z, zhat, uvd), R)


def locate_point(state: SlamState, z: Array, uvd: bool) -> tuple[Array, Array, Array]:
    """A landmark (w,) as a point in the world, m, seen from the estimated pose; Jacobians by pose (w, 3), z (w, s)."""
    return view(state.problem.belief.sensor, uvd).locate(state.x[:3], z)


def pose_of(state: SlamState) -> Gaussian:
    """Pose (3,) and covariance (3, 3) of a state whose error is additive."""
    return Gaussian(state.x[:3], state.P[:3, :3])


def map_of_state(state: SlamState) -> dict[int, Gaussian]:
    """Landmarks (3,) by label, m, with covariance (3, 3), of a state of world points whose error is additive."""
    w = state.width
    blocks = {label: slice(state.at(label), state.at(label) + w) for label in state.landmarks}
    up = (0, 3 - w)  # the height of one in the plane is known to be zero
    return {label: Gaussian(np.pad(state.x[at], up), np.pad(state.P[at, at], up)) for label, at in blocks.items()}


def joint_of(state: SlamState) -> Gaussian:
    """Robot and landmarks together, (3 + 3 K,) and its covariance, of a state whose error is additive."""
    count = (len(state.x) - 3) // state.width
    spatial = np.eye(3)[:, : state.width]  # one in the plane is known to be at height zero
    T = block_diag(np.eye(3), *[spatial] * count)
    return Gaussian(T @ state.x, T @ state.P @ T.T)


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
