"""Columns of a table as arrays: order of its rows, covariances, deviations, innovations, and the truth of its rows."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from consistency.referee.column_names import COVARIANCE, OWN_COVARIANCE
from consistency.referee.diagnostics.words.numbers import plural
from consistency.referee.errors import InputError
from consistency.referee.readers.clock_units import unit_apart
from consistency.referee.readers.formats.named_columns import DEVIATIONS
from consistency.referee.readers.formats.sheet import TableRows, are_dof, exact
from consistency.referee.readers.options import COLUMNS
from consistency.referee.readers.places import refuse
from consistency.referee.readers.runs_to_record import listed, symmetric
from consistency.referee.readers.truth_matching import Known, Manifold, Poses
from consistency.referee.types import Array, Indices

POSE = ("x", "y", "heading")
OWN_NAMES = {(POSE[i], POSE[j]): name for name, (i, j) in COVARIANCE.items()}
LOWER_NAMES = {pair: f"P_{name[3]}{name[2]}" for pair, name in OWN_NAMES.items()}


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
        raise InputError(f"{sheet.place(row)}: {key} {exact(values[row])}{of} {what}{hint}")
    return order


def by_run(sheet: TableRows, key: str) -> tuple[TableRows, Array]:
    """The rows in the order of :func:`row_order`, and the run of each, (N,): 0 without a column ``run``."""
    runs = sheet.numbers("run", whole=True).astype(int) if "run" in sheet else np.zeros(len(sheet), int)
    order = row_order(sheet, runs, key)
    return sheet.rows(order), runs[order]


def cross_covariances(sheet: TableRows) -> Array | None:
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


def has_own(sheet: TableRows) -> bool:
    """Whether the rows are of a filter of the bench that states the covariance of an error of its own."""
    return all(name in sheet and not sheet.empty(name).all() for name in OWN_COVARIANCE)


def stated_deviations(sheet: TableRows, axes: tuple[str, ...]) -> Array | None:
    """Standard deviations (N, n) of a table without cross terms: sigma_x, std_x, sx, or P_x_x alone; None of others."""
    n = len(axes)
    pairs = [(axes[i], axes[j]) for i, j in itertools.combinations(range(n), 2)]
    if any(f"P_{a}_{b}" in sheet or f"P_{b}_{a}" in sheet for a, b in pairs):
        return None
    if any(names.get(pair) in sheet.data for names in (OWN_NAMES, LOWER_NAMES) for pair in pairs):
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


def stated_covariance(sheet: TableRows, axes: tuple[str, ...], own: bool = False) -> Array:
    """(N, n, n) from the upper triangle; a lower triangle beside it must agree. ``own``: of the columns own_P_*."""
    require_columns(sheet, axes)
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
            lower = [f"P_{axes[j]}_{axes[i]}", *([LOWER_NAMES[axes[i], axes[j]]] if axes == POSE else [])]
            there = [column for column in (*upper, *lower) if column in sheet]
            if not there:
                wanted = upper[-1]
                raise InputError(
                    f"{sheet.path}: column '{wanted}' is missing; the covariance of {', '.join(axes)} needs its "
                    "upper triangle, zeros included; --state a,b judges fewer components"
                )
            out[:, i, j], out[:, j, i] = sheet.numbers(there[0]), sheet.numbers(there[-1])
    return symmetric(out, sheet.place)


def require_columns(sheet: TableRows, axes: tuple[str, ...]) -> None:
    """Refuse a table that lacks a column of the state."""
    missing = [axis for axis in axes if axis not in sheet]
    if missing:
        hint = "; name other states with --state a,b,c" if axes == POSE else ""
        raise InputError(f"{sheet.path}: column '{missing[0]}' is missing; there are: {sheet.columns}{hint}")


def nis_columns(sheet: TableRows) -> tuple[Array | None, Array | None]:
    """NIS and its degrees of freedom, (N,) each; None without a column ``nis``."""
    if "nis" not in sheet:
        return None, None
    if "nis_dof" not in sheet:
        raise InputError(f"{sheet.path}: column 'nis_dof' is missing; it is the number of measurements in each nis")
    nis, dof = sheet.numbers("nis"), sheet.numbers("nis_dof")
    bad = (nis < 0) | np.isinf(nis) | (np.isfinite(nis) & ~are_dof(dof))
    what = "nis {:g} with nis_dof {:g}; nis must be 0 or more, nis_dof a whole number from 0 to below 2^31".format
    refuse(bad, sheet.place, lambda row: what(nis[row], dof[row]))
    return nis, np.where(np.isfinite(nis), dof, 0.0)


class Samples(NamedTuple):
    """The truth of all runs, in order of the runs and of time."""

    keys: Array  # (M,), step, or s
    values: Array  # (M, n)
    covariance: Array | None  # (M, n, n), of the truth itself
    row: Indices  # (M,), of the file
    runs: Indices | None  # (M,); None: it serves all

    def of(self, run: int) -> Samples:
        if self.runs is None:
            return self
        here = self.runs == run
        P = None if self.covariance is None else self.covariance[here]
        return Samples(self.keys[here], self.values[here], P, self.row[here], self.runs[here])


def samples_of(truth: TableRows, axes: tuple[str, ...], key: str, stated: str | None) -> Samples:
    """Samples of a true table; with ``stated`` their covariances, too."""
    if stated not in (None, COLUMNS):
        raise InputError(f"--truth-covariance {stated}: for tables it is '{COLUMNS}', those of the truth")
    require_columns(truth, axes)
    values = np.column_stack([truth.numbers(axis, finite=True) for axis in axes])
    runs = truth.numbers("run", whole=True).astype(int) if "run" in truth else None
    order = row_order(truth, runs if runs is not None else np.zeros(len(values), int), key)
    P = None if stated is None else stated_covariance(truth, axes)[order]
    return Samples(truth.numbers(key)[order], values[order], P, order, None if runs is None else runs[order])


def manifold_of(convention: str) -> Manifold:
    """What errors of a convention in a table live on."""
    return "vector" if convention == "vector" else "planar"


def matched(
    name: str,
    sheet: TableRows,
    truth: TableRows,
    samples: Samples,
    key: str,
    numbers: Sequence[int],
    members: Sequence[Indices],
    poses: Sequence[Poses],
    shift: float,
    max_dt: float,
) -> tuple[list[Known], list[str]]:
    """The truth of each run, and notes on the matching; ``numbers`` and ``members`` are the runs and their rows."""
    known, partner = [p.known(shift) for p in poses], np.full(len(sheet), np.nan)
    timed = key == "step" and "t" in sheet and "t" in truth
    for run, rows, p, found in zip(numbers, members, poses, known, strict=True):
        if not len(found.rows):
            t = p.t + shift
            spans = [f"{each.min():.15g} to {each.max():.15g}" for each in (t, p.true_t)]
            odd = unit_apart(t, p.true_t, (sheet.path, truth.path))
            within = f" within {p.max_dt:g} s (--max-dt){odd}" if key == "t" else ""
            raise InputError(
                f"{sheet.path}: no {key} of run {run} ({spans[0]}) is in {truth.path} ({spans[1]}){within}"
            )
        if timed:
            partner[rows[found.rows]] = truth.numbers("t")[samples.of(run).row[found.before]]
    if timed:
        t = sheet.numbers("t")
        where = f"in the same step of {truth.path}; number the same instants by the same step, or raise --max-dt"
        off = np.abs(t - partner) > max_dt + 1e-6
        refuse(off, sheet.place, lambda row: f"t is {exact(t[row])}, but {exact(partner[row])} {where}")
    notes = []
    absent = [] if samples.runs is None else sorted({int(run) for run in samples.runs} - {*numbers})
    if absent:
        notes.append(
            f"{name}: no estimates of {plural(len(absent), 'run')} of the truth ({listed(absent)}); "
            "if the filter broke down there, write a row of NaN, so that the failure counts"
        )
    if left_out := len(sheet) - sum(len(found.rows) for found in known):
        notes.append(f"{name}: {left_out} of {len(sheet)} estimates have no truth and are left out")
    if (furthest := max(float(found.apart.max(initial=0.0)) for found in known)) > 1e-6:
        notes.append(f"{name}: the truth is interpolated, from samples up to {furthest:.2g} s away")
    return known, notes
