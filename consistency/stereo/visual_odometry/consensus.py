"""Registration among outliers, Fischler & Bolles (1981), as Valencia & Andrade-Cetto (2018) sec. 2.2 uses it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from consistency.referee.errors import InputError
from consistency.referee.types import Array
from consistency.stereo.visual_odometry import input_checks
from consistency.stereo.visual_odometry.input_errors import ConsensusError
from consistency.stereo.visual_odometry.pose import RelativePose
from consistency.stereo.visual_odometry.registration import matched, register_svd, rigid_motions

CONFIDENCE = 0.999  # probability that one draw at least had inliers only
ROUND = 64  # draws at once
MOST = 4096  # draws at most; finds CONFIDENCE from a share of inliers of 12 % on
REFITS = 20  # of the motion to its inliers, at most
FIXED = 1e-4  # rotation of a draw: flatter triples are passed over
SHARE = 0.1  # of all points must be inliers, and 4 at least: three fit any motion that keeps their distances


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
    p1, p2 = matched(p1, p2)
    if not 0.0 < threshold < np.inf:
        raise InputError(f"threshold: {threshold}, must be positive")
    if (S1 is None) != (S2 is None):
        raise InputError("S1, S2: give both covariances or none")
    if S1 is not None and S2 is not None:
        S1, S2 = input_checks.covariances("S1", S1, len(p1), 3), input_checks.covariances("S2", S2, len(p1), 3)
    least = fewest(len(p1)) if minimum is None else minimum

    def inliers_of(R: Array, t: Array) -> Array:
        return squared_distances(p1, p2, R, t, S1, S2) <= threshold**2

    best = _search(p1, p2, inliers_of, rng)
    for _ in range(REFITS):
        if best.sum() < max(3, least):
            break
        R, t, _ = rigid_motions(p1[best], p2[best])
        again = inliers_of(R, t)
        if again.sum() < best.sum() or (again == best).all():
            break
        best = again
    if best.sum() < max(3, least):
        raise ConsensusError(
            f"p1, p2: {int(best.sum())} of {len(p1)} points agree on a motion within {threshold:g}, at least {least} "
            "must; look at the matches, or allow a larger threshold"
        )
    return register_svd(p1[best], p2[best]), best


def fewest(points: int) -> int:
    """Inliers that a motion needs."""
    return max(4, int(np.ceil(SHARE * points)))


def draws_for(share: float, most: int) -> float:
    """Draws of three until one is of inliers only with :data:`CONFIDENCE`, by their share; ``most`` at most."""
    clean = share**3  # probability that a draw has inliers only
    return min(most, np.log1p(-CONFIDENCE) / np.log1p(-min(clean, 1.0 - 1e-12))) if clean > 0.0 else float(most)


def squared_distances(
    p1: Array, p2: Array, R: Array, t: Array, S1: Array | None = None, S2: Array | None = None
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
        return np.asarray(np.einsum("...i,...i->...", residual, residual))
    R = R[..., None, :, :]
    S = S1 + R @ S2 @ np.swapaxes(R, -1, -2)
    try:
        scaled = np.linalg.solve(S, residual[..., None])[..., 0]
    except np.linalg.LinAlgError:
        raise InputError("S1, S2: singular together; a point needs noise in every direction to be judged by") from None
    return np.asarray(np.einsum("...i,...i->...", residual, scaled))


def _search(p1: Array, p2: Array, inliers_of: Callable[[Array, Array], Array], rng: np.random.Generator) -> Array:
    """Inliers (N,) of the best of adaptively many draws."""
    best, draws, needed = np.zeros(len(p1), bool), 0, float(MOST)
    while draws < needed:
        triples = rng.random((ROUND, len(p1))).argpartition(2, axis=1)[:, :3]
        R, t, fixed = rigid_motions(p1[triples], p2[triples])
        inliers = inliers_of(R, t) & (fixed > FIXED)[:, None]
        first = inliers[np.argmax(inliers.sum(axis=1))]
        if first.sum() > best.sum():
            best = first
        draws += ROUND
        needed = draws_for(float(best.mean()), MOST)
    return best
