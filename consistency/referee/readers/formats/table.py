"""Estimates and truth as CSV, Parquet or JSON tables, or tables in memory, with a row for each step of each run."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from consistency.referee.diagnostics.records.large_arrays import diagonal
from consistency.referee.diagnostics.words.numbers import plural
from consistency.referee.errors import InputError
from consistency.referee.geometry.conventions import ADDITIVE, PLANAR
from consistency.referee.readers.estimator import ALONE, WHOLE, Estimator, Stated
from consistency.referee.readers.formats.file_kinds import is_drive, is_plane, is_poses
from consistency.referee.readers.formats.named_columns import begins_with_numbers, head_of
from consistency.referee.readers.formats.other_names import true_columns, with_clock, with_known_names
from consistency.referee.readers.formats.sheet import TableRows, read_sheet
from consistency.referee.readers.formats.table_columns import (
    POSE,
    by_run,
    cross_covariances,
    has_own,
    nis_columns,
    require_columns,
    stated_covariance,
    stated_deviations,
)
from consistency.referee.readers.options import COLUMNS, Reading
from consistency.referee.readers.places import Places
from consistency.referee.readers.runs_to_record import listed
from consistency.referee.readers.truth_matching import Manifold, Poses, unstated
from consistency.referee.types import Array, Indices


def read_tables(estimates: Path | TableRows, r: Reading, poses_alone: bool = False) -> list[Estimator]:
    """The estimators in a table, one for each value of its column ``filter``.

    Parameters
    ----------
    poses_alone : covariances are not looked at

    Raises
    ------
    InputError
        A file, column, line or option that cannot be used, and what is allowed.
    """
    if r.state is not None and (len(set(r.state)) < len(r.state) or not all(r.state)):
        raise InputError(f"--state {','.join(r.state)}: needs names of columns, each once")
    axes = tuple(r.state) if r.state else POSE
    sheet, truth, notes = _both(estimates, axes, r)
    convention = _convention(r.error, axes, truth)
    _require_truth(sheet, truth, axes, convention, r)
    key = _key(sheet, truth, r)
    names = [sheet.path.stem]
    if "filter" in sheet:
        names = list(dict.fromkeys(sheet.texts("filter")))
    found = []
    for name in names:
        own = sheet.rows(sheet.texts("filter") == name) if "filter" in sheet else sheet
        true = truth if r.truth is not None else true_columns(own, axes)
        if true is None:
            found.append(_innovations(name, own, key, axes))
        else:
            found.append(_estimator(name, own, true, key, axes, convention, r, poses_alone))
    return [replace(found[0], notes=(*notes, *found[0].notes)), *found[1:]]


def _both(
    estimates: Path | TableRows, axes: tuple[str, ...], r: Reading
) -> tuple[TableRows, TableRows | None, list[str]]:
    """Estimates and truth, which may stand beside them, with times where steps do not number both, and notes."""
    sheet, note = _sheet(estimates, axes, bool(r.motions))
    other, notes = None, [sheet.cut, note]
    if r.truth is not None:
        other, note = _sheet(r.truth, axes, body=r.body)
        notes = [sheet.cut, other.cut, *notes[1:], note]
    timed = r.time_offset is not None or r.max_dt is not None
    if timed or not ("step" in sheet and (other is None or "step" in other)):
        sheet, other = with_clock(sheet), None if other is None else with_clock(other)
    if other is None and (other := true_columns(sheet, axes)) is not None:
        notes.append(f"{sheet.path}: the truth stands in columns beside the estimates")
    return sheet, other, [note for note in notes if note]


def _sheet(
    table: Path | TableRows, axes: tuple[str, ...], motions: bool = False, body: str | None = None
) -> tuple[TableRows, str]:
    """Rows of a file or a drive, or those in memory, under the names of docs/files.md, and what they were read as."""
    note = ""
    if isinstance(table, TableRows):
        sheet = table
    elif is_drive(table):
        from consistency.referee.readers.formats.kitti_files import drive_sheet

        sheet = drive_sheet(table, body)
    elif axes == POSE:
        sheet, note = planar_sheet(table, motions)
    else:
        sheet = read_sheet(table)
    sheet, taken = with_known_names(sheet, axes)
    return sheet, "; ".join(filter(None, (note, taken)))


def planar_sheet(path: Path, motions: bool = False) -> tuple[TableRows, str]:
    """A table of planar poses, and what it was read as where it has no columns x, y, heading."""
    head = None if path.suffix.lower() in (".parquet", ".pq") or not path.is_file() else head_of(path)
    named = head is not None and not head.comment and set(POSE) <= set(head.names)
    if (head is None and not begins_with_numbers(path)) or named or not (is_poses(path) or is_plane(path)):
        return read_sheet(path), ""
    from consistency.referee.readers.formats.planar_columns import read_plane

    return read_plane(path, motions)


# --- what goes together ------------------------------------------------------------------------------


def _convention(convention: str | None, axes: tuple[str, ...], truth: TableRows | None) -> str:
    if convention is not None and truth is None:
        raise InputError("--error needs --truth: without truth there is no error")
    if axes == POSE:
        if convention not in (None, *PLANAR):
            raise InputError(f"--error {convention}: for x, y, heading it is one of {', '.join(PLANAR)}")
        return convention or "so2"
    if convention not in (None, "vector"):
        raise InputError(f"--error {convention}: needs the states x,y,heading; for {','.join(axes)} it is 'vector'")
    return "vector"


def _require_truth(
    sheet: TableRows, truth: TableRows | None, axes: tuple[str, ...], convention: str, r: Reading
) -> None:
    """Refuse options that need a truth, or poses, where there are none."""
    if r.relative is not None and truth is None:
        raise InputError(f"{sheet.path}: --relative needs --truth FILE, poses in any world")
    if r.relative is not None and (axes != POSE or convention == "vector"):
        raise InputError(f"{sheet.path}: --relative needs poses x, y, heading, with --error so2, left or right")
    if r.align is not None and convention == "vector":
        raise InputError(f"--align {r.align}: needs poses x,y,heading, and an error that is not 'vector'")
    if truth is None and not {"nis", "nis_dof"} <= set(sheet.data):
        others = f"columns nis and nis_dof to be judged by the NIS alone, or columns true_{axes[0]}, … beside the state"
        raise InputError(f"{sheet.path}: needs --truth FILE, or {others}")
    if r.truth_covariance not in (None, COLUMNS):
        raise InputError(f"--truth-covariance {r.truth_covariance}: for tables it is '{COLUMNS}', those of the truth")


def _key(sheet: TableRows, truth: TableRows | None, r: Reading) -> str:
    """The column that says which estimate belongs to which truth."""
    timed = "t" in sheet and truth is not None and "t" in truth
    if r.time_offset is not None:
        if timed:
            return "t"
        raise InputError("--time-offset: needs a column t in the estimates and in the truth")
    for key in ("step", "t"):
        if key in sheet and (truth is None or key in truth):
            if r.max_dt is not None and not timed:
                raise InputError("--max-dt: needs a column t in the estimates and in the truth")
            return key
    if truth is not None and ("step" in sheet or "t" in sheet):
        has = "step" if "step" in sheet else "t"
        raise InputError(f"{truth.path}: column '{has}' is missing; {sheet.path} is numbered by it")
    hint = ""
    if len(sheet.data) == 1 and " " in sheet.columns:
        hint = "; separate columns by commas, semicolons or tabs"
    raise InputError(f"{sheet.path}: column 'step' or 't' is missing; there are: {sheet.columns}{hint}")


# --- poses -------------------------------------------------------------------------------------------


def _runs(sheet: TableRows, runs: Array, key: str) -> Iterator[tuple[Indices, Poses]]:
    """Rows of each run, and its poses without a state: zeros that are known in every step."""
    keys, nis, dof = sheet.numbers(key, finite=True), *nis_columns(sheet)
    clock = sheet.numbers("t") if "t" in sheet else None
    for run in np.unique(runs):
        rows = np.flatnonzero(runs == run)
        t, nothing = keys[rows], np.zeros((len(rows), 1))
        own_clock, own_nis, own_dof = (None if values is None else values[rows] for values in (clock, nis, dof))
        yield rows, Poses(
            Places(sheet.place, rows), t, nothing, *unstated(len(rows), 1), t, nothing, "vector", "vector", 0.0,
            run=int(run), name=f"run {run}" if "run" in sheet else sheet.path.stem, numbered=key == "step",
            clock=own_clock, nis=own_nis, nis_dof=own_dof, open_end=sheet.open_end(int(rows[-1])),
        )  # fmt: skip


def _innovations(name: str, sheet: TableRows, key: str, axes: Sequence[str]) -> Estimator:
    """Innovations without a truth; a row whose state is broken has no estimate."""
    sheet, runs = by_run(sheet, key)
    there = [sheet.numbers(axis) for axis in axes if axis in sheet]
    state = np.column_stack([np.zeros(len(runs)), *there])
    poses = [replace(one, estimate=state[rows]) for rows, one in _runs(sheet, runs, key)]
    return Estimator(name, sheet.path, poses, axes, innovations_alone=True)


def _estimator(
    name: str,
    sheet: TableRows,
    truth: TableRows,
    key: str,
    axes: tuple[str, ...],
    convention: str,
    r: Reading,
    poses_alone: bool,
) -> Estimator:
    """The runs of an estimator beside their truth."""
    require_columns(sheet, axes)
    require_columns(truth, axes)
    (sheet, runs), (truth, true_runs) = by_run(sheet, key), by_run(truth, key)
    notes, stated, cross = _absent(name, truth, runs, true_runs), WHOLE, None
    if poses_alone:
        covariance, known = unstated(len(sheet), len(axes))
    else:
        covariance, stated, said = _covariance(name, sheet, axes, convention)
        known, notes = np.ones(len(sheet), bool), [*notes, *said]
    if r.relative is not None and not r.motions:
        cross = cross_covariances(sheet)
    estimate = np.column_stack([sheet.numbers(axis) for axis in axes])
    estimate[~np.isfinite(estimate).all(axis=1)] = np.nan
    true, true_keys = np.column_stack([truth.numbers(axis, finite=True) for axis in axes]), truth.numbers(key)
    of_truth = None if r.truth_covariance is None else stated_covariance(truth, axes)
    true_clock = truth.numbers("t") if "t" in truth else None
    manifold: Manifold = "vector" if convention == "vector" else "planar"
    poses = []
    for rows, one in _runs(sheet, runs, key):
        its = slice(None) if "run" not in truth else np.flatnonzero(true_runs == one.run)
        if not len(true_keys[its]):
            has = ", ".join(map(str, np.unique(true_runs)[:5]))
            raise InputError(
                f"{truth.path}: holds no run {one.run} (it has {has}); without a column 'run' it serves all"
            )
        cross_of, P_of, clock_of = (None if each is None else each[index]
                                    for each, index in ((cross, rows), (of_truth, its), (true_clock, its)))  # fmt: skip
        poses.append(
            replace(
                one, estimate=estimate[rows], covariance=covariance[rows], stated=known[rows], true_t=true_keys[its],
                truth=true[its], manifold=manifold, convention=convention, cross=cross_of, true_covariance=P_of,
                true_clock=clock_of, max_dt=r.tolerance if key == "t" else 0.0, files=(sheet.path, truth.path),
            )
        )  # fmt: skip
    position = 0
    if axes[:2] == ("x", "y"):
        position = 3 if axes[2:3] == ("z",) else 2
    return Estimator(
        name, sheet.path, poses, axes, convention, PLANAR[convention], stated, notes=notes, position=position
    )


def _covariance(name: str, sheet: TableRows, axes: tuple[str, ...], convention: str) -> tuple[Array, Stated, list[str]]:
    """Covariances (N, n, n), which of them are stated, and notes on them."""
    if convention != ADDITIVE and axes == POSE and has_own(sheet):
        of = "is that of the columns own_P_*, which are of the filter's own error"
        return stated_covariance(sheet, axes, own=True), WHOLE, [f"{name}: the covariance {of}"]
    deviations = stated_deviations(sheet, axes)
    if deviations is None:
        return stated_covariance(sheet, axes), WHOLE, []
    note = f"{name}: standard deviations without cross terms are stated, so each component is judged by itself"
    return diagonal(deviations), ALONE, [note]


def _absent(name: str, truth: TableRows, runs: Array, true_runs: Array) -> list[str]:
    """A note on runs of the truth without estimates."""
    absent = sorted({*true_runs.tolist()} - {*runs.tolist()}) if "run" in truth else []
    if not absent:
        return []
    remedy = "if the filter broke down there, write a row of NaN, so that the failure counts"
    return [f"{name}: no estimates of {plural(len(absent), 'run')} of the truth ({listed(absent)}); {remedy}"]
