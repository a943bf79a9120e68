"""Worlds that differ by a turn and a shift, bodies by a turn and a lever arm: estimates carried from one to the other.

Their errors are carried, too.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from consistency.referee.geometry import wrap
from consistency.referee.geometry.conventions import CHARTS
from consistency.referee.geometry.lie_groups import (
    adjoint,
    from_left,
    inverse,
    matrices,
    propagated,
    to_left,
    vectors,
)
from consistency.referee.readers.truth_matching import Manifold, Poses, finite_rows
from consistency.referee.types import Array


@dataclass(frozen=True)
class WorldTransform:
    """Maps a point x of the world of the estimates to turn x + shift in that of the truth."""

    turn: Rotation
    shift: Array  # (3,), m; 0 along z in the plane

    @staticmethod
    def about_z(angle: float, shift: Array) -> WorldTransform:
        """Turn by ``angle``, rad, and shift (2,) or (3,), m."""
        level = np.zeros(3 - len(shift))
        return WorldTransform(Rotation.from_euler("z", angle), np.append(shift, level))

    @property
    def heading(self) -> float:
        """Turn about z, rad, of a frame that turns about nothing else."""
        return float(self.turn.as_rotvec()[2])

    def after(self, other: WorldTransform) -> WorldTransform:
        """Composition of frames: first ``other``, then this one."""
        return WorldTransform(self.turn * other.turn, self.turn.apply(other.shift) + self.shift)

    def placed(self, values: Array, manifold: Manifold) -> Array:
        """Poses or positions (k, m) of one world in the other; those that are not finite stay."""
        out: Array = values.copy()
        finite = finite_rows(values)
        if manifold == "planar":
            R = self.turn.as_matrix()[:2, :2]
            out[:, :2] = values[:, :2] @ R.T + self.shift[:2]
            out[:, 2] = wrap(values[:, 2] + self.heading)
        elif finite.any():
            out[finite, :3] = self.turn.apply(values[finite, :3]) + self.shift
            if manifold == "spatial":
                turned = self.turn * Rotation.from_quat(values[finite, 3:])
                out[finite, 3:] = turned.as_quat()
        return out


PLANE = (0, 1, 5)  # components of a pose in the plane, of one in space
IDENTITY = WorldTransform(Rotation.identity(), np.zeros(3))


def moved(p: Poses, frame: WorldTransform) -> Poses:
    """The estimates in another world, with their covariance."""
    estimate = frame.placed(p.estimate, p.manifold)
    if p.convention in CHARTS:
        finite = finite_rows(p.estimate)
        before, after = (matrices(poses[finite]) for poses in (p.estimate, estimate))
        J = from_left(after, p.convention) @ to_left(before, p.convention)
        covariance = p.covariance.copy()
        covariance[finite] = propagated(J, p.covariance[finite])
        return replace(p, estimate=estimate, covariance=covariance)
    T = carried(p.convention, frame, p.covariance.shape[-1])
    return replace(p, estimate=estimate, covariance=T @ p.covariance @ T.T)


def carried(convention: str, frame: WorldTransform, n: int) -> Array:
    """Matrix (n, n) that carries an error of a pose over to another world.

    An error in the body frame is unchanged; that of ``right`` maps by the adjoint (Sola et al. 2018, eq. 159 and 175).
    """
    F = matrices(np.array([[*frame.shift, *frame.turn.as_quat()]]))
    T: Array = from_left(F, convention)[0]
    if n == 6:
        return T
    return T[np.ix_(PLANE[:n], PLANE[:n])]


def fitted_frame(runs: Sequence[Poses]) -> WorldTransform | None:
    """The turn about z and the shift with which the positions of all runs are nearest to the truth.

    Umeyama (1991), in the plane. None with fewer than three estimates.
    """
    own, true = _positions(runs)
    if len(own) < 3:
        return None
    a = own - own.mean(axis=0)
    b = true - true.mean(axis=0)
    across = (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum()
    along = (a[:, :2] * b[:, :2]).sum()
    angle = float(np.arctan2(across, along))
    turn = Rotation.from_euler("z", angle)
    return WorldTransform(turn, true.mean(axis=0) - turn.apply(own.mean(axis=0)))


def turned_frame(runs: Sequence[Poses]) -> WorldTransform:
    """The frame in which orientations of poses in space, and then positions, are right on average."""
    turns = []
    for p in runs:
        own, true = matched(p)
        if len(own):
            apart = rotations(true, p.manifold) * rotations(own, p.manifold).inv()
            turns.append(apart.mean())
    if not turns:
        return IDENTITY
    turn = Rotation.concatenate(turns).mean()
    own, true = _positions(runs)
    return WorldTransform(turn, true.mean(axis=0) - turn.apply(own.mean(axis=0)))


def spread(runs: Sequence[Poses]) -> float:
    """Root mean square distance of the true positions from their mean, m; 0 where there are none."""
    true = _positions(runs)[1]
    if not len(true):
        return 0.0
    squares = np.square(true - true.mean(axis=0)).sum(axis=1)
    return float(np.sqrt(squares.mean()))


def _positions(runs: Sequence[Poses]) -> tuple[Array, Array]:
    """Estimated and true positions (N, 3) of all runs, z = 0 in the plane."""
    own = [np.empty((0, 3))]
    true = [np.empty((0, 3))]
    for p in runs:
        estimate, truth = matched(p)
        own.append(positions(estimate, p.manifold))
        true.append(positions(truth, p.manifold))
    return np.concatenate(own), np.concatenate(true)


def matched(p: Poses) -> tuple[Array, Array]:
    """Estimates that are finite and have a truth, and that truth, (k, m) both."""
    known = p.known()
    estimate = p.estimate[known.rows]
    finite = finite_rows(estimate)
    return estimate[finite], known.truth[finite]


@dataclass(frozen=True)
class BodyTransform:
    """The body of the truth as that of the estimates sees it."""

    turn: Rotation  # about z in the plane
    arm: Array  # (3,), m; 0 along z in the plane


def fitted_body(runs: Sequence[Poses]) -> BodyTransform | None:
    """The turn and the lever arm with which poses in a common world are nearest to the truth; None without a pose.

    The turn is the mean of R_estimate' R_truth, the arm the mean of R_estimate' (p_truth - p_estimate).
    """
    turns = []
    arms = []
    for p in runs:
        own, true = matched(p)
        if len(own):
            back = rotations(own, p.manifold).inv()
            turns.append((back * rotations(true, p.manifold)).mean())
            gap = positions(true, p.manifold) - positions(own, p.manifold)
            arms.append(back.apply(gap))
    if not turns:
        return None
    arm = np.concatenate(arms).mean(axis=0)
    return BodyTransform(Rotation.concatenate(turns).mean(), arm)


def on_body(p: Poses, body: BodyTransform) -> Poses:
    """The estimates as poses of the other body, with their covariance to first order.

    The left error of T B is Ad(B)^-1 e of the left error e of T (Sola et al. 2018, eq. 175).
    """
    finite = finite_rows(p.estimate)
    pose = [*body.arm, *body.turn.as_quat()]
    if p.manifold == "planar":
        pose = [*body.arm[:2], body.turn.as_rotvec()[2]]
    B = matrices(np.array([pose]))
    T = matrices(p.estimate[finite])
    other = T @ B
    J = from_left(other, p.convention) @ adjoint(inverse(B)) @ to_left(T, p.convention)
    estimate = p.estimate.copy()
    covariance = p.covariance.copy()
    estimate[finite] = vectors(other)
    covariance[finite] = propagated(J, p.covariance[finite])
    return replace(p, estimate=estimate, covariance=covariance)


def skew(v: Array) -> Array:
    """Matrices (..., 3, 3) of the cross product with v (..., 3)."""
    return np.asarray(np.cross(np.eye(3), v[..., None, :]))


def rotations(values: Array, manifold: Manifold) -> Rotation:
    """Orientations of poses (k, m)."""
    if manifold == "planar":
        return Rotation.from_rotvec(values[:, 2:3] * [0.0, 0.0, 1.0])
    return Rotation.from_quat(values[:, 3:])


def positions(values: Array, manifold: Manifold) -> Array:
    """Positions (k, 3) of poses (k, m), z = 0 in the plane."""
    if manifold == "planar":
        return np.pad(values[:, :2], ((0, 0), (0, 1)))
    return values[:, :3]
