"""Errors that the motions of a drive share: calibration of the rig, mounting and clock of the truth.

Pixel noise is independent from match to match; these are not, and no number of matches averages them out.
``referee.diagnostics.imperfect_truth.shared_errors`` fits them to a part of a drive, with a prior as wide as
calibrations usually are, and predicts them for another.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy.spatial.transform import Rotation

from consistency.referee.diagnostics import uncertain_truth
from consistency.referee.diagnostics.uncertain_truth import SharedError as SharedError
from consistency.referee.errors import InputError
from consistency.referee.types import Array
from consistency.stereo.visual_odometry.maximum_likelihood import refine_reprojection
from consistency.stereo.visual_odometry.odometry import neighbours
from consistency.stereo.visual_odometry.relative_motion import RelativeMotion
from consistency.stereo.visual_odometry.relative_pose import RelativePose, cross_matrix
from consistency.stereo.visual_odometry.resection import diagonal_covariances
from consistency.stereo.visual_odometry.rig import StereoRig

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
    speed = np.array([_twist(motion.pose) for motion in motions]) / dt[:, None]
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
    """Shared errors and floor of highest likelihood (:func:`shared_errors.fit_shared`).

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


def _twist(pose: RelativePose) -> Array:
    return np.concatenate([pose.t, Rotation.from_matrix(pose.R).as_rotvec()])


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
