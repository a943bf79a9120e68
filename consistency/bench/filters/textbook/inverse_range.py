"""Geometry and conversion of a robot-centred map of inverse ranges, in plain NumPy.

The methods and their sources are in :mod:`consistency.bench.filters.textbook.robocentric`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag
from scipy.special import log_ndtr
from scipy.stats import norm

from consistency.bench.filters.filter_inputs import disparity_sigma
from consistency.bench.filters.textbook.basics import heading_matrix, mounted
from consistency.bench.scenario.sensor import BelievedSensor
from consistency.referee.errors import InputError
from consistency.referee.types import Array

BESIDE = 0.1  # cosine of the angle to the optical axis below which a prediction is in no image
FLAT = 1e-9  # determinant of a covariance of positions over its squared trace, up to which they are on a line
BEYOND = 4.0  # standard deviations outside the search range at which a predicted disparity is held


class Corrections(NamedTuple):
    """What tells this filter from a plain robot-centred one; each can be left out, to see what it is worth."""

    parking: bool = True
    turning: bool = True  # the motion between clones has the errors that a return leaves it, in its own frame
    truncation: bool = True
    debiasing: bool = True
    prediction: bool = True  # noise of what is observed taken where it is predicted, not where it was measured
    iteration: bool = True
    waiting: bool = (
        True  # a return in doubt stays parked until the turn is known, and is left out if it does not settle
    )
    recency: bool = True  # an update about a moved robot leaves the errors from before its last motion as they are
    curvature: bool = True  # mean of a landmark that moves, to second order in the noise of turn and drive
    promptness: bool = True  # landmarks are parked soon
    spread: bool = True  # and its covariance, to second order in these and in the error of rho times the drive
    own_spread: bool = True  # and in all of its own errors
    patience: bool = True  # nothing is parked at a pose whose last motions are not yet corrected by a sight
    moments: bool = True  # the covariance of the pose is that of Exp(xi) T, not of a linear error
    adrift: bool = True  # a return is in doubt, too, where the robot's own heading is little known
    tempering: bool = True  # the noise of a return begins at what is not known of it
    forgetting: bool = True  # a landmark that the robot drives through is forgotten


# --- geometry ----------------------------------------------------------------------------------------


def unit_vectors(y: Array) -> tuple[Array, Array]:
    """Unit vectors (..., 3) of azimuth and elevation, and their derivatives (..., 3, 2)."""
    (sa, se), (ca, ce) = np.sin(y[..., :2]).T, np.cos(y[..., :2]).T
    sa, se, ca, ce = sa.T, se.T, ca.T, ce.T
    m = np.stack([ce * ca, ce * sa, se], axis=-1)
    by_azimuth = np.stack([-ce * sa, ce * ca, np.zeros_like(ca)], axis=-1)
    by_elevation = np.stack([-se * ca, -se * sa, ce], axis=-1)
    return m, np.stack([by_azimuth, by_elevation], axis=-1)


def bent_unit_vectors(y: Array) -> Array:
    """Second derivatives (m, 2, 2, 3) of the unit vectors of azimuth and elevation."""
    m, dm = unit_vectors(y)
    flat = m * [1.0, 1.0, 0.0]
    mixed = np.stack([-dm[:, 1, 1], dm[:, 0, 1], np.zeros(len(y))], axis=1)
    return np.stack([np.stack([-flat, mixed], axis=1), np.stack([mixed, -m], axis=1)], axis=1)


def in_new_frame(y: Array, R: Array, t: Array, sensor: BelievedSensor) -> tuple[Array, Array, Array, Array]:
    """Landmarks y (m, 3) in the frame of the sensor after a change b -> R b + t of the robot's frame.

    Returns
    -------
    y' (m, 3), dy'/dy (m, 3, 3), dy'/db' (m, 3, 3), and rho times the point in the new frame of the robot, b' (m, 3)
    """
    offset, axes = mounted(sensor)
    m, dm = unit_vectors(y)
    rho = y[:, 2:]
    b = (m @ axes.T + rho * offset) @ R.T + rho * t
    q = (b - rho * offset) @ axes
    by_range = np.broadcast_to((axes.T @ (R @ offset + t - offset))[:, None], (len(y), 3, 1))
    dq = np.concatenate([axes.T @ R @ axes @ dm, by_range], axis=2)
    h2, r2 = q[:, 0] ** 2 + q[:, 1] ** 2, (q**2).sum(axis=1)
    h, r = np.sqrt(h2), np.sqrt(r2)
    D = np.zeros((len(y), 3, 3))
    D[:, 0, 0], D[:, 0, 1] = -q[:, 1] / h2, q[:, 0] / h2
    D[:, 1, 0], D[:, 1, 1], D[:, 1, 2] = -q[:, 2] * q[:, 0] / (h * r2), -q[:, 2] * q[:, 1] / (h * r2), h / r2
    D[:, 2] = -(rho[:, 0] / (r * r2))[:, None] * q
    J = D @ dq
    J[:, 2, 2] += 1.0 / r
    there = np.stack([np.arctan2(q[:, 1], q[:, 0]), np.arctan2(q[:, 2], h), rho[:, 0] / r], axis=1)
    return there, J, D @ axes.T, b


def bent(q: Array, rho: Array, u: Array, w: Array, by_u: Array | float = 0.0, by_w: Array | float = 0.0) -> Array:
    """Second derivative (..., 3) of azimuth, elevation and rho / |q| along two directions.

    Parameters
    ----------
    q, rho : (..., 3), (...), where it is taken
    u, w : (..., 3), derivatives of q along the one and the other direction
    by_u, by_w : (...), those of rho
    """
    h2, r2 = (q[..., :2] ** 2).sum(axis=-1), (q**2).sum(axis=-1)
    h, r = np.sqrt(h2), np.sqrt(r2)

    def parts(v: Array) -> tuple[Array, Array, Array, Array]:
        flat = (q[..., :2] * v[..., :2]).sum(axis=-1)
        across, up = q[..., 0] * v[..., 1] - q[..., 1] * v[..., 0], h * v[..., 2] - q[..., 2] * flat / h
        return flat, flat + q[..., 2] * v[..., 2], across, up

    (flat_u, whole_u, across_u, up_u), (flat_w, whole_w, across_w, up_w) = parts(u), parts(w)
    level = (u[..., :2] * w[..., :2]).sum(axis=-1)
    azimuth = -(across_u * flat_w + across_w * flat_u) / h2**2
    elevation = -(up_u * whole_w + up_w * whole_u) / r2**2 - q[..., 2] * (level - flat_u * flat_w / h2) / (h * r2)
    by_range = rho * (3.0 * whole_u * whole_w / r2 - (u * w).sum(axis=-1)) - by_u * whole_w - by_w * whole_u
    return np.stack([azimuth, elevation, by_range / (r * r2)], axis=-1)


def second_derivatives(y: Array, R: Array, t: Array, sensor: BelievedSensor) -> Array:
    """Second derivatives (m, 5, 5, 3) of landmarks y (m, 3) after a change b -> R b + t of the robot's frame.

    They are those by a, e and rho of each, and by errors of the drive, m, and of the turn, rad. An error s of the turn
    takes b, rho times the point in the new frame of the robot, to Rz(-s) b, one of the drive to b - s rho R e_x.
    """
    offset, axes = mounted(sensor)
    (_, dm), rho, count = unit_vectors(y), y[:, 2], len(y)
    _, _, D, b = in_new_frame(y, R, t, sensor)

    def turned(v: Array) -> Array:
        return np.stack([v[..., 1], -v[..., 0], np.zeros(v.shape[:-1])], axis=-1)

    first, second, of_rho = np.zeros((count, 5, 3)), np.zeros((count, 5, 5, 3)), np.array([0.0, 0.0, 1.0, 0.0, 0.0])
    first[:, :2], first[:, 2] = np.swapaxes(dm, 1, 2) @ axes.T @ R.T, R @ offset + t
    first[:, 3], first[:, 4] = -rho[:, None] * R[:, 0], turned(b)
    second[:, :2, :2] = bent_unit_vectors(y) @ axes.T @ R.T
    second[:, 2, 3] = second[:, 3, 2] = -R[:, 0]
    second[:, :, 4] = second[:, 4, :] = turned(first)
    q, w = (b - rho[:, None] * offset) @ axes, (first - of_rho[:, None] * offset) @ axes
    along_both = bent(q[:, None, None], rho[:, None, None], w[:, :, None], w[:, None], of_rho[:, None], of_rho)
    return np.asarray(along_both + second @ np.swapaxes(D, 1, 2)[:, None])


def spread_by_pairs(second: Array, P: Array, sigmas: tuple[float, float]) -> Array:
    """Covariance (m, 3, 3) that errors of landmarks and the noise of a motion add to second order.

    It is 1/2 tr(G_i S G_j S) with the second derivatives G and the covariance S of all five errors, without the squares
    of drive and turn, which are errors of all landmarks together.

    Parameters
    ----------
    second : (m, 5, 5, 3), as of :func:`second_derivatives`
    P : (m, 3, 3), covariance of the landmarks before the motion
    sigmas : standard deviations of drive (m) and turn (rad)
    """
    G, S, noises = np.moveaxis(second, -1, 1).copy(), np.zeros((len(P), 5, 5)), [3, 4]
    G[:, :, noises, noises] = 0.0
    S[:, :3, :3], S[:, noises, noises] = P, np.square(sigmas)
    GS = G @ S[:, None]
    return np.asarray(0.5 * np.einsum("mikl,mjlk->mij", GS, GS))


def moved_pose(pose: Array, xi: Array) -> Array:
    """Exp(xi) T of a pose (3,), with xi = (x, y, angle) in SE(2)."""
    angle = xi[2]
    along = np.sinc(angle / np.pi)
    across = 0.5 * angle if abs(angle) < 1e-4 else (1.0 - np.cos(angle)) / angle
    V = np.array([[along, -across], [across, along]])
    return np.array([*(heading_matrix(angle)[:2, :2] @ pose[:2] + V @ xi[:2]), pose[2] + angle])


def pose_moments(C: Array) -> Array:
    """Second moments (3, 3) of Exp(xi) T about T, from the covariance C (3, 3) of the additive error to first order.

    With xi = M (d, t), Exp(xi) moves the position by V(t) d, d = k t + w, where w does not depend on the turn t, and
    V(t) t k = k sin t + J k (1 - cos t) with J the quarter turn. The second moments of sin t and 1 - cos t of a normal
    t are known in closed form; those of V are E[(sin t / t)^2] = exp(-s / 3) and E[((1 - cos t) / t)^2] =
    s / 4 exp(-s / 2), to first and second order in the variance s of t. Without full rank C is left as it is: the
    first step moves the robot along a line.
    """
    s = C[2, 2]
    k = C[:2, 2] / s if s > 0.0 else np.zeros(2)
    J = np.array([[0.0, -1.0], [1.0, 0.0]])
    A, across = C[:2, :2] - s * np.outer(k, k), J @ k
    if np.linalg.det(A) <= FLAT * np.trace(A) ** 2:
        return C
    sine, cosine = -0.5 * np.expm1(-2.0 * s), 0.5 * np.expm1(-s) ** 2 + np.expm1(-0.5 * s) ** 2  # of sin t, 1 - cos t
    out = C.copy()
    out[:2, :2] = sine * np.outer(k, k) + cosine * np.outer(across, across)
    out[:2, :2] += np.exp(-s / 3.0) * A + 0.25 * s * np.exp(-0.5 * s) * J @ A @ J.T
    out[:2, 2] = out[2, :2] = np.exp(-0.5 * s) * C[:2, 2]
    return out


def shift_matrix(pose: Array) -> Array:
    """M (3, 3) with xi = M (dp, dheading)."""
    return np.array([[1.0, 0.0, pose[1]], [0.0, 1.0, -pose[0]], [0.0, 0.0, 1.0]])


def pose_jacobian(xi: Array) -> Array:
    """J_l of SE(2) to second order, (3, 3)."""
    ad = np.array([[0.0, -xi[2], xi[1]], [xi[2], 0.0, -xi[0]], [0.0, 0.0, 0.0]])
    return np.asarray(np.eye(3) + ad / 2.0 + ad @ ad / 6.0)


def poses_moved(poses: Array, xi: Array, recency: bool = False) -> tuple[Array, Array]:
    """Poses (k, 3) moved by errors (k, 3), each Exp(xi) T; d error about the moved ones / d xi, (3 k, 3 k).

    With ``recency`` the last pose is moved by the noise of its last motion, whose errors come after all older ones:
    T_true = Exp(xi) Exp(nu) T, so that T moved by nu has the error xi, not J_l(nu) xi.
    """
    J = np.array([pose_jacobian(x) for x in xi])
    if recency:
        J[-1] = np.eye(3)
    return np.array([moved_pose(pose, x) for pose, x in zip(poses, xi, strict=True)]), block_diag(*J)


def chained(poses: Array, xi: Array, on: int) -> tuple[Array, Array]:
    """The same for poses in the order of time, where xi are the sums of the errors of the motion from each to the next.

    Pose j is E_j T_j with E_j = E_j-1 Exp(xi_j - xi_j-1): the motion between two poses depends on its own error alone,
    whatever the errors before it are. With B = Ad(E_j-1) J_l(xi_j - xi_j-1), row j of the Jacobian is row j - 1 plus B
    times the difference of xi_j and xi_j-1. In place of the one before it, the last pose hangs on pose ``on``.
    """
    E, rows, out = np.zeros((len(xi), 3)), np.zeros((len(xi), 3, xi.size)), np.zeros(poses.shape)
    for j, pose in enumerate(poses):
        before, last, step = np.zeros(3), -1, xi[j]
        if j > 0:
            last = on if j == len(xi) - 1 else j - 1
            before, step, rows[j] = E[last], xi[j] - xi[last], rows[last]
        M = shift_matrix(before) @ heading_matrix(before[2])  # Ad
        B = M @ pose_jacobian(step)
        rows[j, :, 3 * j : 3 * j + 3] += B
        if j > 0:
            rows[j, :, 3 * last : 3 * last + 3] -= B
        E[j] = moved_pose(before, M @ step)
        out[j] = [*(E[j, :2] + heading_matrix(E[j, 2])[:2, :2] @ pose[:2]), E[j, 2] + pose[2]]
    return out, rows.reshape(xi.size, xi.size)


# --- conversion --------------------------------------------------------------------------------------


def converted(z: Array, sensor: BelievedSensor) -> tuple[Array, Array]:
    """(u, v, d) (m, 3) in px to azimuth, elevation and inverse range (m, 3), and the Jacobians (m, 3, 3)."""
    f, B = sensor.f or 0.0, sensor.B or 0.0
    u, v, d = z.T
    a = np.arctan2(-u, f)
    sa, ca = np.sin(a), np.cos(a)
    e = np.arctan2(-v * ca, f)
    se, ce = np.sin(e), np.cos(e)
    J = np.zeros((len(z), 3, 3))
    J[:, 0, 0] = a_u = -f / (f**2 + u**2)
    J[:, 1, 0] = e_u = ce**2 * v * sa * a_u / f
    J[:, 1, 1] = e_v = -(ce**2) * ca / f
    J[:, 2, 0] = -d / (f * B) * (se * ca * e_u + ce * sa * a_u)
    J[:, 2, 1] = -d / (f * B) * se * ca * e_v
    J[:, 2, 2] = ce * ca / (f * B)
    return np.stack([a, e, d * ce * ca / (f * B)], axis=1), J


def imaged(y: Array, sensor: BelievedSensor) -> Array:
    """Inverse of :func:`converted`; NaN for what is in no image."""
    f, B = sensor.f or 0.0, sensor.B or 0.0
    ca, ce = np.cos(y[:, 0]), np.cos(y[:, 1])
    z = np.stack([-f * np.tan(y[:, 0]), -f * np.tan(y[:, 1]) / ca, y[:, 2] * f * B / (ce * ca)], axis=1)
    return np.where(((ca > BESIDE) & (ce > BESIDE))[:, None], z, np.nan)


def conversion_bias(z: Array, sensor: BelievedSensor) -> Array:
    """Mean of the conversion less the conversion of the mean, (m, 3), by three points in u and in v."""
    b = np.zeros(z.shape)
    for axis in range(2):
        step = np.zeros(3)
        step[axis] = np.sqrt(3.0) * sensor.sigma[axis]
        b += (converted(z + step, sensor)[0] + converted(z - step, sensor)[0] - 2.0 * converted(z, sensor)[0]) / 6.0
    return b


def untruncated_disparity(
    d: Array, expected: Array, sigma: Array | float, searched: tuple[Array | float, Array | float]
) -> tuple[Array, Array]:
    """What d would be without the search range, and its variance: moments of the truncated normal about ``expected``.

    d* = e + (d - e - sigma lambda) / kappa with variance sigma^2 / kappa, where sigma lambda and sigma^2 kappa are
    mean and variance of d - e given that d is in the range.
    """
    low, high = searched
    e = np.clip(expected, low - BEYOND * sigma, high + BEYOND * sigma)
    alpha, beta = (low - e) / sigma, (high - e) / sigma
    mass = np.exp(log_ndtr(beta)) - np.exp(log_ndtr(alpha))
    at_low, at_high = norm.pdf(alpha), norm.pdf(beta)
    shift = (at_low - at_high) / mass
    kappa = 1.0 + (alpha * at_low - beta * at_high) / mass - shift**2
    return e + (d - e - sigma * shift) / kappa, sigma**2 / kappa


def searched(sensor: BelievedSensor, name: str) -> tuple[float, float]:
    """Least and greatest disparity that the filter is told of, px.

    Raises
    ------
    InputError
        It is told of none.
    """
    if sensor.disparity is None:
        raise InputError(
            f"filter '{name}' needs key 'belief.sensor.disparity_px', the least and greatest disparity that are "
            "reported; add it, as in truth.sensor"
        )
    return sensor.disparity


def observed(
    z: Array, shift: Array, expected: Array, sensor: BelievedSensor, which: Corrections
) -> tuple[Array, Array]:
    """Observations (m, 3) as inverse range where ``expected`` (m, 3) is predicted, and their noise (m, 3, 3).

    ``shift`` (m,) are the biases in px that were subtracted from their disparities.
    """
    at = imaged(expected, sensor)
    at = np.where(np.isnan(at), z, at)
    sigma = disparity_sigma((at if which.prediction else z)[:, 2], sensor)
    z, variance = z.copy(), np.tile(np.square(sensor.sigma), (len(z), 1))
    variance[:, 2] = np.square(sigma)
    if which.truncation:
        low, high = searched(sensor, "robot-centred")
        z[:, 2], variance[:, 2] = untruncated_disparity(z[:, 2], at[:, 2], sigma, (low - shift, high - shift))
    y, J = converted(z, sensor)[0], converted(at if which.prediction else z, sensor)[1]
    if which.debiasing:
        y -= conversion_bias(z, sensor)
    return y, (J * variance[:, None]) @ np.swapaxes(J, 1, 2)
