"""From two stereo pairs of images to a relative pose with its covariance, Valencia & Andrade-Cetto (2018) ch. 2.

Among wrong matches by their reprojection, P3P inside RANSAC: triples of points of the first pair, and where the left
camera saw them at the second, give poses (Gao et al. 2003; OpenCV solves for them). All four coordinates in pixels
judge a pose, of near and far points alike.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from scipy import stats

from consistency.referee.errors import InputError
from consistency.referee.types import Array, Indices
from consistency.stereo.visual_odometry.arrays import ConsensusError, MatchError, opencv
from consistency.stereo.visual_odometry.features import (
    COUNT,
    EPIPOLAR_PX,
    RATIO,
    StereoFeatures,
    circular_matches,
    grey,
    homogeneous,
    sift,
    stereo_matches,
)
from consistency.stereo.visual_odometry.maximum_likelihood import (
    PixelMatches,
    Refined,
    refine_reprojection,
    registration_covariance,
    triangulation_covariance,
)
from consistency.stereo.visual_odometry.relative_pose import (
    RelativePose,
    draw_triples,
    draws_for,
    fewest,
    register_horn,
    register_svd,
    squared_distances,
)
from consistency.stereo.visual_odometry.rig import StereoRig, in_px, triangulable, triangulate

ESTIMATORS = ("reprojection", "svd", "horn")
FEWEST = 8  # closed circles; below, RANSAC would agree with anything
MISFIT = 5.0  # chi2/dof at most; 0.2 to 1.4 on good images, 8 on swapped ones
FIRST_ORDER = 0.05  # relative uncertainty of a depth up to which first order holds (docs/front-end.md)
DOMINATED = 0.5  # of the variance from points beyond: an unweighted registration is theirs
ROUNDING = 1e-9  # relative, of a disparity: that of exact pixels may be less than it is
REFITS = 5  # of the pose to its inliers, at most; two or three do
Pair = tuple[Array, Array]
ROUND = 32  # draws at once
MOST = 1024  # draws at most; finds CONFIDENCE from a share of inliers of 19 % on
SLACK_PX = 1.0  # of a coordinate in the search: poses of three noisy points miss all others by some pixels
MEDIAN = stats.chi2.median(4)  # of an honest squared distance
ROUNDS = 10  # of the gate to the noise that is there, at most
ENOUGH = 8  # inliers that tell how large the noise is


@dataclass(frozen=True)
class MotionSettings:
    """What the front-end does with images; the defaults are those of docs/front-end.md, with their origin."""

    features: int = COUNT  # of an image, at most
    ratio: float = RATIO
    epipolar_px: float = EPIPOLAR_PX
    min_disparity: float = 2.0  # px; nearer to zero, a point's depth is not Gaussian even to first order
    sigma_per_scale: float = 0.15  # px of feature noise per px of SIFT scale
    gate: float = 4.0  # sigma of an inlier in the four pixels: 0.3 % of good matches are lost
    estimator: str = "reprojection"

    def __post_init__(self) -> None:
        if self.estimator not in ESTIMATORS:
            raise InputError(f"estimator '{self.estimator}': must be one of {', '.join(ESTIMATORS)}")
        for name in ("ratio", "epipolar_px", "min_disparity", "sigma_per_scale", "gate"):
            if not 0.0 < getattr(self, name) < np.inf:
                raise InputError(f"{name}: {getattr(self, name)}, must be a positive number")
        if self.features < FEWEST:
            raise InputError(f"features: {self.features}, must be at least {FEWEST}")


@dataclass(frozen=True, eq=False)
class MotionEstimate:
    """The pose of the left camera at time 1 in that of time 0, p0 = R p1 + t, of M matches."""

    pose: RelativePose
    covariance: Array  # (6, 6), of x, y, z (m), roll, pitch, yaw (rad)
    inliers: Array  # (M,) bool
    chi2: float  # of the inliers' residuals; over dof it is 1 where the noise of the features is as stated
    dof: int
    far_share: float = field(default=0.0, kw_only=True)  # of the points' variance: of depths that first order fails for

    @property
    def doubt(self) -> str:
        """What is wrong with an unweighted registration of these points; empty where nothing is known."""
        if self.far_share <= DOMINATED:
            return ""
        return (
            f"points with a depth uncertain by more than {FIRST_ORDER:.0%} bring {self.far_share:.0%} of the variance: "
            "svd and horn give them full weight, and neither pose nor covariance can be relied on; take "
            "estimator reprojection"
        )


@dataclass(frozen=True, eq=False)
class RelativeMotion(MotionEstimate):
    """An estimate and what it was found from: M circles of matches through all four images."""

    uv0: Array  # (M, 4), u, v left and right at time 0, px
    uv1: Array  # (M, 4), at time 1, px
    sigma0: Array  # (M, 4), of uv0, px
    sigma1: Array  # (M, 4), of uv1, px
    rows: Indices  # (M, 2), of the stereo matches at time 0 and 1
    fault: str = ""  # why the images did not tell it: then M is 0, and the motion is a bridge between its neighbours


def relative_motion(
    rig: StereoRig,
    before: Pair,
    after: Pair,
    *,
    rng: np.random.Generator,
    settings: MotionSettings | None = None,
    estimator: str | None = None,
) -> RelativeMotion:
    """Motion of a stereo rig between two pairs of images without distortion.

    SIFT features, matched left0-right0-right1-left1-left0; triangulation (eq. 2.26); P3P inside RANSAC, judged in the
    images; then the estimator.

    Parameters
    ----------
    before, after : (left, right), images (h, w) or (h, w, 3), 8-bit grey or colour
    rng : the only source of chance, for RANSAC
    estimator : ``reprojection``, maximum likelihood of the eight pixels of each point with robust weights; ``svd``
        or ``horn``, the chapter's registrations of points (eq. 2.5-2.21) with the covariance of eq. 2.24-2.31

    Returns
    -------
    pose of camera 1 in camera 0 (p0 = R p1 + t) and its covariance; see :class:`RelativeMotion`

    Warns
    -----
    UserWarning
        Far points dominate ``svd`` or ``horn``: see :attr:`Estimate.doubt`.

    Raises
    ------
    InputError
        OpenCV is not installed; images of another size than the rig's; too few matches.
    ConsensusError, DegenerateError, ConvergenceError
        The matches do not agree on a motion, or do not fix one; all are InputErrors.
    """
    settings = settings or MotionSettings()
    if estimator is not None:
        settings = replace(settings, estimator=estimator)
    first = stereo_features(rig, *before, settings, "before")
    second = stereo_features(rig, *after, settings, "after")
    motion = motion_between(first, second, settings, rng, ("before", "after"))
    if motion.doubt:
        warnings.warn(motion.doubt, stacklevel=2)
    return motion


def stereo_features(rig: StereoRig, left: Array, right: Array, settings: MotionSettings, name: str) -> StereoFeatures:
    """Features and stereo matches of a pair of images (h, w): what a sequence keeps for the next motion.

    Raises
    ------
    InputError
        As :func:`relative_motion`.
    """
    left = _grey_of_rig(rig, left, f"{name} left")
    right = _grey_of_rig(rig, right, f"{name} right")
    with ThreadPoolExecutor(2) as pool:  # OpenCV holds no lock, and uses a core and a half of its own accord
        one = pool.submit(sift, left, settings.features, name)
        two = pool.submit(sift, right, settings.features, name)
    return stereo_matches(rig, one.result(), two.result(), settings.ratio, settings.epipolar_px)


def _grey_of_rig(rig: StereoRig, image: Array, name: str) -> Array:
    image = grey(image, name)
    if image.shape[::-1] != rig.image_size:
        raise InputError(f"{name}: has {in_px(image.shape[::-1])}, but the rig is for {in_px(rig.image_size)}")
    return image


def motion_between(
    before: StereoFeatures,
    after: StereoFeatures,
    settings: MotionSettings,
    rng: np.random.Generator,
    names: tuple[str, str],
) -> RelativeMotion:
    """:func:`relative_motion` from features of one rig that are there already; errors call the pairs by ``names``."""
    rig = before.rig
    rows = circular_matches(before, after, settings.ratio)
    uv0 = pixels(before)[rows[:, 0]]
    uv1 = pixels(after)[rows[:, 1]]
    near = usable(rig, uv0, settings.min_disparity) & usable(rig, uv1, settings.min_disparity)
    rows = rows[near]
    uv0 = uv0[near]
    uv1 = uv1[near]
    pair = f"{names[0]} to {names[1]}"
    if len(rows) < FEWEST:
        raise ConsensusError(
            f"{pair}: {len(rows)} matches through all four images, at least {FEWEST} are needed; do the pairs show the "
            "same scene, and is the left image the left one?"
        )
    sigma0 = pixel_deviations(before, settings.sigma_per_scale)[rows[:, 0]]
    sigma1 = pixel_deviations(after, settings.sigma_per_scale)[rows[:, 1]]
    try:
        estimate = estimate_motion(rig, uv0, uv1, sigma0, sigma1, settings, rng)
    except ConsensusError:
        raise ConsensusError(
            f"{pair}: too few of {len(rows)} matches through all four images agree on a motion; do "
            "the pairs show the same scene, one soon after the other, and is the left image the left one?"
        ) from None
    except InputError as error:
        raise type(error)(f"{pair}: {error}") from None
    if settings.estimator == "reprojection" and estimate.chi2 > MISFIT * estimate.dof:
        raise ConsensusError(
            f"{pair}: chi2/dof of the inliers is {estimate.chi2 / estimate.dof:.1f} where 1 is "
            "right; are the cameras swapped or badly calibrated, or is sigma_per_scale too small?"
        )
    return RelativeMotion(**vars(estimate), uv0=uv0, uv1=uv1, sigma0=sigma0, sigma1=sigma1, rows=rows)


def estimate_motion(
    rig: StereoRig,
    uv0: Array,
    uv1: Array,
    sigma0: Array,
    sigma1: Array,
    settings: MotionSettings,
    rng: np.random.Generator,
) -> MotionEstimate:
    """Pose and covariance of N matches, some of which may be wrong.

    What is an inlier is asked again of each refined pose; a match whose point the images do not fix is dropped.

    Parameters
    ----------
    uv0, uv1 : (N, 4), u, v, u', v' of the same points at time 0 and 1, px; all :func:`triangulable`
    sigma0, sigma1 : (N, 4), their standard deviations, px
    settings : of these ``gate`` and ``estimator``
    rng : the only source of chance

    Raises
    ------
    InputError
        OpenCV is not installed.
    ConsensusError, DegenerateError, ConvergenceError
        As :func:`relative_motion`.
    """
    pose, inliers = resect_ransac(rig, uv0, uv1, sigma0, sigma1, gate=settings.gate, rng=rng)
    S0 = diagonal_covariances(sigma0)
    S1 = diagonal_covariances(sigma1)
    if settings.estimator != "reprojection":
        return _registered(rig, uv0[inliers], uv1[inliers], S0[inliers], S1[inliers], settings.estimator, inliers)
    for _ in range(REFITS):
        refined, used = _refined(rig, uv0, uv1, S0, S1, pose, inliers)
        pose = refined.pose
        squared = squared_reprojections(rig, uv0, uv1, sigma0, sigma1, pose)
        inliers = inliers_within(squared, settings.gate, used)
        if (inliers == used).all():
            break
    return MotionEstimate(pose, refined.covariance, used, refined.chi2, refined.dof)


def _registered(
    rig: StereoRig,
    uv0: Array,
    uv1: Array,
    S0: Array,
    S1: Array,
    estimator: str,
    inliers: Array,
) -> MotionEstimate:
    """The registration of the triangulated inliers, and what far points bring of their variance."""
    before = triangulate(rig, uv0)
    after = triangulate(rig, uv1)
    C_before = triangulation_covariance(rig, uv0, S0)
    C_after = triangulation_covariance(rig, uv1, S1)
    register = register_svd
    if estimator == "horn":
        register = register_horn
    pose = register(before, after)
    far = np.sqrt(C_before[:, 2, 2]) > FIRST_ORDER * before[:, 2]
    variance = np.trace(C_before, axis1=1, axis2=2)
    return MotionEstimate(
        pose,
        covariance=registration_covariance(before, after, C_before, C_after, pose),
        inliers=inliers,
        chi2=float(squared_distances(before, after, pose.R, pose.t, C_before, C_after).sum()),
        dof=3 * len(before) - 6,
        far_share=float(variance[far].sum() / variance.sum()),
    )


def _refined(
    rig: StereoRig,
    uv0: Array,
    uv1: Array,
    S0: Array,
    S1: Array,
    pose: RelativePose,
    inliers: Array,
) -> tuple[Refined, Array]:
    """The refined pose of the inliers (N,) bool, and those that were used: all whose points the images fix."""
    used = inliers.copy()
    while True:
        try:
            refined = refine_reprojection(rig, uv0[used], uv1[used], pose, S0[used], S1[used], robust="cauchy")
            return refined, used
        except MatchError as error:
            if error.match is None or used.sum() <= FEWEST:
                raise
            used[np.flatnonzero(used)[error.match]] = False


def pixels(features: StereoFeatures) -> Array:
    """u, v left and right of the stereo matches, (M, 4), px."""
    left, right = features.pairs.T
    return np.column_stack([features.left.uv[left], features.right.uv[right]])


def pixel_deviations(features: StereoFeatures, sigma_per_scale: float) -> Array:
    """Standard deviations (M, 4) of :func:`pixels`, px: the SIFT scale, sec. 2.3.1, times a calibrated factor."""
    left, right = features.pairs.T
    scale = np.column_stack([features.left.scale[left], features.right.scale[right]])
    return sigma_per_scale * scale.repeat(2, axis=1)


def usable(rig: StereoRig, uv: Array, min_disparity: float) -> Array:
    """Matches (N, 4) in front of both cameras and nearer than the depth of ``min_disparity`` px, (N,) bool.

    The disparity itself counts as well: off the epipolar line least squares makes a near point of a small disparity.
    """
    good = triangulable(rig, uv)
    furthest = rig.f * rig.baseline / min_disparity
    good[good] = triangulate(rig, uv[good])[:, 2] <= furthest
    good[good] = disparities(rig, uv[good]) >= min_disparity * (1.0 - ROUNDING)
    return good


def disparities(rig: StereoRig, uv: Array) -> Array:
    """Disparities (N,) of matches (N, 4) in cameras that are turned to have the baseline as their x axis, px.

    The focal length is that of the left camera; in rectified images they are the differences of the columns.
    """
    x = rig.t / rig.baseline
    y = np.cross([0.0, 0.0, 1.0], x)
    y /= np.linalg.norm(y)
    turn = np.stack([x, y, np.cross(x, y)])
    x_left, _, z_left = turn @ np.linalg.inv(rig.K_left) @ homogeneous(uv[:, :2]).T
    x_right, _, z_right = turn @ rig.R @ np.linalg.inv(rig.K_right) @ homogeneous(uv[:, 2:]).T
    return rig.f * (x_left / z_left - x_right / z_right)


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
    draw = partial(draw_triples, rng, ROUND, len(uv0))
    found, inliers = _search(rig, triangulate(rig, uv0), uv1, variance, gate, draw)
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
        if inliers.sum() >= ENOUGH:
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
    draw: Callable[[], Indices],
) -> tuple[RelativePose | None, Array]:
    """The pose of the least cost of adaptively many draws, None where no triple gave one, and its inliers (N,)."""
    least = np.inf
    best = None
    inliers = np.zeros(len(p0), bool)
    draws = 0
    needed: float = MOST
    while draws < needed:
        R, t = _poses_of(rig.K_left, p0, uv1, draw())
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
    K: Array,
    p0: Array,
    uv1: Array,
    triples: Indices,
) -> tuple[Array, Array]:
    """R (k, 3, 3) and t (k, 3) of p0 = R p1 + t, up to four for each triple (n, 3), seen by a camera K (3, 3)."""
    cv2 = opencv()
    R = []
    t = []
    for triple in triples:
        _, turns, shifts = cv2.solveP3P(
            p0[triple], np.ascontiguousarray(uv1[triple, :2]), K, None, flags=cv2.SOLVEPNP_AP3P
        )
        for turn, shift in zip(turns or (), shifts or (), strict=True):
            back = cv2.Rodrigues(turn)[0].T
            if np.isfinite(back).all() and np.isfinite(shift).all():
                R.append(back)
                t.append(-(back @ shift).ravel())
    return np.array(R), np.array(t)
