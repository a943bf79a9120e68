"""Stereo tracks of KITTI odometry 07 (course ECE276A) as a planar log; why each step is there: docs/kitti07.md.

Only :func:`planar_truth` reads the ground truth: controls, observations and where a track is cut come from the
recording alone. Pixels are (u, v, d): right of the principal point, below it, left minus right column.
"""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from consistency.errors import InputError
from consistency.geometry import rotation
from consistency.scenario import Belief, BelievedMotion, BelievedSensor, Mount
from consistency.types import Array, Trial
from consistency.vision import tracks
from consistency.vision.tracks import PIXELS

SIGMA_V, SIGMA_OMEGA = 0.5, 0.05  # m/s, rad/s: white noise that the course added to the velocities
SIGMA_PX = (1.0, 3.3, 0.7)  # rms of u, v, d against the planar truth; v carries pitch and roll
MAX_AGE = 12  # observations of a landmark: beyond, drift exceeds 1 px rms
MIN_LIFE = 2  # observations: fewer tell a filter nothing
MIN_DISPARITY = 8.0  # px, 47 m: sigma_d / d below 9 %
GATE_PX = np.array([2.0, 2.0, 1.0])  # misfit in u, v, d from frame to frame that ends a piece
SLOTS = 4  # landmarks seen at once
BANDS = 3  # image columns that the slots are spread over
WIDTH, HEIGHT = 1226, 370  # px
VIEW = ((WIDTH, HEIGHT), (601.8873, 183.1104))  # image and principal point of the rectified left camera, px
KITTI_FROM_SENSOR = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])  # right, down, forward <- forward, left, up
FILES = ("0027.npz", "kitti07_gt.txt")


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


def read_recording(folder: Path) -> Recording:
    """Both files of ``folder``.

    Raises
    ------
    InputError
        A file or array is missing, has another shape, or holds a value that is not finite.
    """
    path, truth = (folder / name for name in FILES)
    try:
        with np.load(path) as archive:
            data = {name: np.asarray(archive[name]) for name in archive.files}
        rows = np.loadtxt(truth, ndmin=2)
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        missing = [name for name in FILES if not (folder / name).is_file()]
        what = f"{missing[0]} is missing" if missing else str(error).splitlines()[0]
        raise InputError(f"--data {folder}: {what}; it must hold {' and '.join(FILES)}") from None
    frames = len(rows)
    shapes: dict[str, tuple[int, ...]] = {
        "features": (4, -1, -1), "time_stamps": (1, -1), "linear_velocity": (3, -1), "rotational_velocity": (3, -1),
        "K": (3, 3), "b": (), "cam_T_imu": (4, 4),
    }  # fmt: skip
    for name, shape in shapes.items():
        _require(path, name, data.get(name), shape, frames)
    _require(truth, "rows", rows, (-1, 13), 2)
    return Recording(
        data["features"][:, :, :frames], data["time_stamps"][0, :frames], data["linear_velocity"][:, :frames],
        data["rotational_velocity"][:, :frames], float(data["K"][0, 0]), data["K"][:2, 2], float(data["b"]),
        data["cam_T_imu"][:3, :3],
        data["cam_T_imu"][:3, 3],  # despite its name: the camera's position in the IMU frame
        rows[:, 1:].reshape(-1, 3, 4),
    )  # fmt: skip


def _require(path: Path, name: str, value: Any, shape: tuple[int, ...], least: int) -> None:
    """``shape`` with -1 where any length goes; the last of these axes has at least ``least`` entries."""
    if value is None:
        raise InputError(f"{path}: array '{name}' is missing")
    fits = value.ndim == len(shape) and all(want in (-1, have) for want, have in zip(shape, value.shape, strict=False))
    if not fits or (-1 in shape and value.shape[len(shape) - 1 - shape[::-1].index(-1)] < least):
        raise InputError(f"{path}: array '{name}' has shape {value.shape}, not that of the recording")
    if value.dtype.kind not in "fiu" or not np.isfinite(value).all():
        raise InputError(f"{path}: array '{name}' holds something that is not a finite number")


def log_of(data: Recording, slots: int = SLOTS, gated: bool = True) -> tuple[Trial, Belief]:
    """The recording as one trial and what a filter is to believe about it.

    Parameters
    ----------
    slots : landmarks seen at once, at most
    gated : whether a track ends where it disagrees with the common motion
    """
    pieces = fresh_observations(data)
    seen = thinned(consistent_pieces(pieces, data) if gated else pieces, slots)
    truth = planar_truth(data)
    trial = Trial(
        run=0,
        start=np.zeros(3),
        controls=np.column_stack([np.diff(data.stamps), data.velocity[0, 1:], data.turn_rate[2, 1:]]),
        first=np.searchsorted(seen["step"], np.arange(1, len(truth) + 1)),
        landmark=seen["landmark"].to_numpy(np.int64),
        z=seen[PIXELS].to_numpy(float),
        n_landmarks=int(seen["landmark"].max()) + 1,
        truth=truth,
    )
    mount = Mount(position=tuple(data.lever), rotation=roll_pitch_heading(data.axes.T @ KITTI_FROM_SENSOR))
    sensor = BelievedSensor(model="uvd", sigma=SIGMA_PX, f=data.f, B=data.B, mount=mount)
    return trial, Belief(motion=BelievedMotion(sigma_v=SIGMA_V, sigma_omega=SIGMA_OMEGA), sensor=sensor)


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

    When the tracker looked for new corners it stored every old track's last pixels once more, and went on
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


def consistent_pieces(rows: pd.DataFrame, data: Recording) -> pd.DataFrame:
    """Cut pieces where they disagree with the motion that most tracks agree on (moving cars, slips)."""
    piece, steps, pixels = rows["piece"].to_numpy(), rows["step"].to_numpy(), rows[PIXELS].to_numpy()
    now = np.flatnonzero(np.concatenate([[False], np.diff(piece) == 0]))
    broken = np.zeros(len(rows), dtype=bool)
    for step in np.unique(steps[now]):
        here = now[steps[now] == step]
        broken[here] = ~agrees(pixels[here - 1], pixels[here], *velocity_prior(data, step), data.f, data.B)
    starts = np.concatenate([[True], np.diff(piece) != 0]) | broken
    return rows.assign(piece=np.cumsum(starts))


def velocity_prior(data: Recording, step: int) -> tuple[Array, Array]:
    """Move of the camera from step - 1 to step (shift in m, small rotation in rad; KITTI axes) and its sigma."""
    dt = data.stamps[step] - data.stamps[step - 1]
    turn, speed = data.turn_rate[:, step], data.velocity[:, step] + np.cross(data.turn_rate[:, step], data.lever)
    move = np.concatenate([data.axes @ speed, data.axes @ turn]) * dt
    return move, np.repeat([SIGMA_V, SIGMA_OMEGA], 3) * dt


def agrees(before: Array, after: Array, mean: Array, sigma: Array, f: float, B: float) -> Array:
    """Which pairs of pixels (n, 3) fit their common motion: ten reweighted least squares steps from the prior."""
    points = np.column_stack([before[:, :2], np.full(len(before), f)]) * (B / before[:, 2])[:, None]
    move, soft = mean.copy(), 0.5 * GATE_PX
    for _ in range(10):
        misfit, slope = _misfit_and_slope(points, after, move, f, B)
        weight = 1 / (1 + ((misfit / soft) ** 2).sum(axis=1))
        scaled = slope / soft[None, :, None]
        normal = np.einsum("n,nij,nik->jk", weight, scaled, scaled) + np.diag(sigma**-2)
        right = np.einsum("n,nij,ni->j", weight, scaled, misfit / soft) + (mean - move) / sigma**2
        move = move + np.linalg.solve(normal, right)
    misfit, _ = _misfit_and_slope(points, after, move, f, B)
    return np.asarray((np.abs(misfit) <= GATE_PX).all(axis=1))


def _misfit_and_slope(points: Array, seen: Array, move: Array, f: float, B: float) -> tuple[Array, Array]:
    """Seen minus predicted (u, v, d), and the derivative of the prediction by (shift, rotation)."""
    back = _rodrigues(move[3:])
    moved = (points - move[:3]) @ back
    x, y, depth = moved[:, 0], moved[:, 1], np.maximum(moved[:, 2], 0.5)
    predicted = np.column_stack([x, y, np.full(len(x), B)]) * (f / depth)[:, None]
    by_point = np.zeros((len(x), 3, 3))
    by_point[:, 0, 0] = by_point[:, 1, 1] = f / depth
    by_point[:, :, 2] = -predicted / depth[:, None]
    by_turn = np.cross(moved[:, None, :], np.eye(3)[None]).transpose(0, 2, 1)
    return seen - predicted, by_point @ np.concatenate([np.broadcast_to(-back.T, by_turn.shape), by_turn], axis=2)


def _rodrigues(vector: Array) -> Array:
    angle = float(np.linalg.norm(vector)) + 1e-12
    x, y, z = vector / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross)


# --- few landmarks at once -------------------------------------------------------------------


def thinned(rows: pd.DataFrame, slots: int = SLOTS) -> pd.DataFrame:
    """Rows (step, landmark, z0, z1, z2) of at most ``slots`` landmarks at once, none older than MAX_AGE."""
    return tracks.thinned(rows, tracks.Selection(slots, MAX_AGE, MIN_LIFE, BANDS, WIDTH))
