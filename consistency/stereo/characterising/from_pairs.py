"""Stereo pairs in the order of time to a characterisation: at rest, or with true poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from consistency.bench.scenario import PicturedSensor
from consistency.referee.errors import InputError
from consistency.referee.types import Array
from consistency.stereo.characterising.characterise import Characterisation
from consistency.stereo.characterising.fitted_tracks import characterise_posed
from consistency.stereo.characterising.from_log import EXACT, FREE, REST, SourceOptions
from consistency.stereo.characterising.point_fit import SHORTEST, Sightings
from consistency.stereo.characterising.truth_residuals import robust_sd
from consistency.stereo.frontend.camera_truth import find_truth, read_truth
from consistency.stereo.frontend.planar_log import CAMERA, observations
from consistency.stereo.visual_odometry.cameras.rig import StereoRig
from consistency.stereo.visual_odometry.odometry import visual_odometry
from consistency.stereo.visual_odometry.relative_motion import RelativeMotion
from consistency.stereo.visual_odometry.sequence import StereoSequence, read_sequence
from consistency.stereo.visual_odometry.tracks import PIXELS

CHOSEN = (
    "Tracks are matches on which a motion could be agreed: RANSAC's gate cuts off the largest errors before they are "
    "counted."
)


def characterise_images(folder: Path, options: SourceOptions) -> Characterisation:
    """The noise of the features of a folder of stereo pairs.

    Raises
    ------
    InputError
        As :func:`consistency.vision.read_sequence`; too few pairs; neither at rest nor with true poses.
    """
    sequence = read_sequence(folder, options.calibration, options.format, options.left, options.right)
    rig = sequence.uvd_rig
    if len(sequence) < SHORTEST:
        raise InputError(f"{folder}: holds {len(sequence)} stereo pairs; a noise takes at least {SHORTEST}")
    R, t = _poses(sequence, options)
    motions = visual_odometry(sequence, rng=np.random.default_rng(options.seed or 0))
    seen = _seen(rig, motions, R, t)
    notes = []
    if options.at_rest:
        notes.append(REST)
    free = options.free_poses or options.at_rest
    if free:
        notes.append(FREE)
    else:
        notes.append(EXACT)
    notes += [CHOSEN, rows_note(rig, motions)]
    return characterise_posed(seen, uncalibrated_noise_sensor(rig), str(folder), tuple(notes), free)


def _poses(sequence: StereoSequence, options: SourceOptions) -> tuple[Array, Array]:
    """Poses (n, 3, 3), (n, 3) of the left camera; equal poses at rest."""
    if options.at_rest:
        n = len(sequence)
        return np.broadcast_to(np.eye(3), (n, 3, 3)), np.zeros((n, 3))
    path = options.truth or find_truth(sequence)
    if path is None:
        raise InputError(
            f"{sequence.folder}: no true poses; while a camera moves, noise cannot be told from motion: give --truth "
            "FILE, or --at-rest if it stood still, or --board and --square if it looks at a chessboard"
        )
    return read_truth(path, sequence)


def uncalibrated_noise_sensor(rig: StereoRig) -> PicturedSensor:
    """A sensor of which only the calibration is known; its noise is a placeholder."""
    return PicturedSensor(
        model="uvd",
        sigma=(1.0, 1.0, 1.0),
        f=rig.f,
        B=rig.baseline,
        image=rig.image_size,
        principal_point=rig.principal_point,
    )


def _seen(
    rig: StereoRig,
    motions: list[RelativeMotion],
    R: Array,
    t: Array,
) -> Sightings:
    rows = observations(rig, motions)
    rows = rows[rows["z2"] > 0]
    step = rows["step"].to_numpy(np.int64)
    track = rows["piece"].to_numpy(np.int64)
    moving = np.full(len(step), np.ptp(t, axis=0).any())
    return Sightings(rows[PIXELS].to_numpy(float), (R @ CAMERA)[step], t[step], track, step, moving)


def rows_note(rig: StereoRig, motions: list[RelativeMotion]) -> str:
    """A note on the rows of matches, which should be equal in both images."""
    pixels = np.concatenate([m.uv1[m.inliers] for m in motions])
    _, v_left, _, v_right = pixels.T
    gap = v_left - v_right - (rig.K_left[1, 2] - rig.K_right[1, 2])
    return (
        f"v_left - v_right of {len(gap)} matches: mean {gap.mean():+.3f} px, an error of the rectification; robust sd "
        f"{robust_sd(gap):.3f} px."
    )
