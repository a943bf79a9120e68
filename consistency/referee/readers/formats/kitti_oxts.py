"""A drive of the KITTI raw data as truth: GPS and inertial packets to poses of the car.

Geiger, Lenz, Stiller & Urtasun (2013), "Vision meets robotics: the KITTI dataset", section 4: the Mercator
projection, and the frames of inertial unit, velodyne and camera.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from consistency.referee.errors import InputError
from consistency.referee.parsing import read_text, reading
from consistency.referee.readers.formats.kitti_files import NANO, numbers, place_of, read_keys, read_times, turn
from consistency.referee.readers.formats.pose_rows import on_plane
from consistency.referee.readers.formats.sheet import Lines, TableRows
from consistency.referee.types import Array

EARTH = 6378137.0  # m, radius at the equator (WGS 84)
POLE = 89.0  # degrees of latitude, beyond which the projection is of no use
FIELDS = 30  # of a packet: latitude, longitude (degrees), altitude (m), roll, pitch, yaw (rad), ...
BODIES = {"imu": (), "velodyne": ("imu_to_velo",), "camera": ("imu_to_velo", "velo_to_cam")}  # files of calib_*.txt
LEVEL = ("imu", "velodyne")  # bodies whose x and y are in the plane of the road


def read_drive(folder: Path, body: str | None = None) -> Lines:
    """Poses of a drive as lines of a TUM trajectory: t, position and quaternion x, y, z, w.

    Seconds are counted from the first packet. The world is the first pose of the body, as in the development kit.

    Parameters
    ----------
    body : imu, velodyne or camera (the left grey one, not rectified); None is imu. The others need
        calib_imu_to_velo.txt and calib_velo_to_cam.txt in the drive's folder or in the one above.

    Raises
    ------
    InputError
        A file is missing, damaged, or inconsistent with the others; the message names it.
    """
    if body not in (None, *BODIES):
        raise InputError(f"--body {body}: must be one of {', '.join(BODIES)}")
    stamps, poses = drive_poses(folder, body or "imu")
    poses = np.linalg.inv(poses[0]) @ poses
    quaternion = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    t = (stamps - stamps[0]) * NANO
    return Lines(folder, np.column_stack([t, poses[:, :3, 3], quaternion]), np.arange(1, len(t) + 1))


def drive_poses(folder: Path, body: str) -> tuple[Array, Array]:
    """Times of the packets in ns, (N,), and poses (N, 4, 4) of a body in a world that is east, north, up, m.

    Parameters and exceptions are those of :func:`read_drive`.
    """
    stamps = read_times(folder / "oxts" / "timestamps.txt")
    files = sorted((folder / "oxts" / "data").glob("*.txt"))
    if len(files) != len(stamps):
        raise InputError(f"{folder / 'oxts'}: timestamps.txt has {len(stamps)} lines, but data {len(files)} packets")
    packets = np.array([_packet(file) for file in files])
    poses = np.tile(np.eye(4), (len(stamps), 1, 1))
    poses[:, :3, :3] = Rotation.from_euler("ZYX", packets[:, [5, 4, 3]]).as_matrix()  # Rz(yaw) Ry(pitch) Rx(roll)
    poses[:, :3, 3] = mercator(packets[:, :3])
    return stamps, poses @ np.linalg.inv(_mount(folder, body))


def drive_sheet(folder: Path, body: str | None = None) -> TableRows:
    """Poses of a drive in the plane: columns t, x, y, heading."""
    if body not in (None, *LEVEL):
        raise InputError(f"--body {body}: with x, y, heading it is {' or '.join(LEVEL)}, whose x and y are level")
    lines = read_drive(folder, body)
    return on_plane(lines, "packet")


def mercator(place: Array) -> Array:
    """Latitude and longitude, degrees, and altitude, m, (N, 3) to x (east), y (north), z (up), m, (N, 3).

    The scale is right at the first latitude.
    """
    latitude, longitude, altitude = np.asarray(place, float).T
    scale = EARTH * np.cos(np.deg2rad(latitude[0]))
    north = np.log(np.tan(np.deg2rad(90.0 + latitude) / 2.0))
    return np.column_stack([scale * np.deg2rad(longitude), scale * north, altitude])


def _packet(path: Path) -> list[float]:
    fields = read_text(path, "cannot be read").split()
    with reading(path, "is not a packet of numbers"):
        values = [float(field) for field in fields]
    if len(values) != FIELDS:
        raise InputError(f"{path}: has {len(values)} numbers; a packet of KITTI has {FIELDS}")
    if not np.isfinite(values[:6]).all() or abs(values[0]) > POLE or abs(values[1]) > 180.0:
        raise InputError(f"{path}: begins with {fields[0]} {fields[1]}; should be latitude and longitude in degrees")
    return values[:6]


def _mount(folder: Path, body: str) -> Array:
    """Matrix (4, 4) that takes points of the inertial unit to the body, of the lines R and T of calibration files."""
    mount = np.eye(4)
    for name in BODIES[body]:
        path = place_of(folder, f"calib_{name}.txt")
        if path is None:
            raise InputError(f"{folder}: --body needs calib_{name}.txt, here or in the folder above")
        rows, part = read_keys(path), np.eye(4)
        part[:3, :3], part[:3, 3] = turn(path, rows, "R"), numbers(path, rows, "T", (3,))
        mount = part @ mount
    return mount
