"""A folder of tables, with one for each run, as a folder of trajectories."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from consistency.referee.errors import InputError
from consistency.referee.readers.formats.file_kinds import is_drive, table_files
from consistency.referee.readers.formats.table import read_tables
from consistency.referee.readers.options import Reading
from consistency.referee.readers.places import one_of_each_kind
from consistency.referee.readers.truth_matching import Estimator


def read_folder(folder: Path, r: Reading, poses_alone: bool = False) -> list[Estimator]:
    """The estimators in the tables of a folder, each of which is a run, or several in a column ``run``.

    The truth is one file for all, or a folder with files of the same names.

    Raises
    ------
    InputError
        As :func:`read_tables`; or a file has no truth, or lacks an estimator or a form that another one has.
    """
    files = table_files(folder)
    parts: dict[str, list[Estimator]] = {}
    for path in files:
        for one in read_tables(path, replace(r, truth=_truth_of(path, r.truth)), poses_alone):
            name = folder.name if one.name == path.stem else one.name
            parts.setdefault(name, []).append(one)
    for name, found in parts.items():
        if len(found) < len(files):
            raise InputError(f"{folder}: '{name}' is in {len(found)} of {len(files)} tables, each of which is a run")
    return [_joined(name, folder, found) for name, found in parts.items()]


def _truth_of(path: Path, truth: Path | None) -> Path | None:
    """The truth of a table."""
    if truth is None or not truth.is_dir() or is_drive(truth):
        return truth
    matches = [other for other in sorted(truth.iterdir()) if other.stem == path.stem]
    if not matches:
        raise InputError(f"--truth {truth}: holds no file '{path.stem}' for {path}")
    return matches[0]


def _joined(name: str, folder: Path, parts: Sequence[Estimator]) -> Estimator:
    """Estimators of one file each as one, whose runs are numbered from 0 on."""
    first = parts[0]
    for part in parts[1:]:
        if part.stated != first.stated or part.runs[0].numbered != first.runs[0].numbered:
            raise InputError(
                f"{part.path}: is numbered otherwise, or states its covariance otherwise, than {first.path}"
            )
    runs = [replace(run, run=i) for i, run in enumerate(run for part in parts for run in part.runs)]
    notes = one_of_each_kind(note for part in parts for note in part.notes)
    return replace(first, name=name, path=folder, runs=runs, notes=notes)
