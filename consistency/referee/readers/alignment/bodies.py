"""Bodies that differ by a constant turn and a lever arm: estimates and errors carried from one to the other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from consistency.referee.geometry import wrap
from consistency.referee.readers.alignment.world_frames import matched
from consistency.referee.readers.poses import Poses
from consistency.referee.types import Array


@dataclass(frozen=True)
class BodyTransform:
    """The body of the truth as that of the estimates sees it."""

    turn: Rotation  # about z in the plane
    arm: Array  # (3,), m; 0 along z in the plane


def fitted_body(runs: Sequence[Poses]) -> BodyTransform | None:
    """The turn and the lever arm with which poses in a common world are nearest to the truth; None without a pose.

    The turn is the mean of R_estimate' R_truth, the arm the mean of R_estimate' (p_truth - p_estimate).
    """
    turns, arms = [], []
    for p in runs:
        own, true = matched(p)
        if len(own):
            R, true_R = (_turns(values, p) for values in (own, true))
            turns.append((R.inv() * true_R).mean())
            arms.append(R.inv().apply(_positions(true, p) - _positions(own, p)))
    if not turns:
        return None
    return BodyTransform(Rotation.concatenate(turns).mean(), np.concatenate(arms).mean(axis=0))


def on_body(p: Poses, body: BodyTransform) -> Poses:
    """The estimates as poses of the other body, with their covariance to first order."""
    finite = np.isfinite(p.estimate).all(axis=1)
    estimate, covariance = p.estimate.copy(), p.covariance.copy()
    if not finite.any():
        return p
    own = p.estimate[finite]
    R = _turns(own, p)
    shift = R.apply(body.arm)
    if p.manifold == "planar":
        estimate[finite] = np.column_stack([own[:, :2] + shift[:, :2], wrap(own[:, 2] + body.turn.as_rotvec()[2])])
    else:
        estimate[finite] = np.column_stack([own[:, :3] + shift, (R * body.turn).as_quat()])
    J = _jacobian(p.convention, R.as_matrix(), body)
    if p.manifold == "planar":
        J = J[:, [0, 1, 5]][:, :, [0, 1, 5]]
    covariance[finite] = J @ p.covariance[finite] @ np.swapaxes(J, 1, 2)
    return replace(p, estimate=estimate, covariance=covariance)


def _jacobian(convention: str, R: Array, body: BodyTransform) -> Array:
    """Error of the other pose by that of the own, (k, 6, 6), in each convention.

    That of ``right`` is unchanged, and that of ``left`` maps by the adjoint (Sola et al. 2018, eq. 175); the others are
    derivatives of p + R l at 0.
    """
    J = np.broadcast_to(np.eye(6), (len(R), 6, 6)).copy()
    back, arm = body.turn.inv().as_matrix(), np.broadcast_to(body.arm, (len(R), 3))
    if convention == "left":
        J[:, :3, :3], J[:, :3, 3:], J[:, 3:, 3:] = back, -back @ skew(arm), back
    elif convention == "so3-body":
        J[:, :3, 3:], J[:, 3:, 3:] = -R @ skew(arm), back
    elif convention != "right":
        J[:, :3, 3:] = -skew((R @ arm[..., None])[..., 0])
    return np.asarray(J)


def skew(v: Array) -> Array:
    """Matrices (..., 3, 3) of the cross product with v (..., 3)."""
    return np.asarray(np.cross(np.eye(3), v[..., None, :]))


def _turns(values: Array, p: Poses) -> Rotation:
    if p.manifold == "planar":
        return Rotation.from_rotvec(values[:, 2:3] * [0.0, 0.0, 1.0])
    return Rotation.from_quat(values[:, 3:])


def _positions(values: Array, p: Poses) -> Array:
    return np.pad(values[:, :2], ((0, 0), (0, 1))) if p.manifold == "planar" else values[:, :3]
