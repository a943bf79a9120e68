"""SE(2) and SE(3): motions as matrices, adjoints, covariances carried from one error to another, errors in space.

d is 2 or 3, and n the dimension of the group, 3 or 6; a twist has its translation first.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from consistency.referee.geometry import wrap
from consistency.referee.geometry.conventions import CHARTS, half_cotangent, se2_log
from consistency.referee.types import Array

SMALL = 1e-6  # rad^2, below which a coefficient is that of no turn; the next term is below 1e-8 there


def matrices(pose: Array) -> Array:
    """Homogeneous matrices (N, d + 1, d + 1) of poses x, y, heading (N, 3) or x, y, z, qx, qy, qz, qw (N, 7)."""
    pose = np.asarray(pose, float)
    d = 2 if pose.shape[1] == 3 else 3
    out = np.zeros((len(pose), d + 1, d + 1))
    if d == 2:
        c, s = np.cos(pose[:, 2]), np.sin(pose[:, 2])
        out[:, 0, 0], out[:, 0, 1], out[:, 1, 0], out[:, 1, 1] = c, -s, s, c
    elif len(pose):
        out[:, :3, :3] = Rotation.from_quat(pose[:, 3:]).as_matrix()
    out[:, :d, d], out[:, d, d] = pose[:, :d], 1.0
    return out


def vectors(T: Array) -> Array:
    """Poses (N, 3) or (N, 7) of homogeneous matrices, the inverse of :func:`matrices`."""
    if T.shape[-1] == 3:
        return np.column_stack([T[:, :2, 2], np.arctan2(T[:, 1, 0], T[:, 0, 0])])
    turn = Rotation.from_matrix(T[:, :3, :3]).as_quat() if len(T) else np.empty((0, 4))
    return np.column_stack([T[:, :3, 3], turn])


def inverse(T: Array) -> Array:
    """T^-1 of homogeneous matrices (..., d + 1, d + 1)."""
    d = T.shape[-1] - 1
    out = np.zeros_like(T)
    out[..., :d, :d] = np.swapaxes(T[..., :d, :d], -1, -2)
    out[..., :d, d] = -(out[..., :d, :d] @ T[..., :d, d, None])[..., 0]
    out[..., d, d] = 1.0
    return out


def composed(motions: Array) -> Array:
    """T_k = D_0 D_1 ... D_k of motions (N, d + 1, d + 1), each in the frame that the one before leads to."""
    out = np.empty_like(motions)
    T = np.eye(motions.shape[-1])
    for k, motion in enumerate(motions):
        T = T @ motion
        out[k] = T
    return out


def log(T: Array) -> Array:
    """Log of homogeneous matrices (N, d + 1, d + 1) -> twists (N, n), m and rad."""
    return (se2_log if T.shape[-1] == 3 else se3_log)(vectors(T))


def adjoint(T: Array) -> Array:
    """Ad of T (..., d + 1, d + 1) -> (..., n, n): T Exp(e) = Exp(Ad e) T; Solà et al. (2018) eq. 159 and 175."""
    d = T.shape[-1] - 1
    R, t = T[..., :d, :d], T[..., :d, d]
    if d == 2:
        out = np.array(T)
        out[..., 0, 2], out[..., 1, 2] = t[..., 1], -t[..., 0]
        return out
    out = np.zeros((*T.shape[:-2], 6, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = R
    out[..., :3, 3:] = np.cross(t[..., :, None], R, axisa=-2, axisb=-2, axisc=-2)
    return out


def to_left(T: Array, convention: str) -> Array:
    """J (N, n, n) with e_left = J e to first order, e the error of T (N, d + 1, d + 1) in a ``convention``.

    The conventions are those of :mod:`consistency.referee.geometry.conventions`. T_true = T Exp(e_left), so that the
    position is off by R rho and the rotation by phi about the axes of the body.
    """
    if convention == "right":
        return adjoint(inverse(T))
    d = T.shape[-1] - 1
    n = 3 if d == 2 else 6
    out: Array = np.broadcast_to(np.eye(n), (*T.shape[:-2], n, n)).copy()
    back = np.swapaxes(T[..., :d, :d], -1, -2)
    if convention != "left":
        out[..., :d, :d] = back
    if convention == "so3":
        out[..., d:, d:] = back
    elif convention == "euler":
        out[..., d:, d:] = _turn_by_angles(T[..., :d, :d])
    elif convention in CHARTS:
        out[..., d:, d:] = _turn_by_vector(T[..., :d, :d])
    return out


def from_left(T: Array, convention: str) -> Array:
    """J (N, n, n) with e = J e_left to first order, the inverse of :func:`to_left`."""
    if convention in CHARTS:
        return np.asarray(np.linalg.pinv(to_left(T, convention)))
    return to_left(inverse(T), convention)


def _turn_by_vector(R: Array) -> Array:
    """Turn about the body's axes with a small change of the rotation vector of R (..., 3, 3): its right Jacobian.

    Source: Solà et al. (2018), eq. 143.
    """
    vector = Rotation.from_matrix(R.reshape(-1, 3, 3)).as_rotvec().reshape(*R.shape[:-2], 3) if R.size else R[..., 0]
    squared = np.square(vector).sum(axis=-1)[..., None, None]
    angle = np.sqrt(squared)
    across = np.cross(np.eye(3), vector[..., None, :])
    once = 0.5 * np.square(np.sinc(0.5 * angle / np.pi))
    twice = np.where(squared > SMALL, (1.0 - np.sinc(angle / np.pi)) / np.maximum(squared, SMALL), 1.0 / 6.0)
    return np.asarray(np.eye(3) - once * across + twice * across @ across)


def _turn_by_angles(R: Array) -> Array:
    """Turn about the body's axes with a small change of roll, pitch and yaw of R (..., 3, 3)."""
    roll = np.arctan2(R[..., 2, 1], R[..., 2, 2])
    out = np.zeros_like(R)
    out[..., 0, 0] = 1.0
    out[..., 1, 1], out[..., 2, 1] = np.cos(roll), -np.sin(roll)
    out[..., 2] = R[..., 2, :]
    return out


def propagated(J: Array, P: Array) -> Array:
    """J P J', exactly symmetric, of (..., m, n) and (..., n, n)."""
    out = J @ P @ np.swapaxes(J, -1, -2)
    return np.asarray(0.5 * (out + np.swapaxes(out, -1, -2)))


def spatial_error(truth: Array, estimate: Array, convention: str) -> Array:
    """Error of poses (x, y, z, qx, qy, qz, qw), shape (..., 7) -> (..., 6): translation, then rotation.

    The quaternion turns body into world coordinates (Hamilton, scalar last). ``left`` and ``right`` as in
    :func:`consistency.referee.geometry.conventions.planar_error`. ``so3`` is the error of ROS messages
    (geometry_msgs/PoseWithCovariance: position, then rotations about fixed axes); ``so3-body`` is the local angular
    error of Solà (2017), "Quaternion kinematics for the error-state Kalman filter", beside the plain position.
    ``rvec`` and ``euler`` are differences of rotation vectors, and of roll, pitch, yaw.
    """
    truth, estimate = np.asarray(truth, float), np.asarray(estimate, float)
    shape = np.broadcast_shapes(truth.shape, estimate.shape)
    truth, estimate = (np.array(np.broadcast_to(pose, shape)).reshape(-1, 7) for pose in (truth, estimate))
    if not len(truth):  # older SciPy composes no empty rotations
        return np.empty((*shape[:-1], 6))
    true_turn, turn = Rotation.from_quat(truth[:, 3:]), Rotation.from_quat(estimate[:, 3:])
    shift = truth[:, :3] - estimate[:, :3]
    body = convention in ("left", "so3-body")
    delta = turn.inv() * true_turn if body else true_turn * turn.inv()
    if convention == "left":
        shift = turn.inv().apply(shift)
    elif convention == "right":
        shift = shift + estimate[:, :3] - delta.apply(estimate[:, :3])
    if convention in ("left", "right"):
        error = _twist(shift, delta)
    else:
        turned = delta.as_rotvec()
        if convention == "euler":
            turned = _angle_gap(true_turn, turn)
        elif convention in CHARTS:
            turned = _vector_gap(true_turn, turn)
        error = np.concatenate([shift, turned], axis=-1)
    return error.reshape(*shape[:-1], 6)


def state_error(truth: Array, estimate: Array, convention: str) -> Array:
    """Error of poses that a velocity follows, and two biases, (..., 7 + k) -> (..., 6 + k) with k of 0, 3 or 9.

    ``left`` and ``right`` are of SE2(3), where the velocity is treated as the position is, by the same rotation; biases
    are differences. ``additive`` is the difference of every number, of the rotation that of two rotation vectors.

    Source: Barrau & Bonnabel (2017), "The invariant extended Kalman filter as a stable observer", whose group of
    extended poses this is.
    """
    truth, estimate = np.asarray(truth, float), np.asarray(estimate, float)
    pose = spatial_error(truth[..., :7], estimate[..., :7], convention)
    rest = truth[..., 7:] - estimate[..., 7:]
    if convention in ("left", "right") and rest.shape[-1]:
        true, own = (np.concatenate([state[..., 7:10], state[..., 3:7]], axis=-1) for state in (truth, estimate))
        rest[..., :3] = spatial_error(true, own, convention)[..., :3]
    return np.concatenate([pose, rest], axis=-1)


def _vector_gap(truth: Rotation, estimate: Rotation) -> Array:
    """Difference of N rotation vectors, (N, 3), the true one of those that differ by whole turns."""
    own, true = estimate.as_rotvec(), truth.as_rotvec()
    angle = np.linalg.norm(true, axis=1, keepdims=True)
    axis = true / np.where(angle > 0.0, angle, 1.0)
    turns = np.rint(((own * axis).sum(axis=1, keepdims=True) - angle) / (2.0 * np.pi))
    return np.asarray(true + 2.0 * np.pi * turns * axis - own)


def _angle_gap(truth: Rotation, estimate: Rotation) -> Array:
    """Difference of N triples roll, pitch, yaw, (N, 3), the true one of the two that mean the same rotation."""
    own, true = estimate.as_euler("ZYX")[:, ::-1], truth.as_euler("ZYX")[:, ::-1]
    near = wrap(true - own)
    other = wrap(np.pi + true * [1.0, -1.0, 1.0] - own)
    nearer = np.square(other).sum(axis=1) < np.square(near).sum(axis=1)
    return np.where(nearer[:, None], other, near)


def se3_log(pose: Array) -> Array:
    """Log of poses (x, y, z, qx, qy, qz, qw), shape (..., 7) -> (..., 6), Solà et al. (2018) eq. 173."""
    pose = np.asarray(pose, float)
    flat = pose.reshape(-1, 7)
    if not len(flat):  # older SciPy has no vectors of empty rotations
        return np.empty((*pose.shape[:-1], 6))
    return _twist(flat[:, :3], Rotation.from_quat(flat[:, 3:])).reshape(*pose.shape[:-1], 6)


def _twist(shift: Array, turn: Rotation) -> Array:
    """Log of SE(3) of N motions: (N, 3) and N rotations -> (N, 6), translation first.

    V(w)^-1 t = t - w x t / 2 + (1 - (|w|/2) cot(|w|/2)) w x (w x t) / |w|^2.
    """
    vector = turn.as_rotvec()
    squared = np.square(vector).sum(axis=-1, keepdims=True)
    share = (1.0 - half_cotangent(np.sqrt(squared))) / np.where(squared > 0.0, squared, 1.0)
    across = np.cross(vector, shift)
    return np.concatenate([shift - 0.5 * across + share * np.cross(vector, across), vector], axis=-1)
