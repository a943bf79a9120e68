"""Maximum-likelihood relative poses of two frames, of points with covariances or of pixels.

Their first-order covariances are those of Valencia & Andrade-Cetto (2018) sec. 2.3.

Both minimise half the sum of rho(s), with s the squared standardised residual of a point in both frames at its best
position. rho is s, or Huber's (1964) or Cauchy's (Lorentzian) robust loss: rho'(s) is the weight that a point keeps,
rho''(s) what an exact second derivative needs. Both covariances come from :func:`implicit_covariance` of that cost,
with exact second derivatives.

Frame 1 measured z1 of R q + t, frame 2 measured z2 of q. With e the measured minus the predicted value and W the
inverse of its covariance, a point's cost is f = (e1' W1 e1 + e2' W2 e2) / 2. Points are independent given the pose, so
that each q is eliminated from the second derivatives by itself (Schur complement).

A minimum y of a cost C(x, y) is a function of x without a formula; its Jacobian still has one, by the implicit function
theorem: d y / d x = -C_yy^-1 C_yx (eq. 2.23).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Literal, NamedTuple

import numpy as np
from scipy import stats

from consistency.referee.errors import InputError
from consistency.referee.geometry import propagated
from consistency.referee.types import Array
from consistency.stereo.visual_odometry import arrays
from consistency.stereo.visual_odometry.arrays import ConvergenceError, DegenerateError
from consistency.stereo.visual_odometry.relative_pose import (
    RelativePose,
    checked_clouds,
    register_svd,
    rotation_derivatives,
)
from consistency.stereo.visual_odometry.rig import StereoRig, triangulate

Robust = Literal["huber", "cauchy"]
TAIL = 0.05  # share of points without fault that Huber's loss treats as outliers
STEPS = 100  # of Levenberg and Marquardt, at most; ten do for honest matches
DECREMENT = 1e-12  # twice the predicted decrease of the cost in the last step: 1e-6 standard deviations
NEAR = 1.0  # the same from which on second derivatives are taken in: one standard deviation
SLACK = 1e-12  # relative rounding of the cost
AT_MINIMUM = 1e-3  # standard deviations that a pose may be away from the minimum that the theorem speaks of


@cache
def threshold(dof: int) -> float:
    """Standardised residual c, of ``dof`` dimensions, that a point without fault exceeds with probability 0.05."""
    return np.sqrt(stats.chi2.isf(TAIL, dof))


def loss(robust: Robust | None, s: Array, c: float) -> tuple[Array, Array, Array]:
    """rho, rho' and rho'' at s (N,), all (N,); None is least squares.

    Raises
    ------
    InputError
        No such loss.
    """
    if robust is None:
        return s, np.ones_like(s), np.zeros_like(s)
    if robust == "huber":
        far = np.maximum(s, c**2)
        weight = c / np.sqrt(far)
        rho = np.minimum(s, c**2) + 2.0 * c * (np.sqrt(far) - c)
        return rho, weight, np.where(s > c**2, -0.5 * weight / far, 0.0)
    if robust == "cauchy":
        weight = 1.0 / (1.0 + s / c**2)
        rho = c**2 * np.log1p(s / c**2)
        return rho, weight, -(weight**2) / c**2
    raise InputError(f"robust: {robust!r}, allowed are 'huber', 'cauchy' and None")


@dataclass(frozen=True, eq=False)
class Refined:
    """A relative pose of highest likelihood.

    With a robust loss ``covariance`` is that of the robust estimator under the stated noise: a far point enters with
    its reduced influence, and that it may be an outlier, of which the stated noise knows nothing, is left out.
    """

    pose: RelativePose  # p1 = R p2 + t
    covariance: Array  # (6, 6), of x, y, z (m), roll, pitch, yaw (rad)
    weights: Array  # (N,), rho'(s): 1 is an inlier, 0 a point without influence
    points: Array  # (N, 3), in frame 1, m
    residuals: Array  # (N,), s: squared standardised residual of a point
    dof: int  # of the sum of s for honest noise without robust loss

    @property
    def chi2(self) -> float:
        """Sum of s, chi-square distributed with ``dof`` degrees of freedom where the noise is as stated."""
        return float(self.residuals.sum())


def register_weighted(
    p1: Array,
    p2: Array,
    S1: Array,
    S2: Array,
    pose: RelativePose | None = None,
    *,
    robust: Robust | None = None,
) -> Refined:
    """Minimum of the sum of e' (S1 + R S2 R')^-1 e with e = p1 - (R p2 + t).

    That is the likelihood of points in both frames whose true positions are unknown, and the weighting of eq. 2.4 that
    Valencia & Andrade-Cetto (2018) sec. 2.2 leave out as too complicated; Matthies & Shafer (1987) have it.

    Covariances of triangulated points are worked out at the noisy points: those that err towards the camera seem surer,
    and the pose is biased where the disparity's noise is some per cent of it. :func:`refine_reprojection` is not.

    Parameters
    ----------
    p1, p2 : (N, 3), m
    S1, S2 : (3, 3) or (N, 3, 3), positive definite, m^2
    pose : where to start; :func:`register_svd` unless given
    robust : None, "huber" or "cauchy", with the 95 % quantile of an honest residual as its constant

    Raises
    ------
    InputError, DegenerateError
        As :func:`register_svd`; S1 or S2 not positive definite; no such loss.
    GimbalLockError
        A pitch of +-90 degrees.
    ConvergenceError
        No minimum was reached.
    """
    p1, p2 = checked_clouds(p1, p2)
    S1 = arrays.covariances("S1", S1, len(p1), 3)
    S2 = arrays.covariances("S2", S2, len(p1), 3)
    frames = TwoFrames(PointMatches(), p1, p2, _weights("S1", S1), _weights("S2", S2), robust)
    return _refined(frames, S1, S2, pose or register_svd(p1, p2), p2)


def refine_reprojection(
    rig: StereoRig,
    uv1: Array,
    uv2: Array,
    pose: RelativePose,
    S_uv: Array,
    S_uv2: Array | None = None,
    *,
    robust: Robust | None = None,
) -> Refined:
    """Pose and points whose projections into all four images fit best: bundle adjustment of two stereo frames.

    For Gaussian pixel noise this is the maximum of the likelihood (Hartley & Zisserman 2004 sec. 18.1). Where the
    points of one frame are taken as known, the pose is biased by their triangulation; here they are estimated too.

    Parameters
    ----------
    uv1, uv2 : (N, 4), u, v, u', v' of the same points in frame 1 and 2, px
    pose : where to start, p1 = R p2 + t
    S_uv : (4, 4) or (N, 4, 4), positive definite, px^2; of frame 1, and of frame 2 unless S_uv2 is given
    S_uv2 : the same of frame 2
    robust : None, "huber" or "cauchy", with the 95 % quantile of an honest residual as its constant

    Raises
    ------
    PointError
        As :func:`triangulate`, for either frame; or a point that ``pose`` puts behind a camera.
    InputError, DegenerateError, GimbalLockError, ConvergenceError
        As :func:`register_weighted`.
    """
    uv1 = arrays.checked_rows("uv1", uv1, 4)
    uv2 = arrays.checked_rows("uv2", uv2, 4)
    arrays.same_length("uv1, uv2", uv1, uv2)
    S1 = arrays.covariances("S_uv", S_uv, len(uv1), 4)
    S2 = S1
    if S_uv2 is not None:
        S2 = arrays.covariances("S_uv2", S_uv2, len(uv1), 4)
    _, q = checked_clouds(triangulate(rig, uv1), triangulate(rig, uv2))
    rig.project(pose.apply(q))
    frames = TwoFrames(PixelMatches(rig), uv1, uv2, _weights("S_uv", S1), _weights("S_uv2", S2), robust)
    return _refined(frames, S1, S2, pose, q)


def _weights(name: str, S: Array) -> Array:
    """Inverse covariances; those given once for all rows are inverted once."""
    once = S
    if S.strides[0] == 0:
        once = S[:1]
    try:
        root = np.linalg.inv(np.linalg.cholesky(once))
    except np.linalg.LinAlgError:
        raise InputError(f"{name}: not positive definite; every direction needs some noise to be weighted by") from None
    return np.broadcast_to(np.swapaxes(root, 1, 2) @ root, S.shape)


def _refined(
    frames: TwoFrames,
    S1: Array,
    S2: Array,
    pose: RelativePose,
    q: Array,
) -> Refined:
    pose, q = _minimum(frames, pose, q)
    s = frames.squared(pose, q)
    _, weight, bend = frames.losses(s)
    C_dd, C_dz = _profile(cost_derivatives(frames, pose, q, exact=True), weight, bend)
    S = implicit_covariance(C_dd, C_dz, np.concatenate([S1, S2]))
    return Refined(pose, S, weight, pose.apply(q), s, frames.free * len(q) - 6)


def _profile(f: Derivatives, weight: Array, bend: Array) -> tuple[Array, Array]:
    """C_dd (6, 6) and C_dz (2N, 6, k) of the cost of the pose alone, each point at its best position."""
    inverse, definite = arrays.symmetric_inverses(f.qq)
    if not definite.all():
        k = int(np.argmin(definite))
        raise DegenerateError(f"match {k}: its point is not fixed by the images; leave it out", k)
    gain = f.dq @ inverse  # (N, 6, 3)
    dd = f.dd - gain @ np.swapaxes(f.dq, 1, 2)
    w = weight[:, None, None]
    bent = 2.0 * bend[:, None, None] * f.d[:, :, None]  # (N, 6, 1)
    C_dd = (w * dd + bent @ f.d[:, None]).sum(axis=0)
    C_dz1 = w * (f.dz1 - gain @ f.qz1) + bent @ f.z1[:, None]
    C_dz2 = w * (-gain @ f.qz2) + bent @ f.z2[:, None]
    return C_dd, np.concatenate([C_dz1, C_dz2])


def _minimum(
    frames: TwoFrames,
    pose: RelativePose,
    q: Array,
) -> tuple[RelativePose, Array]:
    """Levenberg and Marquardt on pose and points, and Newton's steps near the minimum."""
    damping = 0.0
    newton = False
    rho, weight, bend = frames.losses(frames.squared(pose, q))
    for _ in range(STEPS):
        f = cost_derivatives(frames, pose, q, exact=newton)
        while True:
            step, step_q, decrement = _step(f, weight, bend * newton, damping)
            if newton and not decrement >= 0.0:
                newton = False
                f = cost_derivatives(frames, pose, q, exact=False)
                continue
            there = RelativePose.from_vector(pose.vector + step)
            q_there = q + step_q
            if decrement < DECREMENT and damping < 1.0:
                return there, q_there
            losses = frames.losses(frames.squared(there, q_there))
            if losses[0].sum() <= rho.sum() * (1.0 + SLACK):
                break
            damping = max(10.0 * damping, 1e-4)
            if damping > 1e12:
                raise ConvergenceError("pose: no step lowers the cost; start nearer, or take the outliers out first")
        pose = there
        q = q_there
        rho, weight, bend = losses
        newton = decrement < NEAR
        if damping > 1e-8:
            damping *= 0.1
        else:
            damping = 0.0
    raise ConvergenceError(f"pose: no minimum in {STEPS} steps; start nearer, or take the outliers out first")


def _step(
    f: Derivatives,
    weight: Array,
    bend: Array,
    damping: float,
) -> tuple[Array, Array, float]:
    """Step of the pose (6,) and of the points (N, 3), and twice the decrease that it predicts; NaN: not downhill."""
    dd = f.dd
    qq = f.qq
    if damping:
        dd = dd * (1.0 + damping * np.eye(6))
        qq = qq * (1.0 + damping * np.eye(3))
    inverse, definite = arrays.symmetric_inverses(qq)
    gain = f.dq @ inverse
    g = f.d - np.einsum("nij,nj->ni", gain, f.q)
    H = np.tensordot(weight, dd - gain @ np.swapaxes(f.dq, 1, 2), 1)
    H += 2.0 * (g.T * bend) @ g
    try:
        np.linalg.cholesky(H)
        step = -np.linalg.solve(H, weight @ g)
    except np.linalg.LinAlgError:
        return np.zeros(6), np.zeros(f.q.shape), np.nan
    step_q = -np.einsum("nij,nj->ni", inverse, f.q + step @ f.dq)
    if not definite.all():
        return step, step_q, np.nan
    slope = step @ (weight @ f.d) + weight @ (step_q * f.q).sum(axis=1)
    return step, step_q, -slope


class TwoFrames(NamedTuple):
    """Measurements of the same points in two frames, and the robust loss of their residuals."""

    measure: PointMatches | PixelMatches
    z1: Array  # (N, k)
    z2: Array  # (N, k)
    W1: Array  # (N, k, k), inverse covariance
    W2: Array  # (N, k, k)
    robust: Robust | None = None

    @property
    def free(self) -> int:
        """Dimensions of a point's residual, its position eliminated."""
        return 2 * self.z1.shape[1] - 3

    def losses(self, s: Array) -> tuple[Array, Array, Array]:
        """rho, rho' and rho'' at the squared residuals s (N,), all (N,)."""
        return loss(self.robust, s, threshold(self.free))

    def squared(self, pose: RelativePose, q: Array) -> Array:
        """2 f of each point, (N,), infinite where a point is not in front of the cameras."""
        e1 = self.z1 - self.measure.value(pose.apply(q))
        e2 = self.z2 - self.measure.value(q)
        with np.errstate(invalid="ignore"):
            s = np.einsum("ni,nij,nj->n", e1, self.W1, e1)
            s += np.einsum("ni,nij,nj->n", e2, self.W2, e2)
        return np.where(np.isnan(s), np.inf, s)


class Derivatives(NamedTuple):
    """Of f of each point by the pose d = (x, y, z, roll, pitch, yaw), by q and by z1 and z2."""

    d: Array  # (N, 6)
    q: Array  # (N, 3)
    z1: Array  # (N, k)
    z2: Array  # (N, k)
    dd: Array  # (N, 6, 6)
    dq: Array  # (N, 6, 3)
    qq: Array  # (N, 3, 3)
    dz1: Array  # (N, 6, k); by d and z2 it is zero
    qz1: Array  # (N, 3, k)
    qz2: Array  # (N, 3, k)


def cost_derivatives(
    frames: TwoFrames,
    pose: RelativePose,
    q: Array,
    exact: bool,
) -> Derivatives:
    """First and second derivatives of f in closed form at ``q`` (N, 3), the points in frame 2.

    Without ``exact`` they are Gauss-Newton's, which leave out second derivatives of the measurement. With a = R q + t
    and A = d a / d d = [I, R_k q], f_d = A' f_a and f_q = R' f_a + (the term of frame 2).
    """
    R = pose.R
    R_k, R_kl = rotation_derivatives(pose)
    f_a, f_aa, f_az, f_z1 = _frame(frames.measure, frames.z1, frames.W1, pose.apply(q), exact)
    f_b, f_bb, f_bz, f_z2 = _frame(frames.measure, frames.z2, frames.W2, q, exact)
    At = np.zeros((len(q), 6, 3))
    At[:, :3] = np.eye(3)
    At[:, 3:] = np.einsum("kij,nj->nki", R_k, q)
    AtH = At @ f_aa
    dd = AtH @ np.swapaxes(At, 1, 2)
    dq = AtH @ R
    if exact:
        outer = f_a[:, :, None] * q[:, None]
        dd[:, 3:, 3:] += np.tensordot(outer, R_kl, ((1, 2), (2, 3)))
        dq[:, 3:] += np.einsum("kij,ni->nkj", R_k, f_a)
    return Derivatives(
        d=np.einsum("nij,nj->ni", At, f_a),
        q=f_a @ R + f_b,
        z1=f_z1,
        z2=f_z2,
        dd=dd,
        dq=dq,
        qq=R.T @ f_aa @ R + f_bb,
        dz1=At @ f_az,
        qz1=R.T @ f_az,
        qz2=f_bz,
    )


def _frame(
    measure: PointMatches | PixelMatches,
    z: Array,
    W: Array,
    p: Array,
    exact: bool,
) -> tuple[Array, Array, Array, Array]:
    """f_p, f_pp, f_pz and f_z of e' W e / 2 in one frame."""
    J = measure.jacobian(p)
    JtW = np.swapaxes(J, 1, 2) @ W
    We = np.einsum("nij,nj->ni", W, z - measure.value(p))
    f_p = -np.einsum("nij,ni->nj", J, We)
    f_pp = JtW @ J
    if exact:
        f_pp = f_pp - measure.second(p, J, We)
    return f_p, f_pp, -JtW, We


class PointMatches:
    """The measurement of a point is the point: k is 3."""

    def value(self, p: Array) -> Array:
        """The point itself, (N, 3)."""
        return p

    def jacobian(self, p: Array) -> Array:
        """Identity, (N, 3, 3)."""
        return np.broadcast_to(np.eye(3), (len(p), 3, 3))

    def second(
        self,
        p: Array,
        J: Array,
        w: Array,
    ) -> Array:
        """Zero, (N, 3, 3)."""
        return np.zeros((len(p), 3, 3))


class PixelMatches:
    """The measurement of a point is u, v, u', v' of eq. 2.1 and 2.2; NaN at or behind a camera.

    With u = a / w, a and w linear in p: u_p = (a_p - u w_p) / w and u_pp = -(u_p w_p' + w_p u_p') / w.
    """

    def __init__(self, rig: StereoRig) -> None:
        P = rig.cameras
        self.top = P[:, :2].reshape(4, 4)
        self.last = P[:, 2].repeat(2, axis=0)

    def value(self, p: Array) -> Array:
        """u, v, u', v' of points (N, 3), (N, 4), px."""
        return (p @ self.top[:, :3].T + self.top[:, 3]) / self._depth(p)

    def jacobian(self, p: Array) -> Array:
        """Derivative of :meth:`value` by the point, (N, 4, 3), px/m."""
        from_depth = self.value(p)[:, :, None] * self.last[:, :3]
        return (self.top[:, :3] - from_depth) / self._depth(p)[:, :, None]

    def second(self, p: Array, J: Array, w: Array) -> Array:
        """Second derivatives of the four pixels, weighted with w (N, 4) and summed, (N, 3, 3); J is (N, 4, 3)."""
        half = np.einsum("nij,ni,ik->njk", J, w / self._depth(p), self.last[:, :3])
        return -(half + np.swapaxes(half, 1, 2))

    def _depth(self, p: Array) -> Array:
        w = p @ self.last[:, :3].T + self.last[:, 3]
        return np.where(w > 0.0, w, np.nan)


def implicit_covariance(C_yy: Array, C_yx: Array, S_x: Array) -> Array:
    """Covariance of y = argmin C(x, y), eq. 2.22-2.24, where x is made of B independent blocks.

    Parameters
    ----------
    C_yy : (..., m, m), second derivative of the cost at its minimum
    C_yx : (..., B, m, k), mixed derivatives with each block of x
    S_x : (..., B, k, k), covariance of each block

    Returns
    -------
    (..., m, m), the sum over blocks of J S_x J' with J = -C_yy^-1 C_yx

    Raises
    ------
    DegenerateError
        C_yy is not positive definite: x does not fix y.
    """
    inverse, definite = arrays.symmetric_inverses(C_yy)
    if not definite.all():
        raise DegenerateError("the cost has no minimum here: its second derivative is not positive definite")
    S = _wide(C_yx @ S_x) @ np.swapaxes(_wide(C_yx), -1, -2)
    return propagated(inverse, S)


def _wide(blocks: Array) -> Array:
    """(..., B, m, k) -> (..., m, B k)."""
    *batch, B, m, k = blocks.shape
    return np.swapaxes(blocks, -3, -2).reshape(*batch, m, B * k)


def triangulation_covariance(rig: StereoRig, uv: Array, S_uv: Array) -> Array:
    """Covariance of :func:`triangulate`, eq. 2.24 and 2.27, with the exact derivatives of eq. 2.25.

    Parameters
    ----------
    uv : (N, 4), u, v, u', v', px
    S_uv : (4, 4) or (N, 4, 4), px^2; eq. 2.24 has zeros between the images, which is not required

    Returns
    -------
    (N, 3, 3), m^2

    Raises
    ------
    PointError
        As :func:`triangulate`.
    InputError
        A shape, a value that is not finite, S_uv not symmetric positive semidefinite.
    """
    uv = arrays.checked_rows("uv", uv, 4)
    S_uv = arrays.covariances("S_uv", S_uv, len(uv), 4)
    A, b = rig.equations(uv)
    C_pp, C_pu = triangulation_derivatives(rig, np.moveaxis(A, -1, 0), b.T, triangulate(rig, uv))
    return implicit_covariance(C_pp, C_pu[:, None], S_uv[:, None])


def triangulation_derivatives(
    rig: StereoRig,
    A: Array,
    b: Array,
    points: Array,
) -> tuple[Array, Array]:
    """C_pp (N, 3, 3) and C_pu (N, 3, 4) of half of eq. 2.25.

    Row j of A p - b is (u_j P_3 - P_j) (p, 1), with P the rows of its camera: u_j stands in row j only, and its factor
    there is the depth P_3 (p, 1).
    """
    last = rig.cameras[:, 2].repeat(2, axis=0)  # (4, 4), P_3 of each row
    residual = np.einsum("nij,nj->ni", A, points) - b
    depth = points @ last[:, :3].T + last[:, 3]
    C_up = A * depth[:, :, None] + last[:, :3] * residual[:, :, None]
    C_pu = np.swapaxes(C_up, 1, 2)
    return np.swapaxes(A, 1, 2) @ A, C_pu


def registration_covariance(
    p1: Array,
    p2: Array,
    S1: Array,
    S2: Array,
    pose: RelativePose,
) -> Array:
    """Covariance of the minimum of eq. 2.28, eq. 2.29-2.31, with its exact derivatives.

    It holds for :func:`register_svd` and :func:`register_horn`, which both find that minimum.

    Parameters
    ----------
    p1, p2 : (N, 3), m
    S1, S2 : (3, 3) or (N, 3, 3), m^2; points are independent of each other
    pose : what the registration of the same points returned

    Returns
    -------
    (6, 6), of x, y, z (m), roll, pitch, yaw (rad)

    Raises
    ------
    InputError, DegenerateError
        As :func:`register_svd`; S1 or S2 not symmetric positive semidefinite.
    GimbalLockError
        A pitch of +-90 degrees.
    ConvergenceError
        ``pose`` is not the minimum for these points.
    """
    p1, p2 = checked_clouds(p1, p2)
    S1 = arrays.covariances("S1", S1, len(p1), 3)
    S2 = arrays.covariances("S2", S2, len(p1), 3)
    C_d, C_dd, C_dp = registration_derivatives(p1, p2, pose)
    S = implicit_covariance(C_dd, C_dp, np.concatenate([S1, S2]))
    step = np.linalg.solve(C_dd, C_d)
    spread = np.sqrt(np.diagonal(S))
    rounding = 1e-9 * (1.0 + np.abs(pose.vector))
    if (np.abs(step) > AT_MINIMUM * spread + rounding).any():
        raise ConvergenceError("pose: not the minimum of eq. 2.28 for p1 and p2; register these very points first")
    return S


def registration_derivatives(p1: Array, p2: Array, pose: RelativePose) -> tuple[Array, Array, Array]:
    """C_d (6,), C_dd (6, 6) and C_dp (2N, 6, 3), first of p1 then of p2, of half of eq. 2.28."""
    first, second = rotation_derivatives(pose)
    n = len(p1)
    residual = p1 - pose.apply(p2)
    turned = np.einsum("kij,nj->nki", first, p2)  # R_k p2
    flat = turned.transpose(1, 0, 2).reshape(3, -1)
    C_d = np.empty(6)
    C_d[:3] = -residual.sum(axis=0)
    C_d[3:] = -np.einsum("ni,nki->k", residual, turned)
    C_dd = np.empty((6, 6))
    C_dd[:3, :3] = n * np.eye(3)
    C_dd[3:, :3] = turned.sum(axis=0)
    C_dd[:3, 3:] = C_dd[3:, :3].T
    C_dd[3:, 3:] = flat @ flat.T - np.einsum("klij,ij->kl", second, residual.T @ p2)
    C_dp1 = np.empty((n, 6, 3))
    C_dp1[:, :3] = -np.eye(3)
    C_dp1[:, 3:] = -turned
    C_dp2 = np.empty((n, 6, 3))
    C_dp2[:, :3] = pose.R
    C_dp2[:, 3:] = turned @ pose.R - np.einsum("kij,ni->nkj", first, residual)
    return C_d, C_dd, np.concatenate([C_dp1, C_dp2])
