"""Visual odometry: the relative motions of a sequence, and the trajectory that they make up, with covariance.

Motions that the images do not tell are bridged from the motions around them.

The motions of a drive share some errors: of the calibration of the rig, of the mounting and the clock of the truth.
Pixel noise is independent from match to match; these are not, and no number of matches averages them out.
``referee.diagnostics.uncertain_truth`` fits them to a part of a drive, with a prior as wide as calibrations
usually are, and predicts them for another.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from consistency.referee.diagnostics import uncertain_truth
from consistency.referee.diagnostics.uncertain_truth import SharedError
from consistency.referee.errors import InputError
from consistency.referee.geometry import propagated
from consistency.referee.system import progress
from consistency.referee.types import Array, Indices
from consistency.stereo.visual_odometry.maximum_likelihood import refine_reprojection
from consistency.stereo.visual_odometry.relative_motion import (
    MotionSettings,
    RelativeMotion,
    diagonal_covariances,
    motion_between,
    stereo_features,
)
from consistency.stereo.visual_odometry.relative_pose import RelativePose, angular, cross_matrix
from consistency.stereo.visual_odometry.rig import StereoRig
from consistency.stereo.visual_odometry.sequence import StereoSequence

FULL, FEWEST = 12, 3  # motions beside which a bridge was tried, for a covariance (6, 6), and for variances alone
MOST = 0.5  # of the motions may be missing
# What is shared, and the standard deviation of its prior
SHARED = {
    "focal length": 0.005,  # relative
    "cx": 3.0,  # px
    "cy": 3.0,
    "baseline": 0.005,  # relative
    "roll of the right camera": 0.005,  # rad, about x: rows of the right image
    "pitch of the right camera": 0.002,  # about y: disparities
    "yaw of the right camera": 0.005,  # about z
    "mounting about x": 0.02,  # rad, of the camera in the body that the truth is of
    "mounting about y": 0.02,
    "mounting about z": 0.02,
    "clock of the truth": 0.05,  # s
}
RIG = 7  # of these are the rig's
STEP = 1e-2  # of a prior standard deviation, for derivatives


def visual_odometry(
    sequence: StereoSequence, *, rng: np.random.Generator, settings: MotionSettings | None = None
) -> list[RelativeMotion]:
    """The motion from each stereo pair to the next, one less than pairs; features are found once a pair.

    A motion that cannot be measured is a bridge between its neighbours, with the reason as its ``fault``; see
    :func:`bridged`.

    Raises
    ------
    InputError
        An image that cannot be read; too few motions could be measured.
    """
    settings = settings or MotionSettings()
    rig = sequence.rectification.rig
    motions = list[RelativeMotion | InputError]()
    with progress(sequence.folder.name, len(sequence), "stereo pairs") as advance:
        before = None
        names = ("", "")
        for frame, path in enumerate(sequence.left):
            names = (names[1], path.name)
            after = stereo_features(rig, *sequence.pair(frame), settings, path.name)
            if before is not None:
                try:
                    motions.append(motion_between(before, after, settings, rng, names))
                except InputError as fault:
                    motions.append(fault)
            before = after
            advance(1)
    return bridged(motions, sequence.t)


def trajectory(motions: Sequence[RelativeMotion]) -> tuple[Array, Array, Array]:
    """Poses of the left camera in its first frame, and covariances to first order.

    The errors of the motions are taken as independent. Two in a row share the pixels of a frame, with opposite signs:
    for noise of the pixels that overstates the covariance; what is common to all motions, such as an error of the
    calibration, is not in it at all.

    Returns
    -------
    R : (T + 1, 3, 3)
    t : (T + 1, 3), m
    P : (T + 1, 6, 6), of the position and of the rotation vector of R_true R' about the first frame's axes (error
        convention so3 of ``consistency.referee.geometry``), m and rad; 0 for the first pose. Rotation
        vectors have no gimbal lock, which Euler angles in camera axes have where a car turns by 90 degrees.
    """
    R = [np.eye(3)]
    t = [np.zeros(3)]
    P = [np.zeros((6, 6))]
    for motion in motions:
        # p + R dt and R dR, with errors dp + dtheta x (R dt) + R d(dt) and dtheta + R d(phi)
        arm = R[-1] @ motion.pose.t
        F = np.eye(6)
        F[:3, 3:] = -cross_matrix(arm)
        G = np.zeros((6, 6))
        G[:3, :3] = R[-1]
        G[3:, 3:] = R[-1] @ angular(motion.pose)
        P.append(propagated(F, P[-1]) + propagated(G, motion.covariance))
        t.append(t[-1] + arm)
        U, _, Vt = np.linalg.svd(R[-1] @ motion.pose.R)
        R.append(U @ Vt)
    return np.array(R), np.array(t), np.array(P)


def motion_covariances(motions: Sequence[RelativeMotion]) -> Array:
    """Covariances (T, 6, 6) of the motions, of position and rotation vector in the frame that each begins in.

    Error convention so3 of ``consistency.referee.geometry``, m and rad.
    """
    G = np.zeros((len(motions), 6, 6))
    G[:, :3, :3] = np.eye(3)
    G[:, 3:, 3:] = [angular(motion.pose) for motion in motions]
    return propagated(G, np.array([motion.covariance for motion in motions]))


def bridged(found: Sequence[RelativeMotion | InputError], t: Array) -> list[RelativeMotion]:
    """All motions of a sequence, where those that could not be measured keep to their neighbours' velocity.

    Between two measured motions the six numbers of the pose are interpolated, before the first and after the last one
    held. The covariance is what the same rule misses by, on average, where the motion was measured.

    Parameters
    ----------
    found : T motions, or why there is none
    t : (T + 1,), s

    Returns
    -------
    T motions; a bridge has no matches, and the reason as its ``fault``

    Raises
    ------
    InputError
        More than half of the motions are missing, or too few are left to tell how well a bridge holds.
    """
    motions: list[RelativeMotion] = []
    faults: dict[int, InputError] = {}
    for k, each in enumerate(found):
        if isinstance(each, InputError):
            faults[k] = each
        else:
            motions.append(each)
    if not faults:
        return motions
    first = next(iter(faults.values()))
    if len(found) == 1:
        raise first
    if len(faults) > MOST * len(found):
        raise type(first)(f"{len(faults)} of {len(found)} motions could not be measured; the first: {first}")
    good = np.ones(len(found), bool)
    good[list(faults)] = False
    dt = np.diff(t)
    speed = np.full((len(found), 6), np.nan)  # of the numbers of the pose
    speed[good] = np.array([motion.pose.vector for motion in motions]) / dt[good, None]
    for k, fault in faults.items():
        around, share = neighbours(good, t, k)
        missed = _missed(speed, around - k, share)
        if len(missed) < FEWEST:
            raise type(fault)(f"{fault} (too few motions around it were measured to bridge it)")
        P = missed.T @ missed / len(missed)
        if len(missed) < FULL:
            P = np.diag(np.diag(P))
        pose = RelativePose.from_vector(dt[k] * (share @ speed[around]))
        motions.insert(k, _bridge(pose, dt[k] ** 2 * P, str(fault)))
    return motions


def _bridge(pose: RelativePose, covariance: Array, fault: str) -> RelativeMotion:
    """A motion without matches."""
    none = np.empty((0, 4))
    return RelativeMotion(
        pose,
        covariance,
        inliers=np.empty(0, bool),
        chi2=0.0,
        dof=0,
        uv0=none,
        uv1=none,
        sigma0=none,
        sigma1=none,
        rows=np.empty((0, 2), np.int64),
        fault=fault,
    )


def neighbours(good: Array, t: Array, k: int) -> tuple[Indices, Array]:
    """The measured motions, ``good`` (T,), next to motion k at t (T + 1,), and the share of each in its velocity."""
    at = np.flatnonzero(good)
    i = int(np.searchsorted(at, k))
    around = at[max(i - 1, 0) : i + 1]
    if len(around) == 1:
        return around, np.ones(1)
    middle = 0.5 * (t[1:] + t[:-1])
    before, after = middle[around]
    share = (middle[k] - before) / (after - before)
    return around, np.array([1.0 - share, share])


def _missed(speed: Array, offsets: Indices, share: Array) -> Array:
    """By how much a measured velocity differs from that of the motions at ``offsets`` from it, (n, 6)."""
    T = len(speed)
    first = max(0, -offsets.min())
    last = min(T, T - offsets.max())
    at = np.arange(first, last)
    expected = np.zeros((len(at), 6))
    for part, offset in zip(share, offsets, strict=True):
        expected += part * speed[at + offset]
    missed = speed[at] - expected
    return missed[np.isfinite(missed).all(axis=1)]


def sensitivities(rig: StereoRig, motions: Sequence[RelativeMotion], t: Array) -> Array:
    """Derivative (n, 6, 11) of each motion's error by what is shared.

    An error is the difference of the translations (m) and the rotation vector of R R_true' (rad), in the first camera's
    axes. For the rig's parameters the refinement of the inliers is repeated with another rig. A bridge errs by the rig
    as the motions do that it is interpolated from.

    Parameters
    ----------
    t : (n + 1,), s, of the stereo pairs

    Raises
    ------
    InputError
        Every motion is a bridge, or the refinement with another rig fails.
    """
    measured = np.array([not motion.fault for motion in motions], bool)
    if not measured.any():
        raise InputError("motions: all are bridges, and have no matches that could tell")
    dt = np.diff(t)
    turns = Rotation.from_matrix([motion.pose.R for motion in motions]).as_rotvec()
    speed = np.column_stack([[motion.pose.t for motion in motions], turns]) / dt[:, None]
    rate = np.zeros_like(speed)
    if len(motions) > 1:
        middle = 0.5 * (t[1:] + t[:-1])
        rate = np.gradient(speed, middle, axis=0)
    J = np.empty((len(motions), 6, len(SHARED)))
    for k, motion in enumerate(motions):
        J[k, :3, RIG:-1] = cross_matrix(motion.pose.t)
        J[k, 3:, RIG:-1] = motion.pose.R - np.eye(3)
        J[k, :, -1] = rate[k] * dt[k]
        if measured[k]:
            J[k, :, :RIG] = _by_rig(rig, motion)
    for k in np.flatnonzero(~measured).tolist():
        around, share = neighbours(measured, t, k)
        weights = dt[k] * share / dt[around]
        J[k, :, :RIG] = np.tensordot(weights, J[around, :, :RIG], axes=1)
    return J


def fit_shared(errors: Array, J: Array, S: Array) -> SharedError:
    """Shared errors and floor of highest likelihood (``uncertain_truth.fit_shared_error``).

    Parameters
    ----------
    errors : (n, 6), against truth
    J : (n, 6, 11), of :func:`sensitivities`
    S : (n, 6, 6), propagated from the noise of the pixels

    Raises
    ------
    InputError
        Fewer than 12 motions, or shapes that do not fit.
    """
    return uncertain_truth.fit_shared_error(errors, J, S, np.array(list(SHARED.values())))


def _by_rig(rig: StereoRig, motion: RelativeMotion) -> Array:
    """Derivative (6, 7) of the refined pose, by central differences."""
    i = motion.inliers
    S0 = diagonal_covariances(motion.sigma0[i])
    S1 = diagonal_covariances(motion.sigma1[i])

    def refined(change: Array) -> RelativePose:
        other = perturbed(rig, change)
        return refine_reprojection(other, motion.uv0[i], motion.uv1[i], motion.pose, S0, S1, robust="cauchy").pose

    J = np.empty((6, RIG))
    for k, prior in enumerate(list(SHARED.values())[:RIG]):
        step = STEP * prior
        up = refined(step * np.eye(RIG)[k])
        down = refined(-step * np.eye(RIG)[k])
        J[:3, k] = (up.t - down.t) / (2.0 * step)
        turn = Rotation.from_matrix(up.R @ down.R.T).as_rotvec()
        J[3:, k] = turn / (2.0 * step)
    return J


def perturbed(rig: StereoRig, change: Array) -> StereoRig:
    """The rig with other parameters: ``change`` (7,) in the order and units of :data:`SHARED`."""
    f, cx, cy, baseline = change[:4]
    turn = Rotation.from_rotvec(change[4:]).as_matrix()
    K_left = _other_lens(rig.K_left, f, cx, cy)
    K_right = _other_lens(rig.K_right, f, cx, cy)
    return StereoRig(K_left, K_right, rig.R @ turn, (1.0 + baseline) * rig.t, rig.image_size)


def _other_lens(K: Array, f: float, cx: float, cy: float) -> Array:
    """K (3, 3) with a focal length that is larger by the share ``f``, and the principal point moved, px."""
    lens = K.copy()
    lens[:2, :2] *= 1.0 + f
    lens[:2, 2] += cx, cy
    return lens
