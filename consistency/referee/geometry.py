"""Angles and rigid motions: what "error" means between two poses, and the groups SE(2) and SE(3).

The NEES is e' P^-1 e, so it is right only if P is the covariance of this very e: same group, same side, same
order of components. The sign of e does not matter to it.

Filters of the bench and files of other estimators are judged by the errors that are defined here.

d is 2 or 3, and n the dimension of the group, 3 or 6; a twist has its translation first.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

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
SMALL = 1e-6  # rad^2, below which a coefficient is that of no turn; the next term is below 1e-8 there


def wrap(angle: Array) -> Array:
    """Angle in radians brought to [-pi, pi), any shape; NaN where it is not finite."""
    with np.errstate(invalid="ignore"):
        return np.mod(np.asarray(angle) + np.pi, 2.0 * np.pi) - np.pi


def pose_error(truth: Array, estimate: Array) -> Array:
    """Truth minus estimate of planar poses, both (..., 3) -> (..., 3), m and rad, the heading wrapped to [-pi, pi)."""
    error: Array = np.asarray(truth, float) - np.asarray(estimate, float)
    error[..., 2] = wrap(error[..., 2])
    return error


def rotation(roll: float, pitch: float, heading: float) -> Array:
    """Rotation matrix (3, 3) of Rz(heading) Ry(pitch) Rx(roll), radians."""
    (cr, cp, ch), (sr, sp, sh) = (fn([roll, pitch, heading]) for fn in (np.cos, np.sin))
    return np.array(
        [
            [ch * cp, ch * sp * sr - sh * cr, ch * sp * cr + sh * sr],
            [sh * cp, sh * sp * sr + ch * cr, sh * sp * cr - ch * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


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

    T_true = T Exp(e_left), so that the position is off by R rho and the rotation by phi about the axes of the body.
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
    :func:`planar_error`. ``so3`` is the error of ROS messages
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
