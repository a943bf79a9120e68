"""Estimates and truth as CSV, Parquet or JSON tables, or tables in memory, with a row for each step of each run."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from consistency.referee.column_names import POSE
from consistency.referee.diagnostics.number_words import plural
from consistency.referee.diagnostics.whitening import diagonal
from consistency.referee.errors import InputError
from consistency.referee.geometry import ADDITIVE, PLANAR
from consistency.referee.readers.formats import table_columns as columns
from consistency.referee.readers.formats.columns import Columns, covariance_columns, is_pose, naming
from consistency.referee.readers.formats.file_kinds import are_planar, are_poses, begins_with_numbers, head_of, is_drive
from consistency.referee.readers.formats.sheet import TableRows, read_sheet
from consistency.referee.readers.options import COLUMNS, Reading, flag_of
from consistency.referee.readers.places import listed
from consistency.referee.readers.truth_matching import (
    ALONE,
    WHOLE,
    Bounds,
    Estimator,
    Poses,
    Stated,
    StatedError,
    finite_rows,
    make_poses,
    manifold_of,
    unstated,
)
from consistency.referee.types import Array


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
    state = r.components.state
    if state is not None and (len(set(state)) < len(state) or not all(state)):
        raise InputError(f"--state {','.join(state)}: needs names of columns, each once")
    axes = tuple(r.components.members or state or _own_state(estimates, r) or POSE)
    sheet, truth, notes = _both(estimates, axes, r)
    if state is None and r.components.members is None and axes != tuple(POSE):
        what = "covariance P_* says" if r.statement.level is None else "bounds say"
        notes.append(f"{sheet.path}: the state is {','.join(axes)}, as its {what}; --state names another")
    convention = _convention(r.conventions.error, axes, truth) if r.components.members is None else "vector"
    _require_truth(sheet, truth, axes, convention, r)
    key = _key(sheet, truth, r)
    of_filters = {sheet.path.stem: sheet}
    if "filter" in sheet:
        filters = sheet.texts("filter")
        of_filters = {name: sheet.rows(filters == name) for name in dict.fromkeys(filters)}
    found = []
    for name, own in of_filters.items():
        true = truth if r.sources.truth is not None else columns.true_columns(own, axes)
        if true is None:
            found.append(_innovations(name, own, key, axes))
        else:
            found.append(_estimator(name, own, true, key, axes, convention, r, poses_alone))
    first = found[0]
    return [replace(first, notes=(*notes, *first.notes)), *found[1:]]


def _both(
    estimates: Path | TableRows, axes: tuple[str, ...], r: Reading
) -> tuple[TableRows, TableRows | None, list[str]]:
    """Estimates and truth, which may stand beside them, with times where steps do not number both, and notes."""
    sheet, read_as = _sheet(estimates, axes, r.components.columns, bool(r.runs.motions))
    notes = [sheet.cut, read_as]
    truth = None
    if r.components.members is not None:
        from consistency.referee.readers.formats.members import with_means

        sheet = with_means(sheet, r.components.members)
    if r.sources.repeats:
        from consistency.referee.readers.formats.members import beside_first_run

        sheet, truth = beside_first_run(sheet, axes)
    elif r.sources.truth is not None:
        truth, read_as = _sheet(r.sources.truth, axes, r.components.truth_columns, body=r.sources.body)
        run = (r.components.columns or {}).get("run")
        if run is not None and run in truth and "run" not in truth:  # of the same name in both
            truth = truth.renamed({"run": run})
        notes = [sheet.cut, truth.cut, notes[1], read_as]
    if r.statement.level is not None:
        from consistency.referee.readers.formats.bounds import with_centres

        sheet = with_centres(sheet)
    sheet, truth, by_name = columns.paired_by_name(sheet, truth, axes)
    is_alone = truth is None and columns.true_columns(sheet, axes) is None
    sheet, of_nis = columns.with_nis(sheet, r.statement.dof, required=is_alone)
    notes += by_name, of_nis
    by_step = "step" in sheet and (truth is None or "step" in truth)
    if not by_step or r.matching.time_offset is not None or r.matching.max_dt is not None:
        sheet = columns.with_clock(sheet)
        if truth is not None:
            truth = columns.with_clock(truth)
    if truth is None:
        truth = columns.true_columns(sheet, axes)
        missing = columns.missing_truth(sheet, axes)
        if truth is not None:
            notes.append(f"{sheet.path}: the truth stands in columns beside the estimates")
        elif missing:
            notes.append(f"{sheet.path}: only the NIS is read, because the truth cannot be used: {missing}")
    return sheet, truth, [note for note in notes if note]


def _own_state(table: Path | TableRows, r: Reading) -> list[str]:
    """The state of a table of estimates that names it in its covariance or its bounds; none of poses."""
    if isinstance(table, TableRows):
        names = list(table.renamed(r.components.columns).data)
    elif table.suffix.lower() == ".csv":
        head = head_of(table, r.components.columns)
        names = [] if head is None else head.names
    else:
        names = [] if r.statement.level is None else list(read_sheet(table, r.components.columns).data)
    if r.statement.level is not None:
        from consistency.referee.readers.formats.bounds import require_gaussian, state_of_bounds

        if state := state_of_bounds(names):
            return state
        require_gaussian(str(table.path if isinstance(table, TableRows) else table), r.statement)
    state = columns.stated_state(names)
    if not state and not covariance_columns(names, POSE).places and not columns.has_nis(names):
        _require_no_bounds(table.path if isinstance(table, TableRows) else table, names)
    return state


def _sheet(
    table: Path | TableRows,
    axes: tuple[str, ...],
    renaming: Columns | None = None,
    motions: bool = False,
    body: str | None = None,
) -> tuple[TableRows, str]:
    """Rows of a file or a drive, or those in memory, under the names of docs/files.md, and what they were read as."""
    note = ""
    if isinstance(table, TableRows):
        sheet = table.renamed(renaming)
    elif is_drive(table):
        from consistency.referee.readers.formats.kitti_files import drive_sheet

        sheet = drive_sheet(table, body)
    elif is_pose(axes):
        sheet, note = planar_sheet(table, motions, renaming)
    else:
        sheet = read_sheet(table, renaming)
    sheet, taken = columns.with_known_names(sheet, axes)
    return sheet, "; ".join(filter(None, (note, taken)))


def planar_sheet(path: Path, motions: bool = False, renaming: Columns | None = None) -> tuple[TableRows, str]:
    """A table of planar poses, and what it was read as where it has no columns x, y, heading."""
    head = None
    if path.suffix.lower() not in (".parquet", ".pq") and path.is_file():
        head = head_of(path, renaming)
    is_table = head is None and not begins_with_numbers(path)
    if head is not None:
        is_table = not head.comment and set(POSE) <= set(head.names)
    if is_table or not (are_poses(path, head) or are_planar(head)):
        return read_sheet(path, renaming), ""
    from consistency.referee.readers.formats.pose_rows import read_plane

    return read_plane(path, head, motions)


# --- what goes together ------------------------------------------------------------------------------


def _convention(convention: str | None, axes: tuple[str, ...], truth: TableRows | None) -> str:
    if convention is not None and truth is None:
        raise InputError("--error needs --truth: without truth there is no error")
    if is_pose(axes):
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
    if r.runs.relative is not None and truth is None:
        raise InputError(f"{sheet.path}: --relative needs --truth FILE, poses in any world")
    if r.runs.relative is not None and (not is_pose(axes) or convention == "vector"):
        raise InputError(f"{sheet.path}: --relative needs poses x, y, heading, with --error so2, left or right")
    if r.matching.align is not None and convention == "vector":
        raise InputError(f"--align {r.matching.align}: needs poses x,y,heading, and an error that is not 'vector'")
    if truth is None and not sheet.has("nis", "nis_dof"):
        others = (
            "columns nis and nis_dof, or innovation and innovation_variance, to be judged by the NIS alone, or columns "
            f"true_{axes[0]}, … beside the state"
        )
        state = ""
        if not sheet.among(axes):
            state = f"; the columns of another state than {','.join(axes)} are named by --state A,B"
        missing = columns.missing_truth(sheet, axes)
        if missing:
            raise InputError(f"{sheet.path}: {missing}")
        raise InputError(f"{sheet.path}: needs --truth FILE, or {others}{state}")
    of_truth = r.truth.truth_covariance
    if of_truth not in (None, COLUMNS):
        raise InputError(f"--truth-covariance {of_truth}: for tables it is '{COLUMNS}', those of the truth")


def _key(sheet: TableRows, truth: TableRows | None, r: Reading) -> str:
    """The column that says which estimate belongs to which truth."""
    true = sheet if truth is None else truth
    timed = truth is not None and "t" in sheet and "t" in truth
    key = next((key for key in ("step", "t") if key in sheet and key in true), None)
    if r.matching.time_offset is not None:
        key = "t"
    for option in ("time_offset", "max_dt"):
        if r.given([option]) and key is not None and not timed:
            raise InputError(f"{flag_of(option)}: needs a column t in the estimates and in the truth")
    if key is not None:
        return key
    for has in ("step", "t"):
        if has in sheet:
            raise InputError(f"{true.path}: column '{has}' is missing; {sheet.path} is numbered by it")
    hint = ""
    if len(sheet.data) == 1 and " " in sheet.columns:
        hint = "; separate columns by commas, semicolons or tabs"
    missing = f"{sheet.path}: column 'step' or 't' is missing; there are: {sheet.columns}{hint}"
    raise InputError(f"{missing}; {naming('t')}")


# --- poses -------------------------------------------------------------------------------------------


def _innovations(name: str, sheet: TableRows, key: str, axes: Sequence[str]) -> Estimator:
    """Innovations without a truth; a row whose state is broken has no estimate."""
    sheet, runs = columns.by_run(sheet, key)
    nothing = np.zeros((len(sheet), 1))
    t = sheet.numbers(key, finite=True)
    state = np.column_stack([nothing, *map(sheet.numbers, sheet.among(axes))])
    nis, dof = columns.nis_columns(sheet)
    covariance, stated = unstated(len(sheet), 1)
    poses = make_poses(
        place=sheet.places,
        t=t,
        estimate=state,
        covariance=covariance,
        stated=stated,
        true_t=t,
        truth=nothing,
        manifold="vector",
        convention="vector",
        max_dt=0.0,
        numbered=key == "step",
        clock=_clock(sheet),
        nis=nis,
        nis_dof=dof,
    )
    return Estimator(name, sheet.path, _by_run(sheet, runs, poses), StatedError(axes), innovations_alone=True)


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
    columns.require_columns(sheet, axes)
    columns.require_columns(truth, axes)
    sheet, runs = columns.by_run(sheet, key)
    truth, true_runs = columns.by_run(truth, key)
    covariance, known = unstated(len(sheet), len(axes))
    notes = _absent(name, truth, runs, true_runs)
    stated = WHOLE
    cross = of_truth = bounds = sizes = None
    is_stated = not r.statement.unstated or covariance_columns(list(sheet.data), axes).places
    if not poses_alone and r.components.members is None and is_stated:
        covariance, stated, bounds, sizes, note = _stated(name, sheet, axes, convention, r)
        known = np.ones(len(sheet), bool)
        notes += filter(None, [note])
    if r.runs.relative is not None and not r.runs.motions:
        cross = columns.stated_cross_covariances(sheet)
    own_of_truth = covariance_columns(list(truth.data), axes)
    is_unused = r.sources.truth is not None and r.truth.truth_covariance is None
    if is_unused and columns.states_any(truth, own_of_truth, len(axes)):
        notes.append(f"{truth.path}: the truth states a covariance of its own, which counts as 0; see "
                     f"--truth-covariance {COLUMNS}")  # fmt: skip
    if r.truth.truth_covariance is not None:
        of_truth = columns.stated_covariance(truth, axes, own_of_truth)
    estimate = sheet.matrix(axes)
    estimate[~finite_rows(estimate)] = np.nan
    nis, dof = columns.nis_columns(sheet)
    by_step = key == "step"
    poses = make_poses(
        place=sheet.places,
        t=sheet.numbers(key, finite=True),
        estimate=estimate,
        covariance=covariance,
        stated=known,
        true_t=truth.numbers(key),
        truth=truth.matrix(axes, finite=True),
        manifold=manifold_of(convention),
        convention=convention,
        max_dt=0.0 if by_step else r.matching.tolerance,
        cross=cross,
        true_covariance=of_truth,
        files=(sheet.path, truth.path),
        numbered=by_step,
        clock=_clock(sheet),
        true_clock=_clock(truth),
        nis=nis,
        nis_dof=dof,
        bounds=sizes,
        by=columns.own_column(sheet, r.groups),
    )
    if r.components.members is not None:
        from consistency.referee.readers.formats.members import member_columns

        poses = poses.with_values(members=member_columns(sheet, r.components.members))
    of_runs = _by_run(sheet, runs, poses)
    if "run" in truth:
        of_runs = [one.beside(np.flatnonzero(true_runs == one.source.run)) for one in of_runs]
    for one in of_runs:
        if not len(one.true.t):
            has = f"holds no run {one.source.run} (it has {', '.join(map(str, np.unique(true_runs)[:5]))})"
            raise InputError(f"{truth.path}: {has}; without a column 'run' it serves all")
    definition = PLANAR[convention]
    if convention == "vector" and r.conventions.error is None and r.components.members is None:
        of_runs, on_one_turn = columns.without_turns(of_runs, axes)
        if on_one_turn:
            definition = f"plain difference; {on_one_turn}"
    judged = None if bounds is None else sorted(set(sum(bounds.places, ())))
    error = StatedError(axes, convention, definition, stated, judged=judged, position=_position(axes), bounds=bounds)
    found = Estimator(name, sheet.path, of_runs, error, notes=notes)
    if r.components.members is None:
        return found
    from consistency.referee.readers.formats.members import of_members

    return of_members(found, r)


def _by_run(sheet: TableRows, runs: Array, poses: Poses) -> list[Poses]:
    """The poses of each run, named as in a study of drives, of those of all rows."""
    found = []
    for run in np.unique(runs):
        rows = np.flatnonzero(runs == run)
        name = sheet.path.stem
        if "run" in sheet:
            name = f"run {run}"
        one = poses.of_rows(rows)
        open_end = sheet.open_end(int(rows[-1]))
        found.append(one.with_values(run=int(run), name=name, open_end=open_end))
    return found


def _clock(sheet: TableRows) -> Array | None:
    return sheet.numbers("t") if "t" in sheet else None


def _position(axes: Sequence[str]) -> int:
    """Leading components that are a position."""
    if tuple(axes[:3]) == ("x", "y", "z"):
        return 3
    return 2 if tuple(axes[:2]) == ("x", "y") else 0


def _stated(
    name: str, sheet: TableRows, axes: tuple[str, ...], convention: str, r: Reading
) -> tuple[Array, Stated, Bounds | None, Array | None, str]:
    """Covariances (N, n, n), which of them are stated, bounds in place of them and their sizes, and a note."""
    if r.statement.level is None:
        covariance, stated, note = _covariance(name, sheet, axes, convention)
        return covariance, stated, None, None, note
    from consistency.referee.readers.formats import bounds

    found = bounds.stated_in(sheet, axes, r.statement)
    if found is not None:
        return bounds.covariance_of(*found, len(axes)), WHOLE, *found, ""
    bounds.require_gaussian(str(sheet.path), r.statement)
    covariance, stated, note = _covariance(name, sheet, axes, convention)
    return covariance * bounds.covariance_factor(r.statement), stated, None, None, note


def _covariance(name: str, sheet: TableRows, axes: tuple[str, ...], convention: str) -> tuple[Array, Stated, str]:
    """Covariances (N, n, n), which of them are stated, and a note on them."""
    if convention != ADDITIVE and is_pose(axes):
        own = columns.own_covariance(sheet)
        if own is not None:
            note = f"{name}: the covariance is that of the columns own_P_*, which are of the filter's own error"
            return own, WHOLE, note
    entries = covariance_columns(list(sheet.data), axes)
    if not entries.places:
        _require_no_bounds(sheet.path, list(sheet.data))
    if not entries.without_cross_terms(len(axes)):
        return columns.stated_covariance(sheet, axes, entries), WHOLE, ""
    note = f"{name}: standard deviations without cross terms are stated, so each component is judged by itself"
    return diagonal(columns.stated_deviations(sheet, entries)), ALONE, note


def _absent(name: str, truth: TableRows, runs: Array, true_runs: Array) -> list[str]:
    """A note on runs of the truth without estimates."""
    absent = sorted({*true_runs.tolist()} - {*runs.tolist()})
    if not absent or "run" not in truth:
        return []
    remedy = "if the filter broke down there, write a row of NaN, so that the failure counts"
    return [f"{name}: no estimates of {plural(len(absent), 'run')} of the truth ({listed(absent)}); {remedy}"]


def _require_no_bounds(path: Path, names: Sequence[str]) -> None:
    """Refuse a table without a covariance that states bounds, but no level."""
    bounds = [name for name in names if name.startswith(("bound_", "radius_")) or name.endswith("_low")]
    if bounds:
        raise InputError(f"{path}: states no covariance, but {bounds[0]}; --level 95% says the level of bounds")
