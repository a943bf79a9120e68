"""SE(2) and SE(3) as matrices: motions, adjoints, and covariances carried from one error to another.

d is 2 or 3, and n the dimension of the group, 3 or 6; a twist has its translation first.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from consistency.referee.geometry.conventions import se2_log
from consistency.referee.geometry.space_errors import se3_log
from consistency.referee.types import Array


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
    return out


def carried(J: Array, P: Array) -> Array:
    """J P J', exactly symmetric, of (..., m, n) and (..., n, n)."""
    out = J @ P @ np.swapaxes(J, -1, -2)
    return np.asarray(0.5 * (out + np.swapaxes(out, -1, -2)))
