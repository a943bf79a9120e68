"""Errors of poses in space, as :mod:`consistency.referee.geometry.conventions` names them."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from consistency.referee.geometry.conventions import half_cotangent
from consistency.referee.types import Array


def spatial_error(truth: Array, estimate: Array, convention: str) -> Array:
    """Error of poses (x, y, z, qx, qy, qz, qw), shape (..., 7) -> (..., 6): translation, then rotation.

    The quaternion turns body into world coordinates (Hamilton, scalar last). ``left`` and ``right`` as in
    :func:`consistency.referee.geometry.conventions.planar_error`. ``so3`` is the error of ROS messages
    (geometry_msgs/PoseWithCovariance: position, then rotations about fixed axes); ``so3-body`` is the local angular
    error of Solà (2017), "Quaternion kinematics for the error-state Kalman filter", beside the plain position.
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
        error = np.concatenate([shift, delta.as_rotvec()], axis=-1)
    return error.reshape(*shape[:-1], 6)


def state_error(truth: Array, estimate: Array, convention: str) -> Array:
    """Error of poses that a velocity follows, and two biases, (..., 7 + k) -> (..., 6 + k) with k of 0, 3 or 9.

    ``left`` and ``right`` are of SE2(3), where the velocity is treated as the position is, by the same rotation; biases
    are differences. ``additive`` is the difference of every number, of the rotation that of two rotation vectors.

    Source: Barrau & Bonnabel (2017), "The invariant extended Kalman filter as a stable observer", whose group of
    extended poses this is.
    """
    truth, estimate = np.asarray(truth, float), np.asarray(estimate, float)
    pose = spatial_error(truth[..., :7], estimate[..., :7], "so3" if convention == "additive" else convention)
    if convention == "additive":
        pose[..., 3:] = _vector_gap(truth[..., 3:7], estimate[..., 3:7])
    rest = truth[..., 7:] - estimate[..., 7:]
    if convention in ("left", "right") and rest.shape[-1]:
        true, own = (np.concatenate([state[..., 7:10], state[..., 3:7]], axis=-1) for state in (truth, estimate))
        rest[..., :3] = spatial_error(true, own, convention)[..., :3]
    return np.concatenate([pose, rest], axis=-1)


def _vector_gap(truth: Array, estimate: Array) -> Array:
    """Difference of the rotation vectors of quaternions (..., 4), the true one of those that differ by whole turns."""
    shape = truth.shape
    if not truth.size:
        return np.empty((*shape[:-1], 3))
    own, true = (Rotation.from_quat(each.reshape(-1, 4)).as_rotvec() for each in (estimate, truth))
    angle = np.linalg.norm(true, axis=1, keepdims=True)
    axis = true / np.where(angle > 0.0, angle, 1.0)
    turns = np.rint(((own * axis).sum(axis=1, keepdims=True) - angle) / (2.0 * np.pi))
    return np.asarray(true + 2.0 * np.pi * turns * axis - own).reshape(*shape[:-1], 3)


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
