"""Files of the KITTI data sets: times of day, numbers by key, where a day keeps them, and a drive as truth.

Geiger, Lenz, Stiller & Urtasun (2013), "Vision meets robotics: the KITTI dataset", section 3; section 4: the Mercator
projection, and the frames of inertial unit, velodyne and camera. GPS and inertial packets become poses of the car.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from consistency.referee.errors import InputError
from consistency.referee.geometry import inverse, vectors
from consistency.referee.parsing import HUGE, one_line, read_text, reading
from consistency.referee.readers.formats.pose_rows import are_rotations, on_plane
from consistency.referee.readers.formats.sheet import TableRows
from consistency.referee.readers.formats.text_blocks import Lines
from consistency.referee.types import Array

EXAMPLE = "2011-09-26 13:02:25.594360375"
STAMP = re.compile(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d(\.\d{1,9})?")
NANO = 1e-9  # s in a nanosecond


def place_of(drive: Path, name: str) -> Path | None:
    """A file in the folder of a drive or in that of its day, one above; None where it is in neither."""
    for folder in (drive, drive.absolute().parent):
        if (folder / name).is_file():
            return folder / name
    return None


def read_times(path: Path) -> Array:
    """Lines as ``2011-09-26 13:02:25.594360375`` as nanoseconds, (N,), whole numbers.

    Raises
    ------
    InputError
        The file is missing or empty, or a line is not a time or not later than the one before.
    """
    stamps = []
    for number, line in enumerate(read_text(path, "cannot be read").rstrip().splitlines(), 1):
        where = f"{path}, line {number}"
        stamp = line.strip()
        if not STAMP.fullmatch(stamp):
            raise InputError(f"{where}: not a timestamp; should be like {EXAMPLE}")
        with reading(where, "not a timestamp"):
            stamps.append(np.datetime64(stamp, "ns").astype(np.int64))
    if not stamps:
        raise InputError(f"{path}: is empty")
    back = np.flatnonzero(np.diff(stamps) <= 0)
    if len(back):
        raise InputError(f"{path}, line {back[0] + 2}: timestamps must increase; take the synced drive")
    return np.array(stamps)


def read_keys(path: Path, unnamed: str = "") -> dict[str, Array]:
    """Lines ``key: numbers`` of a calibration; ``calib_time`` is left out.

    With ``unnamed`` a line may lack its key: it is ``unnamed`` and the number of the line, from 0 on.

    Raises
    ------
    InputError
        The file is missing, a key is duplicated, or a line is something else.
    """
    rows: dict[str, Array] = {}
    lines = [line for line in read_text(path, "cannot be read").splitlines() if line.strip()]
    for number, line in enumerate(lines):
        key, _, values = line.rpartition(":")
        if key.startswith("calib_time"):
            continue
        name = key.strip()
        where = f"line {number + 1}"
        if key:
            where = f"key '{one_line(name)}'"
        if not name and unnamed:
            name = f"{unnamed}{number}"
        if name in rows:
            raise InputError(f"{path}: key '{one_line(name)}' is duplicated")
        try:
            rows[name] = np.array(values.split(), float)
        except ValueError:
            raise InputError(f"{path}: {where}: must be numbers, after a key and a colon") from None
    return rows


def numbers(path: Path, rows: dict[str, Array], name: str, shape: tuple[int, ...]) -> Array:
    """The numbers of a key, row by row in ``shape``; raises :class:`InputError`."""
    if name not in rows:
        raise InputError(f"{path}: key '{name}' is missing; there: {one_line(', '.join(rows)) or 'nothing'}")
    count = int(np.prod(shape))
    if rows[name].size != count or not (np.abs(rows[name]) < HUGE).all():
        raise InputError(f"{path}: key '{name}': must be {count} finite numbers")
    return rows[name].reshape(shape)


def turn(path: Path, rows: dict[str, Array], name: str) -> Array:
    """A rotation (3, 3) by its key."""
    R = numbers(path, rows, name, (3, 3))
    if not are_rotations(R):
        raise InputError(f"{path}: key '{name}': is not a rotation")
    return R


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
    t = (stamps - stamps[0]) * NANO
    values = np.column_stack([t, vectors(inverse(poses[:1]) @ poses)])
    return Lines(folder, values, np.arange(1, len(t) + 1))


def drive_poses(folder: Path, body: str) -> tuple[Array, Array]:
    """Times of the packets in ns, (N,), and poses (N, 4, 4) of a body in a world that is east, north, up, m.

    Parameters and exceptions are those of :func:`read_drive`.
    """
    oxts = folder / "oxts"
    stamps = read_times(oxts / "timestamps.txt")
    files = sorted((oxts / "data").glob("*.txt"))
    if len(files) != len(stamps):
        raise InputError(f"{oxts}: timestamps.txt has {len(stamps)} lines, but data {len(files)} packets")
    packets = np.array([_packet(file) for file in files])
    poses = np.tile(np.eye(4), (len(stamps), 1, 1))
    attitude = Rotation.from_euler("ZYX", packets[:, [5, 4, 3]])  # Rz(yaw) Ry(pitch) Rx(roll)
    poses[:, :3, :3] = attitude.as_matrix()
    poses[:, :3, 3] = mercator(packets[:, :3])
    mount = np.eye(4)  # takes points of the inertial unit to the body
    for name in BODIES[body]:
        path = place_of(folder, f"calib_{name}.txt")
        if path is None:
            raise InputError(f"{folder}: --body needs calib_{name}.txt, here or in the folder above")
        rows = read_keys(path)
        part = np.eye(4)
        part[:3, :3] = turn(path, rows, "R")
        part[:3, 3] = numbers(path, rows, "T", (3,))
        mount = part @ mount
    return stamps, poses @ np.linalg.inv(mount)


def drive_sheet(folder: Path, body: str | None = None) -> TableRows:
    """Poses of a drive in the plane: columns t, x, y, heading."""
    if body not in (None, *LEVEL):
        raise InputError(f"--body {body}: with x, y, heading it is {' or '.join(LEVEL)}, whose x and y are level")
    return on_plane(read_drive(folder, body), "packet")


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
    is_place = abs(values[0]) <= POLE and abs(values[1]) <= 180.0
    if not (is_place and np.isfinite(values[:6]).all()):
        raise InputError(f"{path}: begins with {fields[0]} {fields[1]}; should be latitude and longitude in degrees")
    return values[:6]
