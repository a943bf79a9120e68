"""Maximum-likelihood relative poses: of points with covariances, and of pixels.

Both minimise half the sum of rho(s), with s the squared standardised residual of a point in both frames at its best
position. rho is s, or Huber's (1964) or Cauchy's (Lorentzian) robust loss: rho'(s) is the weight that a point keeps,
rho''(s) what an exact second derivative needs. Both covariances come from :func:`implicit_covariance` of that cost,
with exact second derivatives.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy import stats

from consistency.referee.errors import InputError
from consistency.referee.types import Array
from consistency.stereo.visual_odometry.cameras import arrays
from consistency.stereo.visual_odometry.cameras.input_errors import ConvergenceError, DegenerateError
from consistency.stereo.visual_odometry.cameras.rig import StereoRig, triangulate
from consistency.stereo.visual_odometry.covariance_propagation import implicit_covariance
from consistency.stereo.visual_odometry.registration import checked_clouds, register_svd
from consistency.stereo.visual_odometry.relative_pose import RelativePose
from consistency.stereo.visual_odometry.two_frame_cost import (
    Derivatives,
    PixelMatches,
    PointMatches,
    TwoFrames,
    cost_derivatives,
)

Robust = Literal["huber", "cauchy"]
TAIL = 0.05  # share of points without fault that Huber's loss treats as outliers
STEPS = 100  # of Levenberg and Marquardt, at most; ten do for honest matches
DECREMENT = 1e-12  # twice the predicted decrease of the cost in the last step: 1e-6 standard deviations
NEAR = 1.0  # the same from which on second derivatives are taken in: one standard deviation
SLACK = 1e-12  # relative rounding of the cost


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
    frames = TwoFrames(PointMatches(), p1, p2, _weights("S1", S1), _weights("S2", S2))
    return _refined(frames, S1, S2, pose or register_svd(p1, p2), p2, robust)


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
    frames = TwoFrames(PixelMatches(rig), uv1, uv2, _weights("S_uv", S1), _weights("S_uv2", S2))
    return _refined(frames, S1, S2, pose, q, robust)


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
    robust: Robust | None,
) -> Refined:
    free = 2 * frames.z1.shape[1] - 3  # of a point's residual, its position eliminated
    c = threshold(free)
    pose, q = _minimum(frames, pose, q, robust, c)
    s = frames.squared(pose, q)
    _, weight, bend = loss(robust, s, c)
    C_dd, C_dz = _profile(cost_derivatives(frames, pose, q, exact=True), weight, bend)
    S = implicit_covariance(C_dd, C_dz, np.concatenate([S1, S2]))
    return Refined(pose, S, weight, pose.apply(q), s, free * len(q) - 6)


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
    robust: Robust | None,
    c: float,
) -> tuple[RelativePose, Array]:
    """Levenberg and Marquardt on pose and points, and Newton's steps near the minimum."""
    damping = 0.0
    newton = False
    cost, weight, bend = _cost(frames, pose, q, robust, c)
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
            reached, *losses = _cost(frames, there, q_there, robust, c)
            if reached <= cost * (1.0 + SLACK):
                break
            damping = max(10.0 * damping, 1e-4)
            if damping > 1e12:
                raise ConvergenceError("pose: no step lowers the cost; start nearer, or take the outliers out first")
        pose = there
        q = q_there
        cost = reached
        weight, bend = losses
        newton = decrement < NEAR
        if damping > 1e-8:
            damping *= 0.1
        else:
            damping = 0.0
    raise ConvergenceError(f"pose: no minimum in {STEPS} steps; start nearer, or take the outliers out first")


def _cost(
    frames: TwoFrames,
    pose: RelativePose,
    q: Array,
    robust: Robust | None,
    c: float,
) -> tuple[float, Array, Array]:
    rho, weight, bend = loss(robust, frames.squared(pose, q), c)
    return 0.5 * rho.sum(), weight, bend


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
