"""Estimates and truth as CSV or Parquet tables, with a row for each step of each run."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from consistency.referee.diagnostics import Evidence
from consistency.referee.diagnostics.parts import diagonal, each_alone
from consistency.referee.diagnostics.validity import ROUNDED, Validity, classify
from consistency.referee.errors import InputError
from consistency.referee.geometry.conventions import ADDITIVE, PLANAR, planar_error
from consistency.referee.parsing.columns import COVARIANCE, OWN_COVARIANCE
from consistency.referee.parsing.options import Reading
from consistency.referee.readers.alignment import Aligned, clocks_and_frames
from consistency.referee.readers.hints import hints
from consistency.referee.readers.interpolation import Manifold, nearest, truth_at
from consistency.referee.readers.kitti import drive_sheet, is_drive
from consistency.referee.readers.matching import common_steps, common_times
from consistency.referee.readers.naming import DEVIATIONS
from consistency.referee.readers.plane import planar_sheet
from consistency.referee.readers.poses import NamedPoses, Poses
from consistency.referee.readers.record import Track, assemble, count, listed, symmetric
from consistency.referee.readers.relative import Stretch, relative_recording
from consistency.referee.readers.sheet import Places, TableRows, are_dof, read_sheet
from consistency.referee.readers.uncertain import COLUMNS
from consistency.referee.readers.windows import Relative
from consistency.referee.types import Array, Indices

POSE = ("x", "y", "heading")
OWN_NAMES = {(POSE[i], POSE[j]): name for name, (i, j) in COVARIANCE.items()}


def read_tables(estimates: Path | TableRows, r: Reading, relative: Relative | None = None) -> list[Evidence]:
    """Recordings of the estimators in a table, one for each value of its column ``filter``.

    Raises
    ------
    InputError
        A file, column, line or option that cannot be used, and what is allowed.
    """
    truth, axes = r.truth, tuple(r.state) if r.state else POSE
    sheet, note = _sheet(estimates, axes, bool(r.motions))
    estimates = sheet.path
    convention = _convention(r.error, axes, truth)
    if relative is not None:
        require_poses(estimates, axes, convention, truth)
    if r.align is not None and _manifold(convention) != "planar":
        raise InputError(f"--align {r.align}: needs poses x,y,heading, and an error that is not 'vector'")
    other, notes = None, [note]
    if isinstance(truth, Path) and is_drive(truth):
        other = drive_sheet(truth, r.body)
    elif truth is not None:
        other, note = _sheet(truth, axes)
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


def _sheet(table: Path | TableRows, axes: tuple[str, ...], motions: bool = False) -> tuple[TableRows, str]:
    """Rows of a file, or those in memory, and what they were read as."""
    if isinstance(table, TableRows):
        return table, ""
    return planar_sheet(table, motions) if axes == POSE else (read_sheet(table), "")


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
    raise InputError(f"{sheet.path}: column 'step' or 't' is missing; there are: {sheet.columns}")


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
        broken = ~np.isfinite(np.column_stack([np.zeros(len(runs)), *_present(sheet, axes)])).all(axis=1)
        error = None if not broken.any() else np.where(broken, np.nan, 0.0)[:, None]
    else:
        own = convention != ADDITIVE and axes == POSE and _has_own(sheet)
        deviations = None if own else _deviations(sheet, axes)
        covariance = _covariance(sheet, axes, own) if deviations is None else diagonal(deviations)
        estimate = np.column_stack([sheet.numbers(axis) for axis in axes])
        estimate[~np.isfinite(estimate).all(axis=1)] = np.nan
        samples = _samples(truth, axes, key, r.truth_covariance)
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
            shift, clocks, moved = clocks_and_frames(name, poses, r.time_offset, r.align, range(len(axes)))
            clocks += [*moved.notes, *hints(name, axes, moved.runs, shift)]
            if r.align is not None:
                there = np.isin(runs, np.unique(samples.runs)) if samples.runs is not None else np.ones(len(runs), bool)
                estimate[there] = np.concatenate([p.estimate for p in moved.runs])
                covariance[there] = np.concatenate([p.covariance for p in moved.runs])
        keep, true, of_truth, notes = _matched(
            name, sheet, truth, samples, runs, keys + shift, key, axes, convention, r.tolerance
        )
        if relative is not None:
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
    nis, dof = _nis(sheet)
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
    t = sheet.numbers("t", finite=True) if "t" in sheet else np.full(len(runs), np.nan)
    cross = None if relative.motions else _cross(sheet)
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


def _cross(sheet: TableRows) -> Array | None:
    """Cross-covariances with the row before, columns C_xx, C_xy, C_xh, C_yx, ..., (N, 3, 3); None without any."""
    out, missing = np.empty((len(sheet), 3, 3)), []
    for (i, a), (j, b) in itertools.product(enumerate(POSE), repeat=2):
        names = f"C_{a[0]}{b[0]}", f"C_{a}_{b}"
        there = [name for name in names if name in sheet]
        if there:
            out[:, i, j] = sheet.numbers(there[0])
        else:
            missing.append(names[0])
    if missing and len(missing) < len(POSE) ** 2:
        raise InputError(f"{sheet.path}: column '{missing[0]}' is missing; a cross-covariance is no symmetric matrix")
    return None if missing else out


def row_order(sheet: TableRows, runs: Array, key: str) -> Indices:
    """Rows (N,) by run and then by ``key`` (step or t); ``runs`` (N,) has the run of each row.

    Timestamps must be in order: a jump back is another run or another clock.

    Raises
    ------
    InputError
        A step or a timestamp is there twice, or a timestamp is less than the one before.
    """
    values = sheet.numbers(key, finite=True, whole=key == "step")
    order = np.argsort(runs, kind="stable") if key == "t" else np.lexsort((values, runs))
    same = np.diff(runs[order]) == 0
    stuck = np.flatnonzero(same & (np.diff(values[order]) <= 0))
    if len(stuck):
        row = int(order[stuck[0] + 1])
        of = f" of run {runs[row]}" if "run" in sheet else ""
        what = "is there twice" if values[order[stuck[0]]] == values[row] else "is less than the one before"
        hint = "" if "run" in sheet else "; several runs need a column 'run'"
        hint += "" if "filter" in sheet else "; several estimators need a column 'filter'" if "run" in sheet else ""
        raise InputError(f"{sheet.place(row)}: {key} {values[row]:.10g}{of} {what}{hint}")
    return order


class Samples(NamedTuple):
    """The truth of all runs, in order of the runs and of time."""

    keys: Array  # (M,), step, or s
    values: Array  # (M, n)
    covariance: Array | None  # (M, n, n), of the truth itself
    row: Indices  # (M,), of the file
    runs: Indices | None  # (M,); None: it serves all

    def of(self, run: int) -> Samples:
        """Samples of one run."""
        if self.runs is None:
            return self
        here = self.runs == run
        P = None if self.covariance is None else self.covariance[here]
        return Samples(self.keys[here], self.values[here], P, self.row[here], self.runs[here])


def _samples(truth: TableRows, axes: tuple[str, ...], key: str, stated: str | None) -> Samples:
    if stated not in (None, COLUMNS):
        raise InputError(f"--truth-covariance {stated}: for tables it is '{COLUMNS}', those of the truth")
    _require(truth, axes)
    values = np.column_stack([truth.numbers(axis, finite=True) for axis in axes])
    runs = truth.numbers("run", whole=True).astype(int) if "run" in truth else None
    order = row_order(truth, runs if runs is not None else np.zeros(len(values), int), key)
    P = None if stated is None else _covariance(truth, axes)[order]
    return Samples(truth.numbers(key)[order], values[order], P, order, None if runs is None else runs[order])


def _manifold(convention: str) -> Manifold:
    return "vector" if convention == "vector" else "planar"


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
                    _manifold(convention), convention, max_dt,
                )
            )  # fmt: skip
    return found


def _matched(
    name: str,
    sheet: TableRows,
    truth: TableRows,
    samples: Samples,
    runs: Array,
    keys: Array,
    key: str,
    axes: tuple[str, ...],
    convention: str,
    max_dt: float,
) -> tuple[Array, Array, Array | None, list[str]]:
    """Which rows have a truth, (N,), that truth, (N, n), its covariance, (N, n, n), and notes on the matching."""
    true_runs = samples.runs
    tolerance = 0.0 if key == "step" else max_dt
    keep, true = np.zeros(len(keys), bool), np.full((len(keys), len(axes)), np.nan)
    of_truth = None if samples.covariance is None else np.full((*true.shape, len(axes)), np.nan)
    partner, furthest = np.full(len(keys), -1), 0.0
    for run in np.unique(runs):
        rows = np.flatnonzero(runs == run)
        there = samples.of(run)
        if not len(there.keys):
            has = ", ".join(map(str, np.unique(true_runs)[:5])) if true_runs is not None else ""
            raise InputError(f"{truth.path}: holds no run {run} (it has {has}); without a column 'run' it serves all")
        if key == "step":
            own, match = _equal(keys[rows], there.keys)
            found = there.values[match]
        else:
            manifold = _manifold(convention)
            own, found, match, apart, _ = truth_at(keys[rows], there.keys, there.values, manifold, tolerance)
            furthest = max(furthest, float(apart.max(initial=0.0)))
        if not len(own):
            spans = [f"{each.min():.10g} to {each.max():.10g}" for each in (keys[rows], there.keys)]
            within = f" within {tolerance:g} s (--max-dt)" if key == "t" else ""
            raise InputError(
                f"{sheet.path}: no {key} of run {run} ({spans[0]}) is in {truth.path} ({spans[1]}){within}"
            )
        keep[rows[own]], true[rows[own]], partner[rows[own]] = True, found, there.row[match]
        if of_truth is not None and there.covariance is not None:
            of_truth[rows[own]] = there.covariance[nearest(keys[rows[own]], there.keys, match)]
    if key == "step" and "t" in sheet and "t" in truth:
        _same_instants(sheet, truth, keep, partner, max_dt)
    notes = []
    absent = [] if true_runs is None else sorted({int(run) for run in true_runs} - {int(run) for run in runs})
    if absent:
        notes.append(
            f"{name}: no estimates of {count(len(absent), 'run')} of the truth ({listed(absent)}); "
            "if the filter broke down there, write a row of NaN, so that the failure counts"
        )
    if not keep.all():
        notes.append(f"{name}: {int((~keep).sum())} of {len(keep)} estimates have no truth and are left out")
    if furthest > 1e-6:
        notes.append(f"{name}: the truth is interpolated, from samples up to {furthest:.2g} s away")
    return keep, true, of_truth, notes


def _equal(steps: Array, reference: Array) -> tuple[Indices, Indices]:
    """Indices of equal numbers in two increasing lists."""
    _, own, match = np.intersect1d(steps, reference, assume_unique=True, return_indices=True)
    return own, match


def _same_instants(sheet: TableRows, truth: TableRows, keep: Array, partner: Array, max_dt: float) -> None:
    own = sheet.numbers("t")[keep]
    other = truth.numbers("t")[partner[keep]]
    off = np.flatnonzero(np.abs(own - other) > max_dt + 1e-6)
    if len(off):
        row = int(np.flatnonzero(keep)[off[0]])
        raise InputError(
            f"{sheet.place(row)}: t is {own[off[0]]:.10g}, but {other[off[0]]:.10g} in the same step of {truth.path}; "
            "number the same instants by the same step, or raise --max-dt"
        )


def _exact_start(steps: Array, covariance: Array) -> Array:
    """Rows of step 0 where no run is uncertain yet: the start, not an estimate."""
    start: Array = steps == 0
    if not start.any() or (steps < 0).any() or not _is_exact(covariance[start]):
        return np.zeros(len(steps), bool)
    return start


def _is_exact(covariance: Array) -> bool:
    return bool(np.isin(classify(covariance, ROUNDED), (Validity.DEFICIENT, Validity.INDEFINITE)).all())


def _has_own(sheet: TableRows) -> bool:
    """Whether the rows are of a filter of the bench that states the covariance of an error of its own."""
    return all(name in sheet and not sheet.empty(name).all() for name in OWN_COVARIANCE)


def _deviations(sheet: TableRows, axes: tuple[str, ...]) -> Array | None:
    """Standard deviations (N, n) of a table without cross terms: sigma_x, std_x, sx, or P_x_x alone; None of others."""
    n = len(axes)
    pairs = [(axes[i], axes[j]) for i, j in itertools.combinations(range(n), 2)]
    if any(f"P_{a}_{b}" in sheet or f"P_{b}_{a}" in sheet or OWN_NAMES.get((a, b)) in sheet.data for a, b in pairs):
        return None
    variances = [f"P_{a}_{a}" if f"P_{a}_{a}" in sheet else OWN_NAMES.get((a, a), "") for a in axes]
    if n > 1 and all(name in sheet for name in variances):
        P = np.column_stack([sheet.numbers(name) for name in variances])
        return np.asarray(np.sign(P) * np.sqrt(np.abs(P)))
    for spelling in DEVIATIONS:
        names = [spelling.format(axis) for axis in axes]
        if all(name in sheet for name in names) and not any(name in sheet for name in variances):
            return np.column_stack([sheet.numbers(name) for name in names])
    return None


def _covariance(sheet: TableRows, axes: tuple[str, ...], own: bool = False) -> Array:
    """(N, n, n) from the upper triangle; a lower triangle beside it must agree. ``own``: of the columns own_P_*."""
    _require(sheet, axes)
    if own:
        P = np.empty((len(sheet), 3, 3))
        for name, (i, j) in OWN_COVARIANCE.items():
            P[:, i, j] = P[:, j, i] = sheet.numbers(name)
        return P
    n = len(axes)
    out = np.empty((len(sheet), n, n))
    for i in range(n):
        for j in range(i, n):
            upper = [f"P_{axes[i]}_{axes[j]}", *([OWN_NAMES[axes[i], axes[j]]] if axes == POSE else [])]
            lower = [f"P_{axes[j]}_{axes[i]}"]
            there = [column for column in (*upper, *lower) if column in sheet]
            if not there:
                wanted = upper[-1]
                raise InputError(
                    f"{sheet.path}: column '{wanted}' is missing; the covariance of {', '.join(axes)} needs its "
                    "upper triangle, zeros included"
                )
            out[:, i, j], out[:, j, i] = sheet.numbers(there[0]), sheet.numbers(there[-1])
    return symmetric(out, sheet.place)


def _require(sheet: TableRows, axes: tuple[str, ...]) -> None:
    missing = [axis for axis in axes if axis not in sheet]
    if missing:
        hint = "; name other states with --state a,b,c" if axes == POSE else ""
        raise InputError(f"{sheet.path}: column '{missing[0]}' is missing; there are: {sheet.columns}{hint}")


def _present(sheet: TableRows, axes: tuple[str, ...]) -> list[Array]:
    return [sheet.numbers(axis) for axis in axes if axis in sheet]


def _nis(sheet: TableRows) -> tuple[Array | None, Array | None]:
    if "nis" not in sheet:
        return None, None
    if "nis_dof" not in sheet:
        raise InputError(f"{sheet.path}: column 'nis_dof' is missing; it is the number of measurements in each nis")
    nis, dof = sheet.numbers("nis"), sheet.numbers("nis_dof")
    bad = (nis < 0) | np.isinf(nis) | (np.isfinite(nis) & ~are_dof(dof))
    if bad.any():
        row = int(np.flatnonzero(bad)[0])
        raise InputError(
            f"{sheet.place(row)}: nis {nis[row]:g} with nis_dof {dof[row]:g}; "
            "nis must be 0 or more, nis_dof a whole number from 0 to below 2^31"
        )
    return nis, np.where(np.isfinite(nis), dof, 0.0)


# --- poses alone -------------------------------------------------------------------------------------


def table_poses(estimates: Path, r: Reading) -> Iterator[NamedPoses]:
    """Planar poses of each run of a table; covariances are not looked at."""
    if r.truth is None:
        raise InputError(f"{estimates}: needs --truth FILE, poses in any world")
    sheet, _ = planar_sheet(estimates, bool(r.motions))
    truth = drive_sheet(r.truth, r.body) if is_drive(r.truth) else planar_sheet(r.truth)[0]
    if "filter" in sheet and len(set(sheet.texts("filter"))) > 1:
        raise InputError(f"{estimates}: holds several estimators in its column 'filter'; keep the rows of one")
    _require(sheet, POSE)
    key = _key(sheet, truth, r)
    samples = _samples(truth, POSE, key, None)
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
