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
from consistency.referee.geometry.conventions import ADDITIVE, PLANAR, planar_error
from consistency.referee.readers.alignment.align import Aligned
from consistency.referee.readers.file_kinds import is_drive, is_plane, is_poses
from consistency.referee.readers.formats.named_columns import begins_with_numbers, head_of
from consistency.referee.readers.formats.sheet import Places, TableRows, read_sheet
from consistency.referee.readers.formats.table_columns import (
    POSE,
    cross_covariances,
    has_own,
    nis_columns,
    present_columns,
    require_columns,
    row_order,
    stated_covariance,
    stated_deviations,
)
from consistency.referee.readers.formats.table_truth import Samples, manifold_of, matched, samples_of
from consistency.referee.readers.matching import common_steps, common_times
from consistency.referee.readers.mix_ups.hints import hints
from consistency.referee.readers.options import Reading
from consistency.referee.readers.poses import NamedPoses, Poses
from consistency.referee.readers.runs_to_record import Track, assemble
from consistency.referee.types import Array

if TYPE_CHECKING:
    from consistency.referee.readers.relative_motions import Stretch
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
    truth, axes = r.truth, tuple(r.state) if r.state else POSE
    sheet, note = _sheet(estimates, axes, bool(r.motions))
    estimates = sheet.path
    convention = _convention(r.error, axes, truth)
    if relative is not None:
        require_poses(estimates, axes, convention, truth)
    if r.align is not None and manifold_of(convention) != "planar":
        raise InputError(f"--align {r.align}: needs poses x,y,heading, and an error that is not 'vector'")
    other, notes = None, [note]
    if truth is not None:
        other, note = _sheet(truth, axes, body=r.body)
        notes.append(note)
    if other is None and not {"nis", "nis_dof"} <= set(sheet.data):
        raise InputError(f"{estimates}: needs --truth FILE, or columns nis and nis_dof to be judged by the NIS alone")
    key = _key(sheet, other, r)
    names = [estimates.stem]
    if "filter" in sheet:
        names = list(dict.fromkeys(sheet.texts("filter")))
    recordings = []
    for name in names:
        own = sheet.rows(sheet.texts("filter") == name) if "filter" in sheet else sheet
        recordings.append(_recording(name, own, other, key, axes, convention, r, relative))
    said = tuple(note for note in notes if note)
    return [replace(recordings[0], notes=(*said, *recordings[0].notes)), *recordings[1:]]


def _sheet(
    table: Path | TableRows, axes: tuple[str, ...], motions: bool = False, body: str | None = None
) -> tuple[TableRows, str]:
    """Rows of a file or a drive, or those in memory, and what they were read as."""
    if isinstance(table, TableRows):
        return table, ""
    if is_drive(table):
        from consistency.referee.readers.formats.kitti_oxts import drive_sheet

        return drive_sheet(table, body), ""
    return planar_sheet(table, motions) if axes == POSE else (read_sheet(table), "")


def planar_sheet(path: Path, motions: bool = False) -> tuple[TableRows, str]:
    """A table of planar poses, and what it was read as where it has no columns x, y, heading."""
    head = None if path.suffix.lower() in (".parquet", ".pq") or not path.is_file() else head_of(path)
    named = head is not None and not head.comment and set(POSE) <= set(head.names)
    if (head is None and not begins_with_numbers(path)) or named or not (is_poses(path) or is_plane(path)):
        return read_sheet(path), ""
    from consistency.referee.readers.formats.planar_columns import read_plane

    return read_plane(path, motions)


def _convention(convention: str | None, axes: tuple[str, ...], truth: Path | None) -> str:
    if convention is not None and truth is None:
        raise InputError("--error needs --truth: without truth there is no error")
    if axes == POSE:
        if convention not in (None, *PLANAR):
            raise InputError(f"--error {convention}: for x, y, heading it is one of {', '.join(PLANAR)}")
        return convention or "so2"
    if convention not in (None, "vector"):
        raise InputError(f"--error {convention}: needs the states x,y,heading; for {','.join(axes)} it is 'vector'")
    return "vector"


def require_poses(path: Path, axes: tuple[str, ...], convention: str, truth: Path | None) -> None:
    """Refuse windows unless the table has planar poses beside a truth."""
    if truth is None:
        raise InputError(f"{path}: --relative needs --truth FILE, poses in any world")
    if axes != POSE or convention == "vector":
        raise InputError(f"{path}: --relative needs poses x, y, heading, with --error so2, left or right")


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
    runs = sheet.numbers("run", whole=True).astype(int) if "run" in sheet else np.zeros(len(sheet), int)
    order = row_order(sheet, runs, key)
    sheet, runs = sheet.rows(order), runs[order]
    keys = sheet.numbers(key, finite=True)
    error = covariance = deviations = of_truth = path = None
    keep = np.ones(len(runs), bool)
    notes: list[str] = []
    moved = Aligned(())
    if truth is None:
        broken = ~np.isfinite(np.column_stack([np.zeros(len(runs)), *present_columns(sheet, axes)])).all(axis=1)
        error = None if not broken.any() else np.where(broken, np.nan, 0.0)[:, None]
    else:
        own = convention != ADDITIVE and axes == POSE and has_own(sheet)
        deviations = None if own else stated_deviations(sheet, axes)
        covariance = stated_covariance(sheet, axes, own) if deviations is None else diagonal(deviations)
        estimate = np.column_stack([sheet.numbers(axis) for axis in axes])
        estimate[~np.isfinite(estimate).all(axis=1)] = np.nan
        samples = samples_of(truth, axes, key, r.truth_covariance)
        shift, clocks = 0.0, list[str]()
        if relative is not None and deviations is not None:
            raise InputError(
                f"{sheet.path}: --relative needs covariances; here deviations of each component are stated"
            )
        if relative is not None:
            shift = r.shift
        elif key == "step" and r.align is None:
            clocks = hints(name, axes, _poses(sheet, samples, runs, keys, estimate, covariance, convention, 0.0))
        else:
            reach = r.tolerance if key == "t" else 0.0
            poses = _poses(sheet, samples, runs, keys, estimate, covariance, convention, reach)
            from consistency.referee.readers.clock_offset import clocks_and_frames

            shift, clocks, moved = clocks_and_frames(name, poses, r.time_offset, r.align, range(len(axes)))
            clocks += [*moved.notes, *hints(name, axes, moved.runs, shift)]
            if r.align is not None:
                there = np.isin(runs, np.unique(samples.runs)) if samples.runs is not None else np.ones(len(runs), bool)
                estimate[there] = np.concatenate([p.estimate for p in moved.runs])
                covariance[there] = np.concatenate([p.covariance for p in moved.runs])
        keep, true, of_truth, notes = matched(
            name, sheet, truth, samples, runs, keys + shift, key, axes, convention, r.tolerance
        )
        if relative is not None:
            from consistency.referee.readers.relative_motions import relative_recording

            stretches = _stretches(sheet, runs, keep, true, estimate, covariance, convention, relative)
            record = relative_recording(name, str(sheet.path), stretches, axes, range(len(axes)), relative)
            return replace(record, notes=(*notes, *record.notes))
        if deviations is not None:
            notes.append(
                f"{name}: standard deviations without cross terms are stated, so each component is judged by itself"
            )
        notes += clocks
        error = planar_error(true, estimate, convention) if axes == POSE else true - estimate
        plane = 3 if axes[:3] == ("x", "y", "z") else 2
        path = np.stack([true[:, :plane], estimate[:, :plane]], axis=1) if axes[:2] == ("x", "y") else None
        notes.append(f"error convention {convention}: {PLANAR[convention]}")
        if own:
            notes.append(f"{name}: the covariance is that of the columns own_P_*, which are of the filter's own error")
        if key == "step":
            keep &= ~_exact_start(keys, covariance)
    nis, dof = nis_columns(sheet)
    numbers = [int(run) for run in np.unique(runs[keep])]
    members = [np.flatnonzero(keep & (runs == run)) for run in numbers]
    if key == "step":
        columns, steps = common_steps([keys[rows] for rows in members])
        t = np.full(len(steps), np.nan)
        if "t" in sheet:
            times = sheet.numbers("t")
            for rows, column in zip(reversed(members), reversed(columns), strict=True):
                t[column] = times[rows]
        if not np.array_equal(steps, np.arange(1, len(steps) + 1)):
            notes.append(f"{name}: step k below is the k-th step of the file, which has {steps[0]:g} to {steps[-1]:g}")
    else:
        columns, t = common_times([keys[rows] for rows in members])
    clock = sheet.numbers("t") if "t" in sheet else None
    tracks = [
        Track(
            run,
            column,
            Places(sheet.place, rows),
            *(
                None if values is None else values[rows]
                for values in (error, covariance, nis, dof, None, clock, of_truth, path)
            ),
        )
        for run, rows, column in zip(numbers, members, columns, strict=True)
    ]
    record = assemble(name, tracks, t, axes, str(sheet.path), convention if truth is not None else "", notes)
    if truth is None:
        return replace(record, error=None, dof=0)
    return moved.on(each_alone(record) if deviations is not None else record)


def _stretches(
    sheet: TableRows, runs: Array, keep: Array, true: Array, estimate: Array, covariance: Array, convention: str,
    relative: Relative,
) -> list[Stretch]:  # fmt: skip
    """Each run before its windows are taken."""
    from consistency.referee.readers.relative_motions import Stretch

    t = sheet.numbers("t", finite=True) if "t" in sheet else np.full(len(runs), np.nan)
    cross = None if relative.motions else cross_covariances(sheet)
    found = []
    for run in np.unique(runs[keep]):
        rows = np.flatnonzero(runs == run)
        known = np.flatnonzero(keep[rows])
        found.append(
            Stretch(
                int(run), str(sheet.path), Places(sheet.place, rows), t[rows], estimate[rows], covariance[rows],
                None if cross is None else cross[rows], known, true[rows[known]], convention,
            )
        )  # fmt: skip
    return found


def _poses(
    sheet: TableRows,
    samples: Samples,
    runs: Array,
    t: Array,
    estimate: Array,
    covariance: Array,
    convention: str,
    max_dt: float,
) -> list[Poses]:
    """Each run that has a truth, with it."""
    found = []
    for run in np.unique(runs):
        rows, true = np.flatnonzero(runs == run), samples.of(run)
        if len(true.keys):
            place = Places(sheet.place, rows)
            found.append(
                Poses(
                    place, t[rows], estimate[rows], covariance[rows], np.ones(len(rows), bool), true.keys, true.values,
                    manifold_of(convention), convention, max_dt,
                )
            )  # fmt: skip
    return found


def _exact_start(steps: Array, covariance: Array) -> Array:
    """Rows of step 0 where no run is uncertain yet: the start, not an estimate."""
    start: Array = steps == 0
    if not start.any() or (steps < 0).any() or not _is_exact(covariance[start]):
        return np.zeros(len(steps), bool)
    return start


def _is_exact(covariance: Array) -> bool:
    return bool(np.isin(classify(covariance, ROUNDED), (Validity.DEFICIENT, Validity.INDEFINITE)).all())


# --- poses alone -------------------------------------------------------------------------------------


def table_poses(estimates: Path, r: Reading) -> Iterator[NamedPoses]:
    """Planar poses of each run of a table; covariances are not looked at."""
    if r.truth is None:
        raise InputError(f"{estimates}: needs --truth FILE, poses in any world")
    (sheet, _), (truth, _) = _sheet(estimates, POSE, bool(r.motions)), _sheet(r.truth, POSE, body=r.body)
    if "filter" in sheet and len(set(sheet.texts("filter"))) > 1:
        raise InputError(f"{estimates}: holds several estimators in its column 'filter'; keep the rows of one")
    require_columns(sheet, POSE)
    key = _key(sheet, truth, r)
    samples = samples_of(truth, POSE, key, None)
    runs = sheet.numbers("run", whole=True).astype(int) if "run" in sheet else np.zeros(len(sheet), int)
    order = row_order(sheet, runs, key)
    sheet, runs = sheet.rows(order), runs[order]
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
