"""Relative poses in space: their Euler angles, what both do to a covariance, and the pose between two clouds of points.

The rotation is R = Rz(yaw) Ry(pitch) Rx(roll), rot(roll, pitch, yaw) of Valencia & Andrade-Cetto (2018) eq. 2.28. At a
pitch of +-90 degrees roll and yaw are not defined, and a covariance of them is not either: :class:`GimbalLockError`.

Registrations (sec. 2.2) give the rigid motion between matched points: they minimise eq. 2.4, the sum of
||p1 - (R p2 + t)||^2, among outliers by the consensus of Fischler & Bolles (1981). Those that weigh the points by their
covariances are in ``maximum_likelihood``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from consistency.referee import geometry
from consistency.referee.errors import InputError
from consistency.referee.geometry import propagated
from consistency.referee.types import Array, Indices
from consistency.stereo.visual_odometry import arrays
from consistency.stereo.visual_odometry.arrays import ConsensusError, DegenerateError, GimbalLockError

LOCKED = 1e-6  # cosine of the pitch below which six digits of roll and yaw are left

AXES = np.cross(np.eye(3)[:, None], np.eye(3)).swapaxes(1, 2)  # [e_k]x, the rotations' generators
ON_A_LINE = 1e-8  # second singular value of a cloud, over its largest coordinate, up to which it is a line
AMBIGUOUS = 1e-14  # gap to the second-best rotation, relative, that is rounding
CONFIDENCE = 0.999  # probability that one draw at least had inliers only
ROUND = 64  # draws at once
MOST = 4096  # draws at most; finds CONFIDENCE from a share of inliers of 12 % on
REFITS = 20  # of the motion to its inliers, at most
FIXED = 1e-4  # rotation of a draw: flatter triples are passed over
SHARE = 0.1  # of all points must be inliers, and 4 at least: three fit any motion that keeps their distances


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


def register_svd(p1: Array, p2: Array) -> RelativePose:
    """Eq. 2.15-2.21 (Arun, Huang & Blostein 1987); where eq. 2.20 is a reflection, the nearest rotation.

    Parameters
    ----------
    p1, p2 : (N, 3), the same points in frame 1 and 2, m

    Returns
    -------
    R, t with p1 = R p2 + t

    Raises
    ------
    InputError
        Shapes that do not match, or a value that is not finite.
    DegenerateError
        Fewer than three points, identical points, or points on one line.
    """
    p1, p2 = checked_clouds(p1, p2)
    R, t, fixed = rigid_motions(p1, p2)
    _require_unique(float(fixed))
    return RelativePose(R, t)


def register_horn(p1: Array, p2: Array, *, directions: bool = False) -> RelativePose:
    """Eq. 2.5-2.14 (Horn, Hilden & Negahdaripour 1988), by the quaternion.

    Two departures from print, each held by a test. Eq. 2.5 and 2.6 take the unit vectors from the camera to the points;
    under a translation these are not rotated copies of each other, and R is wrong even without noise. The points'
    vectors from their centroids are taken instead, as Horn does. And with eq. 2.9 the quaternion's scalar is the first
    component, where eq. 2.11 takes the last.

    Parameters
    ----------
    p1, p2 : (N, 3), the same points in frame 1 and 2, m
    directions : eq. 2.5 and 2.6 as printed; right for t = 0 only

    Returns
    -------
    R, t with p1 = R p2 + t

    Raises
    ------
    InputError, DegenerateError
        As :func:`register_svd`.
    """
    p1, p2 = checked_clouds(p1, p2)
    if directions:
        v1 = _directions(p1)
        v2 = _directions(p2)
    else:
        v1 = p1 - p1.mean(axis=0)
        v2 = p2 - p2.mean(axis=0)
    b = v2 + v1
    c = v2 - v1
    B_i = np.zeros((len(p1), 4, 4))
    B_i[:, 0, 1:] = -c
    B_i[:, 1:, 0] = c
    B_i[:, 1:, 1:] = -np.tensordot(b, AXES, 1)  # -[b]x
    B = np.einsum("nij,nkj->ik", B_i, B_i)
    values, vectors = np.linalg.eigh(B)
    _require_unique((values[1] - values[0]) / values[3])
    scalar, *vector = vectors[:, 0]
    R = Rotation.from_quat([*vector, scalar]).as_matrix()
    return RelativePose(R, p1.mean(axis=0) - R @ p2.mean(axis=0))


def _directions(points: Array) -> Array:
    """Unit vectors (N, 3) from the camera."""
    length = np.linalg.norm(points, axis=1, keepdims=True)
    if length.min() == 0.0:
        raise DegenerateError("p1, p2: a point at the camera has no direction; leave it out")
    return points / length


def checked_clouds(p1: Array, p2: Array) -> tuple[Array, Array]:
    """Both clouds as floats, (N, 3) and (N, 3), checked: errors as :func:`register_svd`."""
    p1 = arrays.checked_rows("p1", p1, 3)
    p2 = arrays.checked_rows("p2", p2, 3)
    arrays.same_length("p1, p2", p1, p2)
    if len(p1) < 3:
        raise DegenerateError(f"p1, p2: {len(p1)} points, a rigid motion needs at least 3")
    for name, p in (("p1", p1), ("p2", p2)):
        spread = np.linalg.svd(p - p.mean(axis=0), compute_uv=False)
        if spread[1] <= ON_A_LINE * np.abs(p).max():
            raise DegenerateError(f"{name}: the points are identical or lie on one line and do not fix a rotation")
    return p1, p2


def _require_unique(fixed: float) -> None:
    if not fixed > AMBIGUOUS:
        raise DegenerateError("p1, p2: more than one rotation fits the points best; one cloud mirrors the other")


def rigid_motions(p1: Array, p2: Array) -> tuple[Array, Array, Array]:
    """Eq. 2.15-2.21 of many clouds at once, unchecked.

    Parameters
    ----------
    p1, p2 : (..., N, 3), m

    Returns
    -------
    R (..., 3, 3), t (..., 3) in m, and how well the rotation is fixed (...), 0 for points on a line to 1
    """
    c1 = p1.mean(axis=-2)
    c2 = p2.mean(axis=-2)
    centred1 = p1 - c1[..., None, :]
    centred2 = p2 - c2[..., None, :]
    M = np.swapaxes(centred1, -1, -2) @ centred2
    U, s, Vt = np.linalg.svd(M)
    sign = np.where(np.linalg.det(U @ Vt) < 0.0, -1.0, 1.0)
    U[..., 2] *= sign[..., None]
    R = U @ Vt
    t = c1 - (R @ c2[..., None])[..., 0]
    largest, second, third = np.moveaxis(s, -1, 0)
    fixed = (second + sign * third) / np.maximum(largest, np.finfo(float).tiny)
    return R, t, fixed


def register_ransac(
    p1: Array,
    p2: Array,
    *,
    threshold: float,
    rng: np.random.Generator,
    S1: Array | None = None,
    S2: Array | None = None,
    minimum: int | None = None,
) -> tuple[RelativePose, Array]:
    """:func:`register_svd` of the largest set of points that agree on a motion.

    Triples are drawn until one without outliers was among them with probability 0.999, by the share of inliers found
    so far, and at most 4096 times; then the motion is fitted to its inliers again until they stay the same.

    Parameters
    ----------
    p1, p2 : (N, 3), m
    threshold : largest ||p1 - (R p2 + t)|| of an inlier, m; with S1 and S2 in standard deviations, so that far
        points, which stereo sees badly, may miss by more
    rng : the only source of chance
    S1, S2 : (3, 3) or (N, 3, 3), covariances of the points, m^2; both or none
    minimum : inliers that a motion needs; 4 and a tenth of the points unless given

    Returns
    -------
    pose, inliers (N,) bool

    Raises
    ------
    InputError, DegenerateError
        As :func:`register_svd`; a threshold that is not positive; S1 without S2.
    ConsensusError
        No motion has enough inliers.
    """
    p1, p2 = checked_clouds(p1, p2)
    if not 0.0 < threshold < np.inf:
        raise InputError(f"threshold: {threshold}, must be positive")
    if (S1 is None) != (S2 is None):
        raise InputError("S1, S2: give both covariances or none")
    if S1 is not None and S2 is not None:
        S1 = arrays.covariances("S1", S1, len(p1), 3)
        S2 = arrays.covariances("S2", S2, len(p1), 3)
    if minimum is None:
        minimum = fewest(len(p1))

    def inliers_of(R: Array, t: Array) -> Array:
        return squared_distances(p1, p2, R, t, S1, S2) <= threshold**2

    best = _search(p1, p2, inliers_of, rng)
    for _ in range(REFITS):
        if best.sum() < max(3, minimum):
            break
        R, t, _ = rigid_motions(p1[best], p2[best])
        again = inliers_of(R, t)
        if again.sum() < best.sum() or (again == best).all():
            break
        best = again
    if best.sum() < max(3, minimum):
        raise ConsensusError(
            f"p1, p2: {int(best.sum())} of {len(p1)} points agree on a motion within {threshold:g}, at least {minimum} "
            "must; look at the matches, or allow a larger threshold"
        )
    return register_svd(p1[best], p2[best]), best


def fewest(points: int) -> int:
    """Inliers that a motion needs."""
    return max(4, int(np.ceil(SHARE * points)))


def draws_for(share: float, most: int) -> float:
    """Draws of three until one is of inliers only with :data:`CONFIDENCE`, by their share; ``most`` at most."""
    clean = share**3  # probability that a draw has inliers only
    if clean == 0.0:
        return most
    return min(most, np.log1p(-CONFIDENCE) / np.log1p(-min(clean, 1.0 - 1e-12)))


def draw_triples(rng: np.random.Generator, draws: int, points: int) -> Indices:
    """Rows (draws, 3) of three different points each."""
    return rng.random((draws, points)).argpartition(2, axis=1)[:, :3]


def squared_distances(
    p1: Array,
    p2: Array,
    R: Array,
    t: Array,
    S1: Array | None = None,
    S2: Array | None = None,
) -> Array:
    """||p1 - (R p2 + t)||^2, or with covariances its Mahalanobis form under S1 + R S2 R'.

    Parameters
    ----------
    p1, p2 : (N, 3), m
    R, t : (..., 3, 3), (..., 3)
    S1, S2 : (N, 3, 3), m^2

    Returns
    -------
    (..., N), m^2 or without unit
    """
    residual = p1 - p2 @ np.swapaxes(R, -1, -2) - t[..., None, :]
    if S1 is None or S2 is None:
        return np.einsum("...i,...i->...", residual, residual)
    R = R[..., None, :, :]
    S = S1 + R @ S2 @ np.swapaxes(R, -1, -2)
    try:
        scaled = np.linalg.solve(S, residual[..., None])[..., 0]
    except np.linalg.LinAlgError:
        raise InputError("S1, S2: singular together; a point needs noise in every direction to be judged by") from None
    return np.einsum("...i,...i->...", residual, scaled)


def _search(
    p1: Array,
    p2: Array,
    inliers_of: Callable[[Array, Array], Array],
    rng: np.random.Generator,
) -> Array:
    """Inliers (N,) of the best of adaptively many draws."""
    best = np.zeros(len(p1), bool)
    draws = 0
    needed: float = MOST
    while draws < needed:
        triples = draw_triples(rng, ROUND, len(p1))
        R, t, fixed = rigid_motions(p1[triples], p2[triples])
        inliers = inliers_of(R, t) & (fixed > FIXED)[:, None]
        first = inliers[np.argmax(inliers.sum(axis=1))]
        if first.sum() > best.sum():
            best = first
        draws += ROUND
        needed = draws_for(best.mean(), MOST)
    return best
