"""The rigid motion between two clouds of matched points, Valencia & Andrade-Cetto (2018) sec. 2.2.

All minimise eq. 2.4, the sum of ||p1 - (R p2 + t)||^2; among outliers by the consensus of Fischler & Bolles (1981).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial.transform import Rotation

from consistency.referee.errors import InputError
from consistency.referee.types import Array, Indices
from consistency.stereo.visual_odometry import arrays
from consistency.stereo.visual_odometry.arrays import ConsensusError, DegenerateError
from consistency.stereo.visual_odometry.relative_pose import AXES, RelativePose

ON_A_LINE = 1e-8  # second singular value of a cloud, over its largest coordinate, up to which it is a line
AMBIGUOUS = 1e-14  # gap to the second-best rotation, relative, that is rounding
CONFIDENCE = 0.999  # probability that one draw at least had inliers only
ROUND = 64  # draws at once
MOST = 4096  # draws at most; finds CONFIDENCE from a share of inliers of 12 % on
REFITS = 20  # of the motion to its inliers, at most
FIXED = 1e-4  # rotation of a draw: flatter triples are passed over
SHARE = 0.1  # of all points must be inliers, and 4 at least: three fit any motion that keeps their distances


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
