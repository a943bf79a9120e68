"""Stereo tracks of KITTI odometry 00 (GTSAM's examples) as a log, to characterise their noise.

    python experiments/gtsam00_log.py --data DIR --out LOG
    consistency characterise LOG --out sensor.toml

DIR holds VO_stereo_factors00s.txt, VO_camera_poses00s.txt, VO_calibration00s.txt (GTSAM's examples) and
kitti00_gt_first77.txt (KITTI's licence, CC BY-NC-SA: not shipped). The truth has constant speed before frame 16 or so,
which the images do not show: the log begins with frame 18.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from consistency.errors import InputError
from consistency.frontend.planar import in_robot_axes, planar_motions, planar_path, robot_axes
from consistency.frontend.planar_log import CAMERA, relative
from consistency.frontend.tum import trajectory_text
from consistency.scenario import Belief, BelievedMotion, BelievedSensor, Mount
from consistency.store.log import write_log
from consistency.store.storage import manifest_of
from consistency.types import Array, Trial

FIRST = 18  # frame that becomes step 0
FILES = ("VO_stereo_factors00s.txt", "VO_camera_poses00s.txt", "VO_calibration00s.txt", "kitti00_gt_first77.txt")
COLUMNS = (8, 17, 6, 13)  # numbers in a line of each
SIZE = (1241, 376)  # px, the images of KITTI 00
SIGMA_PX = (1.0, 1.0, 1.0)  # nothing is known yet
SIGMA_V, SIGMA_OMEGA = 0.5, 0.05  # m/s, rad/s, of the visual odometry in the file, generously


def read_tables(folder: Path) -> list[Array]:
    """The four files: factors, poses of the visual odometry, calibration, truth.

    Raises
    ------
    InputError
        A file is missing or does not hold what it should.
    """
    tables = []
    for name, columns in zip(FILES, COLUMNS, strict=True):
        path = folder / name
        try:
            table = np.loadtxt(path, ndmin=2)
        except OSError:
            raise InputError(f"--data {folder}: {name} is missing; it must hold {', '.join(FILES)}") from None
        except ValueError as error:
            raise InputError(f"{path}: not a table of numbers ({error})") from None
        if table.shape[1] != columns or not np.isfinite(table).all():
            raise InputError(f"{path}: must hold {columns} finite numbers a line")
        tables.append(table)
    return tables


def log_of(folder: Path) -> tuple[Trial, Belief, tuple[tuple[int, int], tuple[float, float]], str]:
    """Trial, belief, view, and the true poses of the left camera from frame ``FIRST`` on as TUM lines."""
    factors, odometry, calibration, truth = read_tables(folder)
    f, _, _, column, row, B = calibration[0]
    poses = truth[FIRST:, 1:].reshape(-1, 3, 4)
    T, t = len(poses) - 1, truth[FIRST:, 0]
    told = odometry[FIRST:, 1:].reshape(-1, 4, 4)
    axes = robot_axes(relative(told[:, :3, :3], told[:, :3, 3])[1])
    moves, true = (
        planar_motions(*in_robot_axes(*relative(pose[:, :3, :3], pose[:, :3, 3]), axes, 0.0)) for pose in (told, poses)
    )
    step = factors[:, 0].astype(np.int64) - FIRST
    d = factors[:, 2] - factors[:, 3]
    good = (step >= 1) & (step <= T) & (d > 0)
    order = np.lexsort((factors[good, 1], step[good]))
    rows, step = factors[good][order], step[good][order]
    _, landmark = np.unique(rows[:, 1], return_inverse=True)
    dt = np.diff(t)
    trial = Trial(
        run=0,
        start=np.zeros(3),
        controls=np.column_stack([dt, moves[:, 0] / dt, moves[:, 2] / dt]),
        first=np.searchsorted(step, np.arange(1, T + 2)),
        landmark=landmark.astype(np.int64),
        z=np.column_stack([rows[:, 2] - column, rows[:, 4] - row, rows[:, 2] - rows[:, 3]]),
        n_landmarks=int(landmark.max()) + 1,
        truth=planar_path(true),
    )
    turn = axes @ CAMERA
    roll, heading = np.arctan2(turn[2, 1], turn[2, 2]), np.arctan2(turn[1, 0], turn[0, 0])
    mount = Mount(rotation=(float(roll), float(-np.arcsin(turn[2, 0])), float(heading)))
    sensor = BelievedSensor(model="uvd", sigma=SIGMA_PX, f=float(f), B=float(B), mount=mount)
    belief = Belief(motion=BelievedMotion(sigma_v=SIGMA_V, sigma_omega=SIGMA_OMEGA), sensor=sensor)
    return trial, belief, (SIZE, (float(column), float(row))), trajectory_text(t, poses[:, :, :3], poses[:, :, 3])


def main() -> None:
    """Write the log."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help=f"folder with {', '.join(FILES)}")
    parser.add_argument("--out", type=Path, required=True, help="log folder to write")
    parser.add_argument("--overwrite", action="store_true")
    options = parser.parse_args()
    try:
        trial, belief, view, poses = log_of(options.data)
        manifest = manifest_of(kind="log", seed=0, runs=1, complete=True, failures=0, data=str(options.data))
        write_log(options.out, [trial], belief, None, manifest, options.overwrite, view, {"truth.tum": poses})
    except InputError as error:
        raise SystemExit(f"gtsam00_log: {error}") from None
    print(f"{len(trial.z)} observations of {trial.n_landmarks} landmarks in {trial.steps} steps in {options.out}")


if __name__ == "__main__":
    main()
