"""One estimator of the tables or files of single runs, of which each has a truth of its own."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from consistency.referee.diagnostics.records.record import Record
from consistency.referee.errors import InputError
from consistency.referee.readers.formats.file_kinds import is_drive, table_files
from consistency.referee.readers.formats.table import read_tables
from consistency.referee.readers.options import Reading
from consistency.referee.readers.truth_matching import Estimator, Poses


def read_table_folder(folder: Path, r: Reading, poses_alone: bool = False) -> list[Estimator]:
    """The estimators of a folder with a table for each run, by name, and a truth of the same stem where it is a folder.

    Raises
    ------
    InputError
        A table holds several runs, or has no truth; as :func:`read_tables`.
    """
    found = {}
    for run, file in enumerate(table_files(folder)):
        found[run] = read_tables(file, replace(r, truth=truth_of(file, r.truth)), poses_alone)
    return merged(found, folder.stem)


def truth_of(file: Path, truth: Path | None) -> Path | None:
    """The truth of one run, the table of the same stem where ``truth`` is a folder of them.

    Raises
    ------
    InputError
        The folder has none.
    """
    if truth is None or not truth.is_dir() or is_drive(truth):
        return truth
    for other in (*table_files(truth), truth / file.name):
        if other.stem == file.stem and other.exists():
            return other
    raise InputError(f"--truth {truth}: holds no table '{file.stem}' for {file}")


def merged(
    found: Mapping[int, Sequence[Estimator | Record]], name: str, failed: Mapping[int, str] | None = None
) -> list[Estimator]:
    """The estimators of all runs by name, from what a reader gives of each run.

    Parameters
    ----------
    found : by run, the estimators in its files; a run without one of them has failed for it
    name : of an estimator that is called after its file
    failed : runs without any estimates, and why they have none

    Raises
    ------
    InputError
        The files of a run hold several runs, or the runs have different states or kinds of covariances.
    """
    by_name: dict[str, dict[int, Estimator]] = {}
    for run, of_run in found.items():
        for one in of_run:
            if isinstance(one, Record):
                raise InputError(f"{one.name}: a run needs errors with covariances, not their NEES alone")
            if len(one.runs) != 1:
                raise InputError(f"{one.path}: holds {len(one.runs)} runs; write one run into each file")
            label = one.name if one.name != one.path.stem else name
            by_name.setdefault(label, {})[run] = one
    return [_one_estimator(label, runs, found, failed or {}) for label, runs in by_name.items()]


def _one_estimator(
    name: str, own: Mapping[int, Estimator], all_runs: Iterable[int], failed: Mapping[int, str]
) -> Estimator:
    first = next(iter(own.values()))
    poses: list[Poses] = []
    for run, one in own.items():
        if (one.axes, one.stated, one.convention) != (first.axes, first.stated, first.convention):
            raise InputError(f"{one.path}: has another state or kind of covariance than {first.path}")
        poses.append(replace(one.runs[0], run=run))
    without = dict.fromkeys(set(all_runs).difference(own), f"it holds no estimates of '{name}'")
    t = first.t
    notes: dict[str, str] = {}
    causes: dict[str, str] = {}
    if t is not None:
        t = max((one.t for one in own.values() if one.t is not None), key=len)
    for one in reversed(list(own.values())):
        notes |= {_without_paths(note, one): note for note in one.notes}
        causes |= {_without_paths(cause, one): cause for cause in one.causes}
    return replace(
        first, name=name, label=name, runs=poses, t=t, failed={**without, **failed},
        notes=list(reversed(notes.values())), causes=list(reversed(causes.values())),
    )  # fmt: skip


def _without_paths(note: str, one: Estimator) -> str:
    """A note as the files of every run would have it."""
    for path in (one.path, *one.runs[0].files):
        note = note.replace(str(path), "")
    return note
