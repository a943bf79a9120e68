"""Relative poses in space, their Euler angles and what both do to a covariance.

The rotation is R = Rz(yaw) Ry(pitch) Rx(roll), rot(roll, pitch, yaw) of Valencia & Andrade-Cetto (2018) eq. 2.28. At a
pitch of +-90 degrees roll and yaw are not defined, and a covariance of them is not either: :class:`GimbalLockError`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from consistency.referee import geometry
from consistency.referee.errors import InputError
from consistency.referee.geometry import propagated
from consistency.referee.types import Array
from consistency.stereo.visual_odometry import arrays
from consistency.stereo.visual_odometry.arrays import GimbalLockError

LOCKED = 1e-6  # cosine of the pitch below which six digits of roll and yaw are left

AXES = np.cross(np.eye(3)[:, None], np.eye(3)).swapaxes(1, 2)  # [e_k]x, the rotations' generators


@dataclass(frozen=True, eq=False)
class RelativePose:
    """A motion p1 = R p2 + t: the pose of frame 2 in frame 1.

    Raises
    ------
    InputError
        A shape, a value that is not finite, or R no rotation.
    """

    R: Array  # (3, 3)
    t: Array  # (3,), m

    def __post_init__(self) -> None:
        arrays.freeze(self, R=(3, 3), t=(3,))

    @classmethod
    def from_vector(cls, vector: Array) -> RelativePose:
        """Of x, y, z (m), roll, pitch, yaw (rad); shape (6,)."""
        values = arrays.floats("vector", vector)
        if values.shape != (6,):
            raise InputError(f"vector: shape {values.shape}, allowed is (6,)")
        return cls(geometry.rotation(*values[3:]), values[:3])

    @property
    def rpy(self) -> Array:
        """Roll, pitch, yaw, (3,) in rad; GimbalLockError at a pitch of +-90 degrees."""
        return euler_angles(self.R)

    @property
    def vector(self) -> Array:
        """(6,): x, y, z (m), roll, pitch, yaw (rad)."""
        return np.concatenate([self.t, self.rpy])

    @property
    def matrix(self) -> Array:
        """Homogeneous matrix [R t; 0 1] of the motion, (4, 4)."""
        return np.vstack([np.column_stack([self.R, self.t]), [0.0, 0.0, 0.0, 1.0]])

    def apply(self, points: Array) -> Array:
        """R p + t of points (N, 3)."""
        return points @ self.R.T + self.t

    def compose(self, other: RelativePose) -> RelativePose:
        """p1 = self(other(p3)): first ``other``, then this motion."""
        return RelativePose(self.R @ other.R, self.R @ other.t + self.t)

    def inverse(self) -> RelativePose:
        """p2 = R'(p1 - t)."""
        return RelativePose(self.R.T, -self.R.T @ self.t)


def euler_angles(R: Array) -> Array:
    """Roll, pitch, yaw (..., 3) of rotations (..., 3, 3), rad; GimbalLockError at a pitch of +-90 degrees."""
    cosine = np.hypot(R[..., 0, 0], R[..., 1, 0])
    if (cosine < LOCKED).any():
        raise GimbalLockError("pose: a pitch of 90 degrees, roll and yaw are not defined; turn the frames' axes")
    roll = np.arctan2(R[..., 2, 1], R[..., 2, 2])
    yaw = np.arctan2(R[..., 1, 0], R[..., 0, 0])
    pitch = np.arctan2(-R[..., 2, 0], cosine)
    return np.stack([roll, pitch, yaw], axis=-1)


def rotation_derivatives(pose: RelativePose) -> tuple[Array, Array]:
    """d R / d rpy_k (3, 3, 3) and d2 R / d rpy_k d rpy_l (3, 3, 3, 3) of R = Rz(yaw) Ry(pitch) Rx(roll).

    Each angle turns about one axis e: the derivative is [e]x on the side of R where that axis does not turn, which is
    the frame 2 for roll, and frame 1 for yaw and, with e = Rz(yaw) e_y, for pitch.
    """
    R = pose.R
    X, _, Z = AXES
    yaw = pose.rpy[2]
    Y = cross_matrix(np.array([-np.sin(yaw), np.cos(yaw), 0.0]))
    R_r = R @ X
    R_p = Y @ R
    R_y = Z @ R
    R_rp = Y @ R_r
    R_ry = Z @ R_r
    R_py = Z @ R_p
    second = [
        [R_r @ X, R_rp, R_ry],
        [R_rp, Y @ R_p, R_py],
        [R_ry, R_py, Z @ R_y],
    ]
    return np.array([R_r, R_p, R_y]), np.array(second)


def angular(pose: RelativePose) -> Array:
    """E (3, 3) with omega = E d rpy: the small rotation of frame 1 that a change of the angles is."""
    _, pitch, yaw = pose.rpy
    E = np.eye(3)
    E[:, 0] = geometry.rotation(0.0, pitch, yaw)[:, 0]
    E[:, 1] = geometry.rotation(0.0, 0.0, yaw)[:, 1]
    return E


def compose(
    a: RelativePose,
    S_a: Array,
    b: RelativePose,
    S_b: Array,
) -> tuple[RelativePose, Array]:
    """a after b, with covariance to first order; the errors of the two are independent.

    Parameters
    ----------
    S_a, S_b : (6, 6), of x, y, z, roll, pitch, yaw

    Raises
    ------
    InputError
        A covariance that is none.
    GimbalLockError
        One of the three poses has a pitch of +-90 degrees.
    """
    S_a = arrays.covariances("S_a", S_a, 1, 6)[0]
    S_b = arrays.covariances("S_b", S_b, 1, 6)[0]
    both = a.compose(b)
    E_a = angular(a)
    E_b = angular(b)
    E_inverse = np.linalg.inv(angular(both))
    J_a = np.eye(6)
    J_b = np.zeros((6, 6))
    J_a[:3, 3:] = -cross_matrix(a.R @ b.t) @ E_a
    J_a[3:, 3:] = E_inverse @ E_a
    J_b[:3, :3] = a.R
    J_b[3:, 3:] = E_inverse @ a.R @ E_b
    return both, propagated(J_a, S_a) + propagated(J_b, S_b)


def invert(pose: RelativePose, S: Array) -> tuple[RelativePose, Array]:
    """The inverse motion with its covariance (6, 6) to first order; errors as in :func:`compose`."""
    S = arrays.covariances("S", S, 1, 6)[0]
    inverse = pose.inverse()
    J = np.zeros((6, 6))
    J[:3, :3] = -pose.R.T
    J[:3, 3:] = -pose.R.T @ cross_matrix(pose.t) @ angular(pose)
    J[3:, 3:] = -np.linalg.solve(angular(inverse), pose.R.T @ angular(pose))
    return inverse, propagated(J, S)


def cross_matrix(v: Array) -> Array:
    """[v]x (..., 3, 3) of vectors (..., 3), with [v]x w = v x w."""
    return np.tensordot(v, AXES, 1)
