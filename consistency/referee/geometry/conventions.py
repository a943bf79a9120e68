"""What "error" means: the declared difference between a true and an estimated pose.

The NEES is e' P^-1 e, so it is right only if P is the covariance of this very e: same group, same side, same
order of components. The sign of e does not matter to it.

Filters of the bench and files of other estimators are judged by the errors that are defined here; those of poses in
space are in :mod:`consistency.referee.geometry.lie_groups`.
"""

from __future__ import annotations

import numpy as np

from consistency.referee.geometry import pose_error, wrap
from consistency.referee.types import Array

ADDITIVE = "so2"  # of the pose in the world: what ``P_*`` and ``nees`` in files are of
PLANAR = {
    "so2": "position difference in the world frame, heading difference wrapped",
    "left": "Log(estimate^-1 truth) of SE(2), in the frame of the estimated body",
    "right": "Log(truth estimate^-1) of SE(2), in the world frame",
    "vector": "plain difference, nothing wrapped",
}
SPATIAL = {
    "so3": "position difference in the world frame, rotation vector of R_truth R_estimate' about the world's axes",
    "so3-body": "position difference in the world frame, rotation vector of R_estimate' R_truth about the body's axes",
    "left": "Log(estimate^-1 truth) of SE(3), in the frame of the estimated body",
    "right": "Log(truth estimate^-1) of SE(3), in the world frame",
    "rvec": "position difference in the world frame, difference of two rotation vectors, the nearer way round",
    "euler": "position difference in the world frame, difference of roll, pitch, yaw, R = Rz(yaw) Ry(pitch) Rx(roll)",
}
INERTIAL = {
    **SPATIAL,
    "additive": "difference of every number, of the rotation that of two rotation vectors, the nearer way round",
}  # of poses with a velocity, and biases
CHARTS = ("rvec", "euler", "additive")  # rotations by differences of coordinates, which depend on the world's axes
SERIES = 1e-2  # rad, below which the half-angle cotangent is a series; the next term is below 1e-17 there


def planar_error(truth: Array, estimate: Array, convention: str) -> Array:
    """Error of planar poses (x, y, heading), both (..., 3) -> (..., 3), m and rad.

    ``left`` and ``right`` are the right- and left-minus of Solà, Deray & Atchuthan (2018), eq. 26 and 28, that is
    the invariant errors of Barrau & Bonnabel (2017), "The invariant extended Kalman filter as a stable observer",
    but for the sign: left-invariant (their X^-1 X^) is unchanged by a motion of the world, right-invariant
    (X^ X^-1) by a motion of the body frame.
    """
    truth, estimate = np.asarray(truth, float), np.asarray(estimate, float)
    if convention == "vector":
        return np.asarray(truth - estimate)
    error = pose_error(truth, estimate)
    if convention == "so2":
        return error
    # est^-1 truth = (R^' (p - p^), h - h^);  truth est^-1 = (p - R R^' p^, h - h^)
    shift = _shift(error[..., :2], estimate[..., :2], convention, error[..., 2], estimate[..., 2])
    return se2_log(np.concatenate([shift, error[..., 2:]], axis=-1))


def _shift(gap: Array, point: Array, convention: str, turn: Array, heading: Array) -> Array:
    """Translation of a point (..., 2) that is off by ``gap``, by the pose whose heading is off by ``turn`` (...)."""
    if convention == "left":
        return _turn(gap, -heading)
    return gap + point - _turn(point, turn)


def planar_map_error(
    true_pose: Array, true_points: Array, pose: Array, points: Array, covariance: Array, convention: str
) -> tuple[Array, Array]:
    """Joint error of a pose (3,) and K points (K, 3) in the world, m and rad, with its covariance.

    ``left`` and ``right`` are those of SE_2(2) in x and y, the group of a pose and points (Barrau & Bonnabel 2015, "An
    EKF-SLAM algorithm with consistency properties"): each point moves as the position does. Heights are additive.

    Parameters
    ----------
    covariance : (3 + 3 K, 3 + 3 K), of the additive errors

    Returns
    -------
    (3 + 3 K,) error, pose first, and (3 + 3 K, 3 + 3 K) its covariance, carried over to first order
    """
    gap, error = np.asarray(true_points - points, float), planar_error(true_pose, pose, convention)
    if convention in ("so2", "vector"):
        return np.append(error, gap), np.array(covariance, float)
    turn = error[2]
    shift = _shift(gap[:, :2], points[:, :2], convention, turn, pose[2])
    moved = se2_log(np.column_stack([shift, np.full(len(points), turn)]))[:, :2]
    if convention == "left":
        P = _turned(_turned(covariance, pose[2]).T, pose[2]).T
    else:
        P = _sheared(_sheared(covariance, pose, points).T, pose, points).T
    return np.append(error, np.column_stack([moved, gap[:, 2]])), P


def _turned(matrix: Array, angle: float) -> Array:
    """x and y of pose and points, in the rows of (3 + 3 K, n), about axes turned by ``angle``."""
    c, s = np.cos(angle), np.sin(angle)
    out = np.array(matrix, float, order="C").reshape(-1, 3, matrix.shape[1])
    out[:, :2] = np.array([[c, s], [-s, c]]) @ out[:, :2]
    return out.reshape(matrix.shape)


def _sheared(matrix: Array, pose: Array, points: Array) -> Array:
    """Rows (3 + 3 K, n) of errors in x and y with what the error of the heading, row 2, adds to each."""
    T = np.eye(3)
    T[:2, 2] = pose[1], -pose[0]
    out = np.array(matrix, float, order="C")
    out[3::3] += points[:, 1:2] * out[2]
    out[4::3] -= points[:, :1] * out[2]
    out[:3] = T @ out[:3]
    return out


def se2_log(pose: Array) -> Array:
    """Log of planar poses (x, y, heading), shape (..., 3), Solà et al. (2018) eq. 157 and 158.

    V(h)^-1 = [[a, h/2], [-h/2, a]] with a = (h/2) cot(h/2).
    """
    x, y, heading = np.moveaxis(np.asarray(pose, float), -1, 0)
    heading = wrap(heading)
    a, half = half_cotangent(heading), 0.5 * heading
    return np.stack([a * x + half * y, a * y - half * x, heading], axis=-1)


def half_cotangent(angle: Array) -> Array:
    """(angle/2) cot(angle/2), 1 at zero; angles within [-pi, pi]."""
    small = np.abs(angle) < SERIES
    half = 0.5 * np.where(small, 1.0, angle)
    squared = np.square(angle)
    series = 1.0 - squared / 12.0 - squared**2 / 720.0 - squared**3 / 30240.0
    return np.where(small, series, half / np.tan(half))


def _turn(vector: Array, angle: Array) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    x, y = vector[..., 0], vector[..., 1]
    return np.stack([c * x - s * y, s * x + c * y], axis=-1)
