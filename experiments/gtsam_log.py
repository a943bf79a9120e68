"""Stereo factors as of GTSAM's examples, from the images of a KITTI drive, as a log: to characterise their noise, say.

    python experiments/gtsam_log.py --factors FILE --poses FILE --calibration FILE [--truth FILE] --out LOG
    consistency characterise LOG --out sensor.toml

In GTSAM's examples these are VO_stereo_factors00s.txt, VO_camera_poses00s.txt and VO_calibration00s.txt, of KITTI 00,
with the drive's own poses as truth, each line after its time (KITTI's licence, CC BY-NC-SA: not shipped); or
VO_stereo_factors_large.txt and its companions, without truth. The truth of KITTI 00 has constant speed before frame 16
or so, which the images do not show: ``--first 18``.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from consistency.bench.runs.reproduce_findings import command_line, sibling
from consistency.bench.scenario import Belief, BelievedMotion, BelievedSensor, Mount
from consistency.bench.store.recorded_log import write_log
from consistency.bench.types import Trial
from consistency.referee.errors import InputError
from consistency.referee.system import manifest_of, require_free
from consistency.referee.types import Array
from consistency.stereo.frontend.images_to_log import (
    CAMERA,
    in_robot_axes,
    planar_motions,
    planar_path,
    relative,
    robot_axes,
    trajectory_text,
)
from consistency.stereo.visual_odometry.sequence import read_number_table

if TYPE_CHECKING:
    import kitti07_log as conversion
else:
    conversion = sibling(__file__, "kitti07_log")

RATE = 10.0  # Hz, of KITTI: the factors have no times
SIGMA_PX = (1.0, 1.0, 1.0)  # nothing is known yet
SIGMA_V, SIGMA_OMEGA = 0.5, 0.05  # m/s, rad/s, of the visual odometry in the file, generously


@dataclass(frozen=True)
class Factors:
    """What the files hold of frames 0..T, checked."""

    seen: Array  # (M, 5): frame, landmark, u left, u right, v in px
    poses: Array  # (T + 1, 4, 4), camera in the world by visual odometry
    camera: Array  # (6,): fx, fy, skew, cx, cy in px, baseline in m
    size: tuple[int, int]  # width and height of the image, px
    t: Array  # (T + 1,), s
    truth: Array | None  # (T + 1, 3, 4), of the camera


def read_factors(factors: Path, poses: Path, calibration: Path, truth: Path | None = None, first: int = 0) -> Factors:
    """The files of a drive, from its ``first`` frame on, up to the last frame that all of them have.

    Raises
    ------
    InputError
        A file is missing or does not hold what it should; fewer than two frames are left.
    """
    seen, odometry = read_columns(factors, 8), read_columns(poses, 17)
    camera = read_columns(calibration, 6)[0]
    number = odometry[:, 0]
    if (np.diff(number) != 1).any():
        raise InputError(f"{poses}: the first number of each line must count frames, one after the other")
    start = max(first, int(number[0]))
    end = int(number[-1]) + 1
    t, true = np.arange(start, end) / RATE, None
    if truth is not None:
        rows = read_columns(truth, 13)
        end = min(end, len(rows))
        t, true = rows[start:end, 0], rows[start:end, 1:].reshape(-1, 3, 4)
    if end - start < 2:
        raise InputError(f"--first {first}: leaves {max(end - start, 0)} frames of {poses}; a log takes two or more")
    if (np.diff(t) <= 0).any():
        raise InputError(f"{truth}: the times in its first column must increase")
    told = odometry[start - int(number[0]) : end - int(number[0]), 1:].reshape(-1, 4, 4)
    seen = seen[(seen[:, 0] > start) & (seen[:, 0] < end) & (seen[:, 2] > seen[:, 3])]
    if not len(seen):
        raise InputError(f"{factors}: no line is of the frames {start + 1} to {end - 1}")
    seen = np.column_stack([seen[:, 0] - start, seen[:, 1:5]])
    size = conversion.image_size(float(camera[0]), str(calibration))
    return Factors(seen[np.lexsort((seen[:, 1], seen[:, 0]))], told, camera, size, t, true)


def read_columns(path: Path, columns: int) -> Array:
    """A table of ``columns`` finite numbers a line."""
    table = read_number_table(path, None, f"must hold {columns} finite numbers a line")
    if table.shape[1] != columns:
        raise InputError(f"{path}: must hold {columns} finite numbers a line, not {table.shape[1]}")
    return table


def log_of(data: Factors) -> tuple[Trial, Belief]:
    """One trial, whose controls are the motions of the visual odometry, and what a filter is to believe."""
    f, _, _, column, row, B = data.camera
    told = relative(data.poses[:, :3, :3], data.poses[:, :3, 3])
    axes = robot_axes(told[1])
    moves, dt = planar_motions(*in_robot_axes(*told, axes, 0.0)), np.diff(data.t)
    true = None
    if data.truth is not None:
        motions = relative(data.truth[:, :, :3], data.truth[:, :, 3])
        true = planar_path(planar_motions(*in_robot_axes(*motions, axes, 0.0)))
    _, landmark = np.unique(data.seen[:, 1], return_inverse=True)
    left, right, v = data.seen[:, 2:].T
    trial = Trial(
        run=0,
        start=np.zeros(3),
        controls=np.column_stack([dt, moves[:, 0] / dt, moves[:, 2] / dt]),
        first=np.searchsorted(data.seen[:, 0], np.arange(1, len(data.t) + 1)),
        landmark=landmark.astype(np.int64),
        z=np.column_stack([left - column, v - row, left - right]),
        n_landmarks=int(landmark.max()) + 1,
        truth=true,
    )
    mount = Mount(rotation=conversion.roll_pitch_heading(axes @ CAMERA))
    sensor = BelievedSensor(model="uvd", sigma=SIGMA_PX, f=float(f), B=float(B), mount=mount)
    return trial, Belief(motion=BelievedMotion(sigma_v=SIGMA_V, sigma_omega=SIGMA_OMEGA), sensor=sensor)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, text in (("factors", "frame, landmark, u left, u right, v, x, y, z in each line"),
                       ("poses", "frame and 4 x 4 matrix in each line, by visual odometry"),
                       ("calibration", "fx fy skew cx cy baseline"), ("out", "log folder to write")):  # fmt: skip
        parser.add_argument(f"--{name}", type=Path, required=True, help=text)
    parser.add_argument("--truth", type=Path, help="time and 3 x 4 matrix in each line, from frame 0 on")
    parser.add_argument("--first", type=int, default=0, help="frame that becomes step 0")
    parser.add_argument("--overwrite", action="store_true")
    given = parser.parse_args()
    require_free(given.out, given.overwrite, "log")
    data = read_factors(given.factors, given.poses, given.calibration, given.truth, given.first)
    trial, belief = log_of(data)
    manifest = manifest_of(kind="log", seed=0, runs=1, complete=True, failures=0, data=str(given.factors))
    view = (data.size, (float(data.camera[3]), float(data.camera[4])))
    files = {}
    if data.truth is not None:
        files["truth.tum"] = trajectory_text(data.t, data.truth[:, :, :3], data.truth[:, :, 3])
    write_log(given.out, [trial], belief, None, manifest, given.overwrite, view, files)
    print(f"{len(trial.z)} observations of {trial.n_landmarks} landmarks in {trial.steps} steps in {given.out}")


if __name__ == "__main__":
    command_line(main)
