"""Estimates and truth as CSV or Parquet tables, with a row for each step of each run."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from consistency.referee.diagnostics import Evidence
from consistency.referee.diagnostics.records.large_arrays import diagonal
from consistency.referee.diagnostics.records.record import each_alone
from consistency.referee.diagnostics.records.validity import ROUNDED, Validity, classify
from consistency.referee.errors import InputError
from consistency.referee.geometry.conventions import ADDITIVE, PLANAR
from consistency.referee.readers.formats.file_kinds import is_drive, is_plane, is_poses
from consistency.referee.readers.formats.named_columns import begins_with_numbers, head_of
from consistency.referee.readers.formats.other_names import true_columns, with_clock, with_known_names
from consistency.referee.readers.formats.sheet import TableRows, read_sheet
from consistency.referee.readers.formats.table_columns import (
    POSE,
    by_run,
    cross_covariances,
    has_own,
    manifold_of,
    matched,
    nis_columns,
    require_columns,
    samples_of,
    stated_covariance,
    stated_deviations,
)
from consistency.referee.readers.heading_units import require_radians
from consistency.referee.readers.mix_ups.hints import hints
from consistency.referee.readers.options import Reading
from consistency.referee.readers.places import Places
from consistency.referee.readers.runs_to_record import Track, assemble
from consistency.referee.readers.truth_matching import Aligned, Known, NamedPoses, Poses, common_steps, common_times
from consistency.referee.types import Array

if TYPE_CHECKING:
    from consistency.referee.readers.windows import Relative


def read_tables(estimates: Path | TableRows, r: Reading, relative: Relative | None = None) -> list[Evidence]:
    """Recordings of the estimators in a table, one for each value of its column ``filter``.

    Raises
    ------
    InputError
        A file, column, line or option that cannot be used, and what is allowed.
    """
    if r.state is not None and (len(set(r.state)) < len(r.state) or not all(r.state)):
        raise InputError(f"--state {','.join(r.state)}: needs names of columns, each once")
    axes = tuple(r.state) if r.state else POSE
    sheet, truth, notes = _both(estimates, axes, r)
    estimates = sheet.path
    convention = _convention(r.error, axes, truth)
    if relative is not None and truth is None:
        raise InputError(f"{estimates}: --relative needs --truth FILE, poses in any world")
    if relative is not None and (axes != POSE or convention == "vector"):
        raise InputError(f"{estimates}: --relative needs poses x, y, heading, with --error so2, left or right")
    if r.align is not None and manifold_of(convention) != "planar":
        raise InputError(f"--align {r.align}: needs poses x,y,heading, and an error that is not 'vector'")
    if truth is None and not {"nis", "nis_dof"} <= set(sheet.data):
        others = f"columns nis and nis_dof to be judged by the NIS alone, or columns true_{axes[0]}, … beside the state"
        raise InputError(f"{estimates}: needs --truth FILE, or {others}")
    key = _key(sheet, truth, r)
    names = [estimates.stem]
    if "filter" in sheet:
        names = list(dict.fromkeys(sheet.texts("filter")))
    recordings = []
    for name in names:
        own = sheet.rows(sheet.texts("filter") == name) if "filter" in sheet else sheet
        true = truth if r.truth is not None else true_columns(own, axes)
        recordings.append(_recording(name, own, true, key, axes, convention, r, relative))
    said = tuple(note for note in notes if note)
    return [replace(recordings[0], notes=(*said, *recordings[0].notes)), *recordings[1:]]


def _both(
    estimates: Path | TableRows, axes: tuple[str, ...], r: Reading
) -> tuple[TableRows, TableRows | None, list[str]]:
    """Estimates and truth, which may stand beside them, with times where steps do not number both, and notes."""
    sheet, note = _sheet(estimates, axes, bool(r.motions))
    other, notes = None, [note]
    if r.truth is not None:
        other, note = _sheet(r.truth, axes, body=r.body)
        notes.append(note)
    timed = r.time_offset is not None or r.max_dt is not None
    if timed or not ("step" in sheet and (other is None or "step" in other)):
        sheet, other = with_clock(sheet), None if other is None else with_clock(other)
    if other is None and (other := true_columns(sheet, axes)) is not None:
        notes.append(f"{sheet.path}: the truth stands in columns beside the estimates")
    return sheet, other, notes


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
    else:
        sheet, note = planar_sheet(table, motions) if axes == POSE else (read_sheet(table), "")
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


def _key(sheet: TableRows, truth: TableRows | None, r: Reading) -> str:
    """The column that says which estimate belongs to which truth."""
    if r.time_offset is not None:
        if "t" in sheet and truth is not None and "t" in truth:
            return "t"
        raise InputError("--time-offset: needs a column t in the estimates and in the truth")
    for key in ("step", "t"):
        if key in sheet and (truth is None or key in truth):
            if r.max_dt is not None and not ("t" in sheet and truth is not None and "t" in truth):
                raise InputError("--max-dt: needs a column t in the estimates and in the truth")
            return key
    if truth is not None and ("step" in sheet or "t" in sheet):
        has = "step" if "step" in sheet else "t"
        raise InputError(f"{truth.path}: column '{has}' is missing; {sheet.path} is numbered by it")
    spaced = len(sheet.data) == 1 and " " in sheet.columns
    hint = "; separate columns by commas, semicolons or tabs" * spaced
    raise InputError(f"{sheet.path}: column 'step' or 't' is missing; there are: {sheet.columns}{hint}")


def _recording(
    name: str,
    sheet: TableRows,
    truth: TableRows | None,
    key: str,
    axes: tuple[str, ...],
    convention: str,
    r: Reading,
    relative: Relative | None,
) -> Evidence:
    sheet, runs = by_run(sheet, key)
    keys = sheet.numbers(key, finite=True)
    numbers = [int(run) for run in np.unique(runs)]
    members = [np.flatnonzero(runs == run) for run in numbers]
    notes: list[str] = []
    causes: list[str] = []
    moved, deviations = Aligned(()), None
    of_runs: list[dict[str, Array | None]]
    if truth is None:
        there = [sheet.numbers(axis) for axis in axes if axis in sheet]
        broken = ~np.isfinite(np.column_stack([np.zeros(len(runs)), *there])).all(axis=1)
        of_runs = [
            {"error": np.where(broken[rows], np.nan, 0.0)[:, None] if broken.any() else None} for rows in members
        ]
    else:
        own = convention != ADDITIVE and axes == POSE and has_own(sheet)
        deviations = None if own else stated_deviations(sheet, axes)
        covariance = stated_covariance(sheet, axes, own) if deviations is None else diagonal(deviations)
        estimate = np.column_stack([sheet.numbers(axis) for axis in axes])
        estimate[~np.isfinite(estimate).all(axis=1)] = np.nan
        samples = samples_of(truth, axes, key, r.truth_covariance)
        if relative is not None and deviations is not None:
            raise InputError(
                f"{sheet.path}: --relative needs covariances; here deviations of each component are stated"
            )
        true_of = [samples.of(run) for run in numbers]
        if missing := [run for run, true in zip(numbers, true_of, strict=True) if not len(true.keys)]:
            has = ", ".join(map(str, [] if samples.runs is None else np.unique(samples.runs)[:5]))
            raise InputError(
                f"{truth.path}: holds no run {missing[0]} (it has {has}); without a column 'run' it serves all"
            )
        moved = Aligned([
            Poses(
                Places(sheet.place, rows), keys[rows], estimate[rows], covariance[rows], np.ones(len(rows), bool),
                true.keys, true.values, manifold_of(convention), convention, r.tolerance if key == "t" else 0.0,
                true_covariance=true.covariance,
            )
            for rows, true in zip(members, true_of, strict=True)
        ])  # fmt: skip
        require_radians(str(sheet.path), moved.runs)
        shift, clocks = r.shift, list[str]()
        if relative is None:
            if key == "t" or r.align is not None:
                from consistency.referee.readers.clock_offset import clocks_and_frames

                shift, clocks, moved = clocks_and_frames(name, moved.runs, r.time_offset, r.align, range(len(axes)))
            causes = hints(name, axes, moved.runs, shift)
            clocks += [*moved.notes, *causes]
        known, notes = matched(name, sheet, truth, samples, key, numbers, members, moved.runs, shift, r.tolerance)
        if relative is not None:
            from consistency.referee.readers.relative_motions import Stretch, relative_recording

            t = sheet.numbers("t", finite=True) if "t" in sheet else np.full(len(runs), np.nan)
            cross = None if relative.motions else cross_covariances(sheet)
            stretches = [
                Stretch(
                    run, str(sheet.path), p.place, t[rows], p.estimate, p.covariance,
                    None if cross is None else cross[rows], found.rows, found.truth, convention,
                )
                for run, rows, p, found in zip(numbers, members, moved.runs, known, strict=True)
            ]  # fmt: skip
            record = relative_recording(name, str(sheet.path), stretches, axes, range(len(axes)), relative)
            return replace(record, notes=(*notes, *record.notes))
        if deviations is not None:
            notes.append(
                f"{name}: standard deviations without cross terms are stated, so each component is judged by itself"
            )
        notes += [*clocks, f"error convention {convention}: {PLANAR[convention]}"]
        if own:
            notes.append(f"{name}: the covariance is that of the columns own_P_*, which are of the filter's own error")
        if key == "step" and not (keys < 0).any():
            kinds = classify(np.concatenate([p.covariance[p.t == 0] for p in moved.runs]), ROUNDED)
            # rows of step 0 where no run is uncertain yet: the start, not an estimate
            if np.isin(kinds, (Validity.DEFICIENT, Validity.INDEFINITE)).all():
                known = [
                    Known(*(values[p.t[found.rows] != 0] for values in found))
                    for p, found in zip(moved.runs, known, strict=True)
                ]
        plane = 3 if axes[:3] == ("x", "y", "z") else 2
        of_runs = [
            {
                "error": p.error_of(found.rows, found.truth), "covariance": p.covariance[found.rows],
                "truth_covariance": p.truth_covariances(found, shift),
                "path": np.stack([found.truth[:, :plane], p.estimate[found.rows, :plane]], axis=1)
                if axes[:2] == ("x", "y") else None,
            }
            for p, found in zip(moved.runs, known, strict=True)
        ]  # fmt: skip
        members = [rows[found.rows] for rows, found in zip(members, known, strict=True)]
    nis, dof = nis_columns(sheet)
    clock = sheet.numbers("t") if "t" in sheet else None
    some = [each for each in zip(numbers, members, of_runs, strict=True) if len(each[1])]
    members = [rows for _, rows, _ in some]
    if key == "step":
        columns, steps = common_steps([keys[rows] for rows in members])
        t = np.full(len(steps), np.nan)
        if clock is not None:
            for rows, column in zip(reversed(members), reversed(columns), strict=True):
                t[column] = clock[rows]
        if not np.array_equal(steps, np.arange(1, len(steps) + 1)):
            notes.append(f"{name}: step k below is the k-th step of the file, which has {steps[0]:g} to {steps[-1]:g}")
    else:
        columns, t = common_times([keys[rows] for rows in members])
    tracks = []
    for (run, rows, arrays), column in zip(some, columns, strict=True):
        own_nis, own_dof, own_t = (None if values is None else values[rows] for values in (nis, dof, clock))
        tracks.append(Track(run, column, Places(sheet.place, rows), nis=own_nis, nis_dof=own_dof, t=own_t, **arrays))
    record = assemble(name, tracks, t, axes, str(sheet.path), convention if truth is not None else "", notes)
    record = replace(record, causes=tuple(causes))
    if truth is None:
        return replace(record, error=None, dof=0)
    return moved.on(each_alone(record) if deviations is not None else record)


# --- poses alone -------------------------------------------------------------------------------------


def table_poses(estimates: Path, r: Reading) -> Iterator[NamedPoses]:
    """Planar poses of each run of a table; covariances are not looked at."""
    sheet, truth, _ = _both(estimates, POSE, r)
    if truth is None:
        raise InputError(f"{estimates}: needs --truth FILE, poses in any world")
    if "filter" in sheet and len(set(sheet.texts("filter"))) > 1:
        raise InputError(f"{estimates}: holds several estimators in its column 'filter'; keep the rows of one")
    require_columns(sheet, POSE)
    key = _key(sheet, truth, r)
    samples = samples_of(truth, POSE, key, None)
    sheet, runs = by_run(sheet, key)
    keys, clock = sheet.numbers(key, finite=True), sheet.numbers("t") if "t" in sheet else np.full(len(runs), np.nan)
    estimate = np.column_stack([sheet.numbers(axis) for axis in POSE])
    for run in np.unique(runs):
        rows, true = np.flatnonzero(runs == run), samples.of(run)
        if not len(true.keys):
            raise InputError(f"{truth.path}: holds no run {run}; without a column 'run' it serves all")
        poses = Poses.bare(
            Places(sheet.place, rows), keys[rows], estimate[rows], true.keys, true.values, "planar",
            r.tolerance if key == "t" else 0.0,
        )  # fmt: skip
        yield NamedPoses(f"run {run}" if "run" in sheet else estimates.stem, poses, clock[rows])
