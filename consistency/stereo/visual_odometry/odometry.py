"""Visual odometry: the relative motions of a sequence, and the trajectory that they make up, with covariance."""

from __future__ import annotations

from collections.abc import Sequence as Ordered

import numpy as np

from consistency.referee.errors import InputError
from consistency.referee.geometry.groups import carried
from consistency.referee.system.progress import progress
from consistency.referee.types import Array
from consistency.stereo.visual_odometry.bridging import bridged
from consistency.stereo.visual_odometry.motion import MotionSettings, RelativeMotion, motion_between, stereo_features
from consistency.stereo.visual_odometry.pose import angular, cross_matrix
from consistency.stereo.visual_odometry.sequence import Sequence


def visual_odometry(
    sequence: Sequence, *, rng: np.random.Generator, settings: MotionSettings | None = None
) -> list[RelativeMotion]:
    """The motion from each stereo pair to the next, one less than pairs; features are found once a pair.

    A motion that cannot be measured is a bridge between its neighbours, with the reason as its ``fault``; see
    :func:`consistency.stereo.visual_odometry.bridging.bridged`.

    Raises
    ------
    InputError
        An image that cannot be read; too few motions could be measured.
    """
    rig, motions = sequence.rectification.rig, list[RelativeMotion | InputError]()
    with progress(sequence.folder.name, len(sequence), "stereo pairs") as advance:
        before = None
        for frame in range(len(sequence)):
            name = sequence.left[frame].name
            after = stereo_features(rig, *sequence.pair(frame), settings=settings, name=name)
            if before is not None:
                names = (sequence.left[frame - 1].name, name)
                try:
                    motions.append(motion_between(rig, before, after, rng=rng, settings=settings, names=names))
                except InputError as fault:
                    motions.append(fault)
            before = after
            advance(1)
    return bridged(motions, sequence.t)


def trajectory(motions: Ordered[RelativeMotion]) -> tuple[Array, Array, Array]:
    """Poses of the left camera in its first frame, and covariances to first order.

    The errors of the motions are taken as independent. Two in a row share the pixels of a frame, with opposite signs:
    for noise of the pixels that overstates the covariance; what is common to all motions, such as an error of the
    calibration, is not in it at all.

    Returns
    -------
    R : (T + 1, 3, 3)
    t : (T + 1, 3), m
    P : (T + 1, 6, 6), of the position and of the rotation vector of R_true R' about the first frame's axes (error
        convention so3 of :mod:`consistency.referee.geometry.conventions`), m and rad; 0 for the first pose. Rotation
        vectors have no gimbal lock, which Euler angles in camera axes have where a car turns by 90 degrees.
    """
    R, t, P = [np.eye(3)], [np.zeros(3)], [np.zeros((6, 6))]
    for motion in motions:
        # p + R dt and R dR, with errors dp + dtheta x (R dt) + R d(dt) and dtheta + R d(phi)
        arm = R[-1] @ motion.pose.t
        F, G = np.eye(6), np.zeros((6, 6))
        F[:3, 3:] = -cross_matrix(arm)
        G[:3, :3], G[3:, 3:] = R[-1], R[-1] @ angular(motion.pose)
        grown = F @ P[-1] @ F.T + G @ motion.covariance @ G.T
        P.append(0.5 * (grown + grown.T))
        t.append(t[-1] + arm)
        U, _, Vt = np.linalg.svd(R[-1] @ motion.pose.R)
        R.append(U @ Vt)
    return np.array(R), np.array(t), np.array(P)


def motion_covariances(motions: Ordered[RelativeMotion]) -> Array:
    """Covariances (T, 6, 6) of the motions, of position and rotation vector in the frame that each begins in.

    Error convention so3 of :mod:`consistency.referee.geometry.conventions`, m and rad.
    """
    G = np.zeros((len(motions), 6, 6))
    G[:, :3, :3] = np.eye(3)
    G[:, 3:, 3:] = [angular(motion.pose) for motion in motions]
    return carried(G, np.array([motion.covariance for motion in motions]))
