"""Consensus among the matches of two stereo pairs by their reprojection: P3P inside RANSAC.

Triples of points of the first pair, and where the left camera saw them at the second, give poses (Gao et al. 2003;
OpenCV solves for them). All four coordinates in pixels judge a pose, of near and far points alike.
"""

from __future__ import annotations

import numpy as np
from scipy import stats

from consistency.referee.types import Array
from consistency.stereo.visual_odometry.arrays import ConsensusError, opencv
from consistency.stereo.visual_odometry.maximum_likelihood import PixelMatches, triangulation_covariance
from consistency.stereo.visual_odometry.registration import draw_triples, draws_for, fewest
from consistency.stereo.visual_odometry.relative_pose import RelativePose
from consistency.stereo.visual_odometry.rig import StereoRig, triangulate

ROUND = 32  # draws at once
MOST = 1024  # draws at most; finds CONFIDENCE from a share of inliers of 19 % on
SLACK_PX = 1.0  # of a coordinate in the search: poses of three noisy points miss all others by some pixels
MEDIAN = stats.chi2.median(4)  # of an honest squared distance
ROUNDS = 10  # of the gate to the noise that is there, at most
FEWEST = 8  # inliers that tell how large the noise is


def resect_ransac(
    rig: StereoRig,
    uv0: Array,
    uv1: Array,
    sigma0: Array,
    sigma1: Array,
    *,
    gate: float,
    rng: np.random.Generator,
) -> tuple[RelativePose, Array]:
    """The pose that most matches agree on, p0 = R p1 + t, and these matches.

    Triples are drawn until one without outliers was among them with probability 0.999, by the share of inliers found so
    far, and at most 1024 times. The best has the least sum of truncated squared distances (Torr & Zisserman 2000).

    Parameters
    ----------
    uv0, uv1 : (N, 4), u, v, u', v' of the same points in frame 0 and 1, px; all triangulable in frame 0
    sigma0, sigma1 : (N, 4), their standard deviations, px
    gate : standard deviations that an inlier may miss by; see :func:`inliers_within`
    rng : the only source of chance

    Returns
    -------
    pose, inliers (N,) bool

    Raises
    ------
    InputError
        OpenCV is not installed.
    ConsensusError
        No motion has enough inliers: 4, and a tenth of the matches.
    """
    least = fewest(len(uv0))
    variance = sigma0**2 + sigma1**2 + SLACK_PX**2
    found, inliers = _search(rig, triangulate(rig, uv0), uv1, variance, gate, rng)
    if found is not None:
        inliers = inliers_within(squared_reprojections(rig, uv0, uv1, sigma0, sigma1, found), gate, inliers)
    if found is None or inliers.sum() < least:
        raise ConsensusError(
            f"uv0, uv1: {int(inliers.sum())} of {len(uv0)} matches agree on a motion, at least {least} must; look at "
            "the matches, or allow a larger gate"
        )
    return found, inliers


def squared_reprojections(
    rig: StereoRig,
    uv0: Array,
    uv1: Array,
    sigma0: Array,
    sigma1: Array,
    pose: RelativePose,
) -> Array:
    """Squared Mahalanobis distances (N,) in frame 1 of the points triangulated in frame 0, 4 degrees of freedom.

    Infinite where ``pose``, p0 = R p1 + t, puts a point behind a camera.
    """
    camera = PixelMatches(rig)
    seen = (triangulate(rig, uv0) - pose.t) @ pose.R
    residual = uv1 - camera.value(seen)
    J = camera.jacobian(seen) @ pose.R.T
    C0 = triangulation_covariance(rig, uv0, diagonal_covariances(sigma0))
    S = J @ C0 @ np.swapaxes(J, 1, 2) + diagonal_covariances(sigma1)
    in_front = np.isfinite(S).all(axis=(1, 2))
    scaled = np.linalg.solve(S[in_front], residual[in_front][:, :, None])[:, :, 0]
    squared = np.full(len(uv0), np.inf)
    squared[in_front] = (residual[in_front] * scaled).sum(axis=1)
    return squared


def diagonal_covariances(sigma: Array) -> Array:
    """Covariances (N, k, k) of independent components with standard deviations (N, k)."""
    return sigma[:, :, None] ** 2 * np.eye(sigma.shape[1])


def inliers_within(squared: Array, gate: float, among: Array) -> Array:
    """Which squared distances (N,), of 4 degrees of freedom, are within a gate of so many standard deviations.

    The stated noise lacks what all matches share, such as errors of the calibration: where the median of the inliers is
    larger than noise alone would make it, the gate grows with it.

    Parameters
    ----------
    among : (N,) bool, what is taken for inliers so far
    """
    inliers = among
    for _ in range(ROUNDS):
        scale = 1.0
        if inliers.sum() >= FEWEST:
            scale = max(1.0, np.median(squared[inliers]) / MEDIAN)
        found = squared <= scale * gate**2
        if (found == inliers).all():
            break
        inliers = found
    return inliers


def _search(
    rig: StereoRig,
    p0: Array,
    uv1: Array,
    variance: Array,
    gate: float,
    rng: np.random.Generator,
) -> tuple[RelativePose | None, Array]:
    """The pose of the least cost of adaptively many draws, None where no triple gave one, and its inliers (N,)."""
    least = np.inf
    best = None
    inliers = np.zeros(len(p0), bool)
    draws = 0
    needed: float = MOST
    while draws < needed:
        R, t = _poses_of(rig, p0, uv1, draw_triples(rng, ROUND, len(p0)))
        draws += ROUND
        if not len(R):
            continue
        seen = ((p0 - t[:, None]) @ R).reshape(-1, 3)
        residual = uv1 - PixelMatches(rig).value(seen).reshape(len(R), -1, 4)
        squared = np.nan_to_num((residual**2 / variance).sum(axis=2), nan=np.inf)
        cost = np.minimum(squared, gate**2).sum(axis=1)
        k = int(np.argmin(cost))
        if cost[k] < least:
            least = cost[k]
            best = RelativePose(R[k], t[k])
            inliers = squared[k] <= gate**2
            needed = draws_for(inliers.mean(), MOST)
    return best, inliers


def _poses_of(
    rig: StereoRig,
    p0: Array,
    uv1: Array,
    triples: Array,
) -> tuple[Array, Array]:
    """R (k, 3, 3) and t (k, 3) of p0 = R p1 + t, up to four for each triple (n, 3)."""
    cv2 = opencv()
    R = []
    t = []
    for triple in triples:
        _, turns, shifts = cv2.solveP3P(
            p0[triple], np.ascontiguousarray(uv1[triple, :2]), rig.K_left, None, flags=cv2.SOLVEPNP_AP3P
        )
        for turn, shift in zip(turns or (), shifts or (), strict=True):
            back = cv2.Rodrigues(turn)[0].T
            if np.isfinite(back).all() and np.isfinite(shift).all():
                R.append(back)
                t.append(-(back @ shift).ravel())
    return np.array(R), np.array(t)
