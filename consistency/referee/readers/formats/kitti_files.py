"""What files of the KITTI data sets have in common: times of day, numbers by key, and where a day keeps them.

Geiger, Lenz, Stiller & Urtasun (2013), "Vision meets robotics: the KITTI dataset", section 3.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from consistency.referee.errors import InputError
from consistency.referee.parsing import HUGE, one_line, read_text, reading
from consistency.referee.types import Array

STAMP = re.compile(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d(\.\d{1,9})?")
NANO = 1e-9  # s in a nanosecond
ROTATION = 1e-3  # largest entry of R R' - I


def place_of(drive: Path, name: str) -> Path | None:
    """A file in the folder of a drive or in that of its day, one above; None where it is in neither."""
    return next((each / name for each in (drive, drive.absolute().parent) if (each / name).is_file()), None)


def read_times(path: Path) -> Array:
    """Lines as ``2011-09-26 13:02:25.594360375`` as nanoseconds, (N,), whole numbers.

    Raises
    ------
    InputError
        The file is missing or empty, or a line is no time or not later than the one before.
    """
    stamps = []
    for number, line in enumerate(read_text(path, "cannot be read").rstrip().splitlines(), 1):
        if not STAMP.fullmatch(line.strip()):
            raise InputError(f"{path}, line {number}: not a timestamp; should be like 2011-09-26 13:02:25.594360375")
        with reading(f"{path}, line {number}", "not a timestamp"):
            stamps.append(np.datetime64(line.strip(), "ns").astype(np.int64))
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
        The file is missing, a key is there twice, or a line is something else.
    """
    rows: dict[str, Array] = {}
    for number, line in enumerate(line for line in read_text(path, "cannot be read").splitlines() if line.strip()):
        key, _, values = line.rpartition(":")
        name = key.strip() or (f"{unnamed}{number}" if unnamed else "")
        if key.startswith("calib_time"):
            continue
        if name in rows:
            raise InputError(f"{path}: key '{one_line(name)}' is there twice")
        try:
            rows[name] = np.array(values.split(), float)
        except ValueError:
            where = f"key '{one_line(name)}'" if key else f"line {number + 1}"
            raise InputError(f"{path}: {where}: must be numbers, after a key and a colon") from None
    return rows


def numbers(path: Path, rows: dict[str, Array], name: str, shape: tuple[int, ...]) -> Array:
    """The numbers of a key, row by row in ``shape``; raises :class:`InputError`."""
    count = int(np.prod(shape))
    if name not in rows:
        raise InputError(f"{path}: key '{name}' is missing; there: {one_line(', '.join(rows)) or 'nothing'}")
    if rows[name].size != count or not (np.abs(rows[name]) < HUGE).all():
        raise InputError(f"{path}: key '{name}': must be {count} finite numbers")
    return rows[name].reshape(shape)


def turn(path: Path, rows: dict[str, Array], name: str) -> Array:
    """A rotation (3, 3) by its key."""
    R = numbers(path, rows, name, (3, 3))
    if not np.abs(R @ R.T - np.eye(3)).max() < ROTATION or np.linalg.det(R) < 0:
        raise InputError(f"{path}: key '{name}': is no rotation")
    return R
