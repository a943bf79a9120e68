"""What two frames measured of N unknown points, as a cost of the relative pose.

Frame 1 measured z1 of R q + t, frame 2 measured z2 of q. With e the measured minus the predicted value and W the
inverse of its covariance, a point's cost is f = (e1' W1 e1 + e2' W2 e2) / 2. Points are independent given the pose, so
that each q is eliminated from the second derivatives by itself (Schur complement).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from consistency.referee.types import Array
from consistency.stereo.visual_odometry.cameras.rig import StereoRig
from consistency.stereo.visual_odometry.relative_pose import RelativePose, rotation_derivatives


class TwoFrames(NamedTuple):
    """Measurements of the same points in two frames."""

    measure: PointMatches | PixelMatches
    z1: Array  # (N, k)
    z2: Array  # (N, k)
    W1: Array  # (N, k, k), inverse covariance
    W2: Array  # (N, k, k)

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
