"""True poses of the left camera from the files of datasets: KITTI odometry and raw, EuRoC / ASL, TUM."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from consistency.referee.errors import InputError
from consistency.referee.parsing import is_file, reading
from consistency.referee.readers.formats.file_kinds import is_drive
from consistency.referee.readers.formats.kitti_files import BODIES, NANO, drive_poses, place_of, read_times
from consistency.referee.readers.formats.pose_rows import UNIT
from consistency.referee.readers.formats.tum import read_trajectory
from consistency.referee.readers.truth_matching import associate
from consistency.referee.types import Array
from consistency.stereo.visual_odometry.rig import CAMERA_0, EUROC_BODY
from consistency.stereo.visual_odometry.sequence import RAW_CALIBRATION, StereoSequence, read_number_table

MAX_DT = 0.01  # s between an image and its truth, as in `consistency analyse`
PACKET_DT = 0.11  # s between an image of KITTI raw and a packet: one period, of 9.6 Hz
PLACES = ("poses.txt", "mav0/state_groundtruth_estimate0/data.csv")
NO_TABLE = "not a table of finite numbers"
ROTATION = 1e-3  # largest entry of R'R - I; KITTI writes seven digits


def find_truth(sequence: StereoSequence) -> Path | None:
    """Where the layout keeps the truth, or None; the folder itself of a drive of KITTI raw with its calibrations."""
    if is_raw_drive(sequence):
        if missing_of_drive(sequence):
            return None
        return sequence.folder
    for place in PLACES:
        if (sequence.folder / place).is_file():
            return sequence.folder / place
    return None


def is_raw_drive(sequence: StereoSequence) -> bool:
    """Whether the images are those of a drive of KITTI raw that has packets of its inertial unit."""
    return sequence.format == "kitti-raw" and is_drive(sequence.folder)


def missing_of_drive(sequence: StereoSequence) -> list[str]:
    """What oxts of a drive of KITTI raw lacks to be the truth of the camera; empty for other layouts."""
    if not is_raw_drive(sequence):
        return []
    names = [f"calib_{name}.txt" for name in BODIES["camera"]]
    lacking = [name for name in names if place_of(sequence.folder, name) is None]
    if sequence.calibration.body != CAMERA_0:
        lacking.append(RAW_CALIBRATION)
    return lacking


def read_truth(path: Path, sequence: StereoSequence) -> tuple[Array, Array]:
    """Poses of the rectified left camera in the world at every frame, (n, 3, 3) and (n, 3) in m.

    12 numbers a line are KITTI's (3 x 4 row by row, a line a frame); a .csv is EuRoC's (nanoseconds, position,
    quaternion w x y z, of the body, which T_BS ties to the camera); else TUM lines (seconds, position, quaternion
    x y z w) of the left camera. A folder is a drive of KITTI raw: the poses of its inertial unit, as its calibrations
    tie them to the camera, interpolated to the times of the images.

    Raises
    ------
    InputError
        The file is missing, damaged, of another length or form, or a frame has no truth within 10 ms.
    """
    if not is_file(path) and not is_drive(path):
        raise InputError(f"--truth {path}: no such file, and no drive of KITTI raw")
    with reading(path, "holds no poses"):
        if path.is_dir():
            R, t = _drive(path, sequence)
        elif path.suffix.lower() == ".csv":
            R, t = _euroc(path, sequence)
        elif _columns(path) == 12:
            R, t = _kitti(path, len(sequence))
        else:
            stamps, R, t = tum_poses(path)
            own = _matched(path, sequence.t, stamps)
            R, t = R[own], t[own]
    return R @ sequence.rectification.turn.T, t


def _columns(path: Path) -> int:
    """Words of the first line that is not a comment."""
    with path.open(encoding="utf-8", errors="replace") as file:
        for line in file:
            if line.strip() and not line.startswith("#"):
                return len(line.split())
    return 0


def tum_poses(path: Path) -> tuple[Array, Array, Array]:
    """Times (n,), s, rotations (n, 3, 3) and positions (n, 3), m, of a file of TUM's form."""
    lines = read_trajectory(path, true=True)
    R = Rotation.from_quat(lines.values[:, 4:8]).as_matrix()
    return lines.t, R, lines.values[:, 1:4]


def _kitti(path: Path, frames: int) -> tuple[Array, Array]:
    rows = read_number_table(path, None, NO_TABLE)
    if len(rows) != frames:
        raise InputError(f"{path}: {len(rows)} poses for {frames} frames; must hold one a frame")
    poses = rows.reshape(-1, 3, 4)
    U, singular, Vt = np.linalg.svd(poses[:, :, :3])
    R = U @ Vt
    if np.abs(singular - 1.0).max() > ROTATION or (np.linalg.det(R) < 0).any():
        raise InputError(f"{path}: holds a rotation that is none; a line must be the 3 x 4 matrix [R t] row by row")
    return R, poses[:, :, 3]


def _drive(path: Path, sequence: StereoSequence) -> tuple[Array, Array]:
    if sequence.format != "kitti-raw" or sequence.calibration.body != CAMERA_0:
        raise InputError(f"--truth {path}: is of a drive of KITTI raw with {RAW_CALIBRATION}; the images are not")
    stamps, poses = drive_poses(path, "camera")
    if len(poses) < 2:
        raise InputError(f"{path}: has {len(poses)} packets; takes two or more")
    start = stamps[0]
    images = sequence.left[0].parent.parent / "timestamps.txt"
    t = read_times(images) - start
    # driven on evenly: images do not end with the packets
    before = poses[0] @ np.linalg.inv(poses[1]) @ poses[0]
    after = poses[-1] @ np.linalg.inv(poses[-2]) @ poses[-1]
    poses = np.stack([before, *poses, after])
    first = 2 * stamps[0] - stamps[1]
    last = 2 * stamps[-1] - stamps[-2]
    known = np.array([first, *stamps, last]) - start
    nearest = np.abs(t[:, None] - known[1:-1]).min(axis=1)
    far = nearest > PACKET_DT / NANO
    far |= (t < known[0]) | (t > known[-1])
    if far.any():
        raise InputError(f"{path}: {far.sum()} of {len(t)} frames have no packet within {PACKET_DT:g} s")
    turn = Slerp(known, Rotation.from_matrix(poses[:, :3, :3]))(t).as_matrix()
    place = np.empty((len(t), 3))
    for k in range(3):
        place[:, k] = np.interp(t, known, poses[:, k, 3])
    return _of_camera(turn, place, sequence)


def _euroc(path: Path, sequence: StereoSequence) -> tuple[Array, Array]:
    rows = read_number_table(path, ",", NO_TABLE)
    if rows.shape[1] < 8 or not np.isfinite(rows[:, :8]).all() or (np.diff(rows[:, 0]) <= 0).any():
        raise InputError(f"{path}: must hold increasing nanoseconds, position and quaternion w x y z, all finite")
    length = np.linalg.norm(rows[:, 4:8], axis=1)
    if (np.abs(length - 1.0) > UNIT).any():
        raise InputError(f"{path}: columns 5 to 8 must be a quaternion w x y z of length 1")
    if sequence.calibration.body != EUROC_BODY:
        raise InputError(f"{path}: is the truth of a body, but {sequence.calibration.source} has no T_BS to the camera")
    rows = rows[_matched(path, sequence.t, rows[:, 0] / 1e9)]
    turn = Rotation.from_quat(rows[:, [5, 6, 7, 4]]).as_matrix()
    return _of_camera(turn, rows[:, 1:4], sequence)


def _of_camera(turn: Array, place: Array, sequence: StereoSequence) -> tuple[Array, Array]:
    """Poses of the left camera from those of the body that its calibration ties it to."""
    body = sequence.calibration.body_from_left
    assert body is not None
    return turn @ body[:3, :3], place + turn @ body[:3, 3]


def _matched(path: Path, t: Array, reference: Array) -> Array:
    own, match = associate(t, reference, MAX_DT)
    if len(own) != len(t):
        raise InputError(f"{path}: {len(t) - len(own)} of {len(t)} frames have no truth within {MAX_DT:g} s")
    return match
