"""Stereo tracks of a KITTI drive (course ECE276A) as a planar log; why each step is there: docs/reference/recorded.md.

Only :func:`planar_truth` reads the ground truth: controls, observations and where a track is cut come from the
recording alone. Pixels are (u, v, d): right of the principal point, below it, left minus right column.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from consistency.bench.scenario import Belief, BelievedMotion, BelievedSensor, Mount
from consistency.bench.types import Trial
from consistency.referee.errors import InputError
from consistency.referee.geometry import rotation
from consistency.referee.parsing import reading
from consistency.referee.types import Array
from consistency.stereo.frontend.images_to_log import CAMERA
from consistency.stereo.visual_odometry import tracks
from consistency.stereo.visual_odometry.sequence import read_number_table
from consistency.stereo.visual_odometry.tracks import PIXELS, screened

SIGMA_V, SIGMA_OMEGA = 0.5, 0.05  # m/s, rad/s: white noise that the course added to the velocities
SIGMA_PX = (1.0, 3.3, 0.7)  # rms of u, v, d against the planar truth; v carries pitch and roll
MAX_AGE = 12  # observations of a landmark: beyond, drift exceeds 1 px rms
MIN_LIFE = 2  # observations: fewer tell a filter nothing
MIN_DISPARITY = 8.0  # px, 47 m: sigma_d / d below 9 %
GATE_PX = np.array([2.0, 2.0, 1.0])  # misfit in u, v, d from frame to frame where a landmark restarts
SLOTS = 4  # landmarks seen at once
BANDS = 3  # image columns that the slots are spread over
SIZES = {  # px, rectified images by their focal length in px: calib_cam_to_cam.txt of the five days of KITTI raw
    721.5377: (1242, 375), 707.0493: (1224, 370), 718.3351: (1238, 374), 707.0912: (1226, 370), 718.8560: (1241, 376),
}  # fmt: skip


@dataclass(frozen=True)
class Recording:
    """The two files, checked; T + 1 frames with truth."""

    features: Array  # (4, tracks, T + 1): u, v left, u, v right in px, -1 where not seen
    stamps: Array  # (T + 1,), s
    velocity: Array  # (3, T + 1), m/s, robot frame
    turn_rate: Array  # (3, T + 1), rad/s, robot frame
    f: float  # px
    centre: Array  # (2,), px
    B: float  # m
    axes: Array  # (3, 3), KITTI camera axes <- robot axes
    lever: Array  # (3,), camera in the robot frame, m
    poses: Array  # (T + 1, 3, 4), camera k -> camera 0, KITTI axes
    size: tuple[int, int]  # width and height of the image, px


def find_recording(at: Path, truth: Path | None = None) -> tuple[Path, Path]:
    """The tracks (.npz) and the truth (.txt) of a folder, or of a file of tracks and the folder that it is in.

    Raises
    ------
    InputError
        There is none of one of them, or more than one.
    """
    folder = at if at.is_dir() else at.parent
    tracks_file = _only(folder, "*.npz", "tracks", "--data FILE") if at.is_dir() else at
    return tracks_file, truth or _only(folder, "*.txt", "true poses", "--truth FILE")


def _only(folder: Path, pattern: str, what: str, remedy: str) -> Path:
    found = sorted(folder.glob(pattern))
    if len(found) != 1:
        names = ", ".join(path.name for path in found) or "none"
        raise InputError(f"--data {folder}: must hold one file {pattern} of {what}, holds {names}; {remedy} names it")
    return found[0]


def read_recording(path: Path, truth: Path) -> Recording:
    """Tracks and true poses of a drive.

    Parameters
    ----------
    path : archive with features, time_stamps, linear_velocity, rotational_velocity, K, b and cam_T_imu
    truth : a line a frame from the first on, 12 numbers as KITTI's, or a time and 12; frames without are left out

    Raises
    ------
    InputError
        A file or array is missing, has another shape, or holds a value that is not finite; the camera is none of KITTI.
    """
    with reading(path, "is not an archive of tracks"), np.load(path) as archive:
        data = {name: np.asarray(archive[name]) for name in archive.files}
    rows = read_number_table(truth, None, "is not a table of finite numbers")
    if rows.shape[1] not in (12, 13) or len(rows) < 2:
        raise InputError(f"{truth}: must hold 12 numbers a line, or a time and 12, for two frames or more")
    frames = len(rows)
    shapes: dict[str, tuple[int, ...]] = {
        "features": (4, -1, -1), "time_stamps": (1, -1), "linear_velocity": (3, -1), "rotational_velocity": (3, -1),
        "K": (3, 3), "b": (), "cam_T_imu": (4, 4),
    }  # fmt: skip
    for name, shape in shapes.items():
        _require(path, name, data.get(name), shape, frames)
    return Recording(
        data["features"][:, :, :frames], data["time_stamps"][0, :frames], data["linear_velocity"][:, :frames],
        data["rotational_velocity"][:, :frames], float(data["K"][0, 0]), data["K"][:2, 2], float(data["b"]),
        data["cam_T_imu"][:3, :3],
        data["cam_T_imu"][:3, 3],  # despite its name: the camera's position in the IMU frame
        rows[:, -12:].reshape(-1, 3, 4),
        image_size(float(data["K"][0, 0]), f"{path}: array 'K'"),
    )  # fmt: skip


def image_size(f: float, where: str) -> tuple[int, int]:
    """Width and height (px) of KITTI's rectified images of focal length ``f`` (px)."""
    known = min(SIZES, key=lambda each: abs(each - f))
    if abs(known - f) > 0.01:
        raise InputError(
            f"{where}: no rectified camera of KITTI has f = {f:g} px; they have {', '.join(map(str, SIZES))}"
        )
    return SIZES[known]


def _require(path: Path, name: str, value: Any, shape: tuple[int, ...], least: int) -> None:
    """``shape`` with -1 where any length goes; the last of these axes has at least ``least`` entries."""
    if value is None:
        raise InputError(f"{path}: array '{name}' is missing")
    fits = value.ndim == len(shape) and all(want in (-1, have) for want, have in zip(shape, value.shape, strict=False))
    if not fits or (-1 in shape and value.shape[len(shape) - 1 - shape[::-1].index(-1)] < least):
        wanted = " x ".join("any" if want == -1 else str(want) for want in shape) or "one number"
        raise InputError(
            f"{path}: array '{name}' has shape {value.shape}; must be {wanted}, for the {least} frames of the truth"
        )
    if value.dtype.kind not in "fiu" or not np.isfinite(value).all():
        raise InputError(f"{path}: array '{name}' holds something that is not a finite number")


def log_of(data: Recording, slots: int = SLOTS, gated: bool = True) -> tuple[Trial, Belief]:
    """The recording as one trial and what a filter is to believe about it.

    Parameters
    ----------
    slots : landmarks seen at once, at most
    gated : whether a landmark restarts where it leaves the common motion
    """
    mount = Mount(position=tuple(data.lever), rotation=roll_pitch_heading(data.axes.T @ CAMERA))
    searched = MIN_DISPARITY, float(data.size[0])  # the tracker has no other limit than the image
    sensor = BelievedSensor(model="uvd", sigma=SIGMA_PX, f=data.f, B=data.B, mount=mount, disparity=searched)
    belief = Belief(motion=BelievedMotion(sigma_v=SIGMA_V, sigma_omega=SIGMA_OMEGA), sensor=sensor)
    rows = fresh_observations(data)
    if gated:
        [trial] = screened([trial_of(data, rows.rename(columns={"piece": "landmark"}))], belief, GATE_PX).trials
        rows = rows_of(trial)
    return trial_of(data, thinned(rows, slots, data.size[0])), belief


def trial_of(data: Recording, rows: pd.DataFrame) -> Trial:
    """All rows (step, landmark, z0, z1, z2) after step 0 as a trial."""
    seen, truth = rows[rows["step"] >= 1].sort_values("step", kind="stable"), planar_truth(data)
    return Trial(
        run=0,
        start=np.zeros(3),
        controls=np.column_stack([np.diff(data.stamps), data.velocity[0, 1:], data.turn_rate[2, 1:]]),
        first=np.searchsorted(seen["step"], np.arange(1, len(truth) + 1)),
        landmark=seen["landmark"].to_numpy(np.int64),
        z=seen[PIXELS].to_numpy(float),
        n_landmarks=int(seen["landmark"].max()) + 1,
        truth=truth,
    )


def rows_of(trial: Trial) -> pd.DataFrame:
    """Rows (piece, step, z0, z1, z2) of a trial, a piece of a track for each landmark."""
    step = trial.step
    rows = pd.DataFrame(trial.z, columns=PIXELS).assign(piece=trial.landmark, step=step)
    return rows.sort_values(["piece", "step"], ignore_index=True)


# --- the pose --------------------------------------------------------------------------------


def planar_truth(data: Recording) -> Array:
    """IMU poses x, y, heading (m, rad) on the plane that fits their path best, shape (T + 1, 3).

    They start at the origin with heading 0; the heading is not wrapped.
    """
    turn = data.axes.T @ data.poses[:, :, :3] @ data.axes
    position = data.poses[:, :, 3] @ data.axes + data.lever - turn @ data.lever
    level = levelling(path_normal(position))
    forward = (level @ turn)[:, :, 0]
    heading = np.unwrap(np.arctan2(forward[:, 1], forward[:, 0]))
    flat = (position - position[0]) @ level.T @ rotation(0.0, 0.0, heading[0])
    return np.column_stack([flat[:, :2], heading - heading[0]])


def path_normal(position: Array) -> Array:
    """Upward normal of the plane fitted to points (n, 3)."""
    x, y, z = position.T
    slope_x, slope_y, _ = np.linalg.lstsq(np.column_stack([x, y, np.ones(len(x))]), z, rcond=None)[0]
    return np.array([-slope_x, -slope_y, 1.0])


def levelling(up: Array) -> Array:
    """Shortest rotation (3, 3) that takes the direction ``up`` to z."""
    a, b, c = up / np.linalg.norm(up)
    cross = np.array([[0.0, 0, -a], [0, 0, -b], [a, b, 0]])
    return np.asarray(np.eye(3) + cross + cross @ cross / (1 + c))


def roll_pitch_heading(turn: Array) -> tuple[float, float, float]:
    """Angles (rad) of Rz(heading) Ry(pitch) Rx(roll)."""
    roll, heading = np.arctan2(turn[2, 1], turn[2, 2]), np.arctan2(turn[1, 0], turn[0, 0])
    return float(roll), float(-np.arcsin(turn[2, 0])), float(heading)


# --- pieces of tracks that follow one point --------------------------------------------------


def fresh_observations(data: Recording) -> pd.DataFrame:
    """Rows (track, step, z0, z1, z2, piece) of every track up to its first stale copy.

    When the tracker looked for new corners it stored every old track's last pixels once more, and continued
    from there on another point of the scene: the number stays, the landmark changes.
    """
    track, step = np.nonzero((data.features != -1).all(axis=0))
    pixels = data.features[:, track, step].T
    stale = np.concatenate([[False], (np.diff(pixels, axis=0) == 0).all(axis=1)]) & continued(track, step)
    u, v = pixels[:, :2].T - data.centre[:, None]
    rows = pd.DataFrame({"track": track, "step": step, "z0": u, "z1": v, "z2": pixels[:, 0] - pixels[:, 2]})
    slipped = pd.Series(stale).groupby(track).cummax().to_numpy()
    usable = rows[~slipped & (rows["z2"] >= MIN_DISPARITY)].reset_index(drop=True)
    return usable.assign(piece=np.cumsum(~continued(usable["track"].to_numpy(), usable["step"].to_numpy())))


def continued(track: Array, step: Array) -> Array:
    """Whether a row is the track of the row before it, one step on; rows sorted by track, then step."""
    return np.concatenate([[False], (np.diff(track) == 0) & (np.diff(step) == 1)])[: len(track)]


# --- few landmarks at once -------------------------------------------------------------------


def thinned(rows: pd.DataFrame, slots: int = SLOTS, width: int = 1226) -> pd.DataFrame:
    """Rows (step, landmark, z0, z1, z2) of at most ``slots`` landmarks at once, none older than MAX_AGE."""
    return tracks.thinned(rows, tracks.TrackSelection(slots, MAX_AGE, MIN_LIFE, BANDS, width))
