"""What a file of estimates is, by its name and its first lines: names of columns, and the first row of numbers."""

from __future__ import annotations

import csv
import re
import zlib
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from consistency.referee.column_names import POSE
from consistency.referee.errors import InputError
from consistency.referee.parsing import is_file
from consistency.referee.readers.formats.columns import (
    PLAIN,
    Columns,
    clock_of,
    pose_columns,
    rates_in,
    renamed,
    state_columns,
)
from consistency.referee.readers.formats.text_blocks import opened
from consistency.referee.readers.options import Reading

TABLES = (".csv", ".parquet", ".pq", ".jsonl", ".ndjson")
ARCHIVES = (".npz", ".mat")
TRAJECTORIES = (".txt", ".tum")
BAGS = (".bag", ".mcap", ".db3")
PARTNERS = (*sorted(TRAJECTORIES), ".csv", ".pos", *TABLES)  # of a file of the same stem, the first that is there
HELD_OUT, CORRECTED, CORRECTION = "held-out", "corrected", "correction.toml"  # of a folder of 'correct'
SUFFIXES = (*TABLES, *ARCHIVES, *BAGS, ".pos", *TRAJECTORIES)  # of all kinds, for messages
ARRAYS = "errors=truth - estimates, covariances=P"
LOG = "flight logs are for 'consistency monitor'; accuracies such as eph go into a table, as radius_x_y with --level"
PACKED = "unpack it"
TEXT = "rename text to .csv, or to .txt if its columns have no names"
HDF5, LOADED = "h5py.File(name)[key][()] is an array of it", "load it"
SHEET = "save the sheet as .csv"
WAYS_IN = {
    ".ulg": LOG, ".bin": LOG, ".gz": PACKED, ".zip": PACKED, ".7z": PACKED, ".xz": PACKED, ".bz2": PACKED,
    ".zst": PACKED, ".dat": TEXT, ".log": TEXT, ".out": TEXT, "": TEXT, ".h5": HDF5, ".hdf5": HDF5, ".npy": LOADED,
    ".pkl": LOADED, ".pickle": LOADED, ".xls": SHEET, ".xlsx": SHEET, ".ods": SHEET,
    ".json": "a file with an object a line is .jsonl",
}  # for files of unknown kinds, by suffix  # fmt: skip
FOREIGN = {
    rb"(?m)^CCSDS_OEM_VERS": "an orbit of CCSDS, whose covariances are of the axes COV_REF_FRAME, in km",
    rb"(?m)^(# )?(Raw|Fix),": "a log of Android, whose accuracies are radii of 68 %; RTKLIB solves its raw data",
    rb"(?m)^\$G[A-Z]{4},": "a log of NMEA, which has deviations in its GST sentences alone",
}
PEEKED = 2**16  # bytes of a file that hold its header and its first row


def is_bag(path: Path) -> bool:
    """A file of ROS 1 or 2, a folder of ROS 2, or a folder that holds such."""
    return is_one_bag(path) or (path.is_dir() and any(map(is_one_bag, path.iterdir())))


def is_one_bag(path: Path) -> bool:
    """A file of ROS 1 or 2, or a folder of ROS 2."""
    if path.is_dir():
        return (path / "metadata.yaml").is_file()
    return path.suffix in BAGS and path.is_file()


def is_drive(path: Path) -> bool:
    """Whether a folder is a drive of the KITTI raw data: it holds oxts/data."""
    return (path / "oxts" / "data").is_dir()


def is_solution(path: Path) -> bool:
    """Whether a file is a solution of RTKLIB, by its suffix."""
    return path.suffix.lower() == ".pos" and path.is_file()


def is_spatial(path: Path, columns: Columns | None = None) -> bool:
    """Whether a table is of poses in space."""
    return path.suffix.lower() == ".csv" and path.is_file() and are_poses(path, head_of(path, columns))


def are_poses(path: Path, head: Head | None) -> bool:
    """Whether a text file is of poses in space: by the names of its columns, or without names."""
    return begins_with_numbers(path) if head is None else _are_in_space(head)


def _are_in_space(head: Head) -> bool:
    found = pose_columns(head.names, head.path)
    return "heading" not in head.names and found is not None and bool(found.quaternion)


def is_plane(path: Path, columns: Columns | None = None) -> bool:
    """Whether a file has columns of planar poses, or of speeds and turn rates, under names of their own."""
    return are_planar(head_of(path, columns))


def are_planar(head: Head | None) -> bool:
    """Whether a text file with such a head is of planar poses, or of speeds and turn rates."""
    if head is None or clock_of(head.names) is None or _are_in_space(head):
        return False
    return len(state_columns(head.names, POSE, PLAIN)) == len(POSE) or bool(rates_in(head.names))


def trajectory_files(folder: Path, columns: Columns | None = None) -> list[Path]:
    """Files of a folder that may be trajectories, by name."""
    files = _files(folder)
    named = [path for path in files if path.suffix.lower() in TRAJECTORIES]
    return named or [path for path in files if is_spatial(path, columns) or is_solution(path)]


def table_files(folder: Path) -> list[Path]:
    """Tables of a folder, by name."""
    return [path for path in _files(folder) if path.suffix.lower() in TABLES]


def _files(folder: Path) -> list[Path]:
    return sorted(path for path in folder.iterdir() if path.is_file() and not path.name.startswith("."))


def files_of_runs(estimates: Path, r: Reading, covariance: Path | None) -> list[tuple[Path, Path, Path | None]]:
    """Files of every run: estimates, truth (the estimates where it stands beside them), covariance."""
    truth = r.sources.truth
    if not estimates.is_dir():
        for option, path in (("--truth", truth), ("--covariance", covariance)):
            if path is not None and path.is_dir() and not (option == "--truth" and is_drive(path)):
                raise InputError(f"{option} {path}: is a folder, but {estimates} is one file")
        return [(estimates, truth or estimates, covariance)]
    files = trajectory_files(estimates, r.components.columns)
    if not files:
        raise InputError(f"{estimates}: holds no .txt or .tum file, no table and no manifest.json")
    twice, count = Counter(path.stem for path in files).most_common(1)[0]
    if count > 1:
        raise InputError(f"{estimates}: holds the run '{twice}' twice, as .txt and .tum; keep one of them")
    if covariance is not None and not covariance.is_dir():
        raise InputError(f"--covariance {covariance}: must be a folder like {estimates}, a file for each run")
    out = []
    for path in files:
        own_truth = path
        own_covariance = None
        if truth is not None:
            own_truth = paired(truth, path, "--truth")
        if covariance is not None:
            own_covariance = paired(covariance, path, "--covariance")
        out.append((path, own_truth, own_covariance))
    return out


def paired(other: Path, path: Path, option: str, kind: str = "file '{}' with .txt or .tum, or table,") -> Path:
    """What goes with a file of a run: the file of the same name in another folder; a file or a drive goes with all.

    Raises
    ------
    InputError
        The folder holds no such file.
    """
    if is_drive(other) or not other.is_dir():
        return other
    if is_drive(other / path.stem):
        return other / path.stem
    for suffix in (*PARTNERS, *map(str.upper, PARTNERS), path.suffix):  # a folder of thousands is not listed each time
        file = other / f"{path.stem}{suffix}"
        if file.is_file():
            return file
    what = f"holds no {kind.format(path.stem)} for {path}"
    raise InputError(f"{option} {other}: {what}; files of the two folders are paired by name")


def fitted_note(path: Path) -> str:
    """A note on files whose covariances were fitted to their own errors; "" of others."""
    for corrected in (path, path.parent):
        folder = corrected.parent
        if corrected.name == CORRECTED and (folder / CORRECTION).is_file():
            what = "its covariances are corrected by factors fitted to these runs, so that their verdict shows nothing"
            return f"{path}: {what}; {folder / HELD_OUT} has each run by the factors of others"
    return ""


def is_foreign(path: Path) -> str:
    """What a text file of another format is, and how it gets here; "" of all else."""
    if path.suffix.lower() in (*ARCHIVES, *BAGS):
        return ""
    begin = beginning(path)
    for pattern, hint in FOREIGN.items():
        if re.search(pattern, begin):
            return hint
    return ""


def unknown_kind(path: Path, known: Sequence[str] = SUFFIXES, arrays: str = ARRAYS) -> InputError:
    """Refusal of a file of an unknown kind, with the way to one that is known."""
    hint = is_foreign(path) or WAYS_IN.get(path.suffix.lower(), "")
    line = f"in Python, numpy.savez('{path.stem}.npz', {arrays}) makes an archive of arrays (runs, steps, ...)"
    kinds = f"{path}: unknown kind of file; known are {', '.join(known)} (.txt and .tum are TUM trajectories)"
    return InputError("; ".join(filter(None, (kinds, line, hint))))


class Head(NamedTuple):
    """Names of the columns of a text file, as they stand in it."""

    path: Path
    names: list[str]
    line: int  # of the names, from 1
    comment: bool  # it begins with #
    spaced: bool  # by white space
    places: Sequence[int]  # of these columns in the file
    renaming: Columns | None  # by which some of the names were put in place of its own


def head_of(path: Path, columns: Columns | None = None) -> Head | None:
    """The names of columns above the first row of numbers, those of ``columns`` in place of the file's own.

    None where the file has none.
    """
    lines, row = _beginning(path)
    if row is None or not lines:
        return None
    number, line = lines[-1]
    comment = _is_comment(line)
    if not comment and sum(not _is_comment(text) for _, text in lines) > 1:
        return None
    names = fields_of(line)
    width = len(fields_of(row))
    if comment:
        text = line.strip().lstrip("#")
        names = fields_of(text)
        if len(names) != width:
            names = re.split(r"\s{2,}", text.strip())
    if len(names) != width:
        return None
    is_spaced = not any(mark in line for mark in ",;\t")
    known, places = zip(*renamed(names, columns, path), strict=True)
    return Head(path, list(known), number, comment, is_spaced, places, columns)


def begins_with_numbers(path: Path) -> bool:
    """Whether the first line that is not a comment is of numbers alone."""
    lines, row = _beginning(path)
    if row is None or not all(_is_comment(text) for _, text in lines):
        return False
    return all(map(_is_number, fields_of(row)))


def beginning(path: Path) -> bytes:
    """The first bytes of a file; none of what is not a file or cannot be read."""
    if not is_file(path):  # a pipe would be waited for
        return b""
    try:
        with opened(path) as file:
            return file.read(PEEKED)
    except (OSError, EOFError, zlib.error):
        return b""


def _beginning(path: Path) -> tuple[list[tuple[int, str]], str | None]:
    """Lines with their numbers that stand above the first row of numbers, and this row; None where there is none.

    At least half of the fields of a row are numbers or empty, and one is a number.
    """
    text = beginning(path).decode("utf-8-sig", "ignore")
    lines: list[tuple[int, str]] = []
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip():
            continue
        fields = fields_of(line)
        numbers = sum(map(_is_number, fields))
        are_enough = numbers > 0 and 2 * (numbers + fields.count("")) >= len(fields)
        if are_enough and not _is_comment(line):
            return lines, line
        lines.append((number, line))
    return lines, None


def _is_comment(line: str) -> bool:
    return line.lstrip().startswith("#")


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def separator_of(line: str) -> str:
    """What separates the fields of a line: a comma, a semicolon or a tab."""
    return max(",;\t", key=line.count)


def fields_of(line: str) -> list[str]:
    """Fields of a line, apart by commas, semicolons or tabs, or by white space where it has none of them."""
    separator = separator_of(line)
    fields = line.split()
    if separator in line:
        fields = line.split(separator)
    if '"' in line and separator in line:
        with suppress(csv.Error):  # of a line with a null character
            return [field.strip() for field in next(csv.reader([line], delimiter=separator, skipinitialspace=True))]
    return [field.strip().strip('"') for field in fields]
