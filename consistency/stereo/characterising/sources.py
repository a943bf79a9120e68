"""What is characterised: a log, stereo pairs in the order of time or of a chessboard; what each lets be estimated."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from consistency.bench.scenario import Mount, PicturedSensor, read_table
from consistency.bench.store.recorded_log import Log, SensorFile, read_log, table_file
from consistency.bench.types import Trial
from consistency.referee.errors import InputError
from consistency.referee.geometry import rotation
from consistency.referee.types import Array
from consistency.stereo.characterising.boards import characterise_board
from consistency.stereo.characterising.characterise import (
    GRID,
    Characterisation,
    characterise,
    moved_before,
    residuals_of,
    robust_sd,
)
from consistency.stereo.characterising.point_fit import SHORTEST, Sightings, characterise_posed
from consistency.stereo.frontend.camera_truth import find_truth, read_truth, tum_poses
from consistency.stereo.frontend.images_to_log import CAMERA, observations
from consistency.stereo.visual_odometry.odometry import visual_odometry
from consistency.stereo.visual_odometry.relative_motion import RelativeMotion
from consistency.stereo.visual_odometry.rig import StereoRig
from consistency.stereo.visual_odometry.sequence import StereoSequence, read_sequence
from consistency.stereo.visual_odometry.tracks import PIXELS

WIDEST = 10.0  # m, of a square of a board; more are millimetres
NODES, CORNERS = 2, 3  # least numbers across and down, of nodes of a bias map and of corners
OTHERS = ("motion", "start", "sigma_points")  # tables that a measured sensor keeps from the log
EXACT = "Poses are taken as exact: their errors are in sigma."
FREE = "The pose of each step is fitted, six values each: what moves all points together is not noise."
PLANE = "The truth is on a plane: what the sensor rolls, pitches and heaves is in sigma."
SPACE = "truth.tum"  # of a log from images: true poses of the left camera in space
REST = "Only the parts at rest are used: noise while moving may be larger."
CHOSEN = (
    "Tracks are matches on which a motion could be agreed: RANSAC's gate cuts off the largest errors before they are "
    "counted."
)


@dataclass(frozen=True)
class SourceOptions:
    """What is known of a source beside its files."""

    grid: tuple[int, int] | None = None
    at_rest: bool = False
    free_poses: bool = False
    calibration: Path | None = None
    truth: Path | None = None
    format: str | None = None
    left: str | None = None
    right: str | None = None
    board: tuple[int, int] | None = None  # inner corners across and down
    square: float | None = None  # m
    distortion: str | None = None
    seed: int | None = None

    def of_images(self) -> list[str]:
        """Options that are given and mean nothing for a log."""
        both = ("grid", "at_rest", "free_poses")
        return [f"--{name}" for name, value in vars(self).items() if name not in both and value is not None]


class MeasuredSensor(NamedTuple):
    """A characterisation and what of the source's file stays as it was."""

    of: Characterisation
    others: Mapping[str, Any]  # tables of sensor.toml beside the sensor itself


def characterise_source(source: Path, options: SourceOptions) -> MeasuredSensor:
    """The sensor of a log folder or of a folder of images.

    Raises
    ------
    InputError
        Options that do not go together or with the source, and whatever the source lacks.
    """
    if not source.is_dir():
        raise InputError(f"{source}: no such folder; give a log, or a folder of stereo pairs")
    if is_log(source):
        if given := options.of_images():
            raise InputError(f"{given[0]}: goes with images, but {source} is a log")
        return characterise_log(source, options.grid or GRID, options.at_rest, options.free_poses)
    if (options.board is None) != (options.square is None):
        raise InputError(
            "--board and --square go together: without the size of its squares, the depth of a plane is not known, and "
            "so not what its disparities should be"
        )
    if options.board is None or options.square is None:
        if options.distortion is not None:
            raise InputError("--distortion: goes with --board; other images bring their calibration")
        if options.grid is not None:
            raise InputError("--grid: goes with a log or with --board; images of an unknown scene give no bias map")
        return MeasuredSensor(characterise_images(source, options), {})
    if not 0.0 < options.square < WIDEST:
        raise InputError(f"--square {options.square:g}: must be a positive number of metres, below {WIDEST:g}")
    if options.seed is not None:
        raise InputError("--seed: goes with images without a board; nothing is drawn at random from one")
    if options.at_rest or options.truth is not None:
        raise InputError("--board: goes neither with --at-rest nor with --truth; the poses of the board are fitted")
    model = options.distortion or "full"
    return MeasuredSensor(characterise_board(source, options.board, options.square, model, options.grid or GRID), {})


def parse_counts(text: str, option: str, least: int) -> tuple[int, int]:
    """Two counts of ``KxL``.

    Raises
    ------
    InputError
        ``text`` is something else, or one of them is below ``least``.
    """
    one, cross, two = text.lower().partition("x")
    are_numbers = one.isdecimal() and two.isdecimal()
    if not cross or not are_numbers or min(int(one), int(two)) < least:
        raise InputError(f"{option} {text}: must be two numbers of at least {least}, as 9x6")
    return int(one), int(two)


def is_log(folder: Path) -> bool:
    """Whether a folder is a recorded log, and not one of images."""
    return any(table_file(folder, name).exists() for name in ("observations", "controls"))


def characterise_log(
    folder: Path,
    grid: tuple[int, int],
    at_rest: bool = False,
    free_poses: bool = False,
) -> MeasuredSensor:
    """The sensor of a log folder.

    With true poses and landmarks everything is estimated; with true poses alone no bias map and no offsets; without
    truth only the noise of a sensor at rest. ``at_rest`` says that it stood still all the time.

    Raises
    ------
    InputError
        As :func:`consistency.store.read_log`; the sensor measures no disparity; too few data; no truth, and the
        sensor moves all the time.
    """
    log = read_log(folder)
    file = read_table(folder / "sensor.toml", SensorFile)
    if file.model != "uvd":
        raise InputError(f"{folder}/sensor.toml: key 'model' is '{file.model}'; only a sensor 'uvd' is characterised")
    sensor = PicturedSensor.model_validate(file.model_dump(include=set(PicturedSensor.model_fields)))
    dumped = file.model_dump(exclude_none=True)
    others: dict[str, Any] = {key: value for key, value in dumped.items() if key in OTHERS}
    return MeasuredSensor(_of_log(log, sensor, str(folder), grid, at_rest, free_poses), others)


def _of_log(
    log: Log,
    sensor: PicturedSensor,
    source: str,
    grid: tuple[int, int],
    at_rest: bool,
    free_poses: bool,
) -> Characterisation:
    trials = log.trials
    poses = all(trial.truth is not None for trial in trials)
    landmarks = all(trial.landmarks is not None for trial in trials)
    if poses and landmarks and not at_rest and not free_poses:
        data, strange = residuals_of(trials, sensor)
        return characterise(data, sensor, source, strange, grid)
    space = Path(source) / SPACE
    if not at_rest and len(trials) == 1 and space.is_file():
        note = EXACT
        if free_poses:
            note = FREE
        return characterise_posed(_in_space(trials[0], space), sensor, source, (note,), free_poses)
    if free_poses:
        raise InputError(f"{source}: --free-poses begins with poses in space, and there is no {SPACE} of one run")
    if poses and not at_rest:
        return characterise_posed(seen_of(trials, sensor.mount), sensor, source, (EXACT, PLANE))
    rests = [_rests(trial, at_rest) for trial in trials]
    seen = seen_of(trials, sensor.mount, rests)
    if len(seen.long_enough().z) == 0:
        raise InputError(
            f"{source}: has no truth.parquet and no landmark seen {SHORTEST} times at rest: while the robot moves, "
            "noise cannot be told from motion; add true poses (noise, growth, tails), true poses and landmarks.parquet "
            "(bias map and offsets too), or record some time at rest (noise at rest; --at-rest if it never moved)"
        )
    return characterise_posed(seen, sensor, source, (REST,))


def seen_of(trials: Sequence[Trial], mount: Mount, rests: Sequence[Array] | None = None) -> Sightings:
    """What is seen from true poses, or with ``rests`` (T,) of numbers of rests, in each of these from one pose.

    A landmark is a track of its own in each run, and in each rest; steps between rests have the number -1.
    """
    parts = []
    tracks = 0
    for number, trial in enumerate(trials):
        rest = np.zeros(trial.steps, np.int64)
        pose = np.zeros((trial.steps + 1, 3))
        if rests is not None:
            rest = rests[number]
        elif trial.truth is not None:
            pose = trial.truth
        rest_of_row = rest[trial.step - 1]
        track = trial.landmark + trial.n_landmarks * rest_of_row
        order = np.lexsort((trial.step, track))
        order = order[rest_of_row[order] >= 0]
        step = trial.step[order]
        # the sensor in the world, (T + 1, 3, 3) and (T + 1, 3), from poses on the plane
        turns = Rotation.from_euler("z", pose[:, 2:]).as_matrix()
        place = np.pad(pose[:, :2], ((0, 0), (0, 1)))
        R = turns @ rotation(*mount.rotation)
        t = place + turns @ np.array(mount.position)
        moving = moved_before(pose)
        parts.append((trial.z[order], R[step], t[step], tracks + track[order], step, moving[step]))
        tracks += trial.n_landmarks * (int(rest.max()) + 1)
    return Sightings(*map(np.concatenate, zip(*parts, strict=True)))


def _in_space(trial: Trial, path: Path) -> Sightings:
    """What is seen from the true poses of the left camera in a file of TUM's form, a line for each of steps 0..T."""
    _, R, t = tum_poses(path)
    if len(t) != trial.steps + 1:
        raise InputError(f"{path}: {len(t)} poses for steps 0 to {trial.steps}; must hold one for each")
    R = R @ CAMERA
    order = np.lexsort((trial.step, trial.landmark))
    step = trial.step[order]
    moving = np.ones(len(step), bool)
    return Sightings(trial.z[order], R[step], t[step], trial.landmark[order], step, moving)


def _rests(trial: Trial, always: bool) -> Array:
    """Number of the rest of each step (T,), -1 while the controls say that the robot moves."""
    if always:
        return np.zeros(trial.steps, np.int64)
    still = (trial.controls[:, 1:] == 0.0).all(axis=1)
    begins = still & ~np.append(False, still[:-1])
    return np.where(still, np.cumsum(begins) - 1, -1)


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
    rows = observations(rig, motions)
    rows = rows[rows["z2"] > 0]
    step = rows["step"].to_numpy(np.int64)
    track = rows["piece"].to_numpy(np.int64)
    moving = np.full(len(step), np.ptp(t, axis=0).any())
    seen = Sightings(rows[PIXELS].to_numpy(float), (R @ CAMERA)[step], t[step], track, step, moving)
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


def rows_note(rig: StereoRig, motions: list[RelativeMotion]) -> str:
    """A note on the rows of matches, which should be equal in both images."""
    pixels = np.concatenate([m.uv1[m.inliers] for m in motions])
    _, v_left, _, v_right = pixels.T
    gap = v_left - v_right - (rig.K_left[1, 2] - rig.K_right[1, 2])
    return (
        f"v_left - v_right of {len(gap)} matches: mean {gap.mean():+.3f} px, an error of the rectification; robust sd "
        f"{robust_sd(gap):.3f} px."
    )
