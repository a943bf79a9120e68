"""Columns of a table as arrays: order of its rows, covariances, deviations, innovations."""

from __future__ import annotations

import itertools

import numpy as np

from consistency.referee.column_names import COVARIANCE, OWN_COVARIANCE
from consistency.referee.errors import InputError
from consistency.referee.readers.formats.named_columns import DEVIATIONS, naming
from consistency.referee.readers.formats.sheet import TableRows, are_dof
from consistency.referee.readers.options import Reading
from consistency.referee.readers.places import exact, refuse
from consistency.referee.readers.runs_to_record import symmetric
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
        A step or a timestamp is duplicated, or a timestamp is less than the one before.
    """
    values = sheet.numbers(key, finite=True, whole=key == "step")
    order = np.argsort(runs, kind="stable") if key == "t" else np.lexsort((values, runs))
    same = np.diff(runs[order]) == 0
    stuck = np.flatnonzero(same & (np.diff(values[order]) <= 0))
    if len(stuck):
        row = int(order[stuck[0] + 1])
        of = f" of run {runs[row]}" if "run" in sheet else ""
        what = "is duplicated" if values[order[stuck[0]]] == values[row] else "is less than the one before"
        hint = ""
        if "run" not in sheet:
            hint = "; several runs need a column 'run'"
        elif "filter" not in sheet:
            hint = "; several estimators need a column 'filter'"
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
        raise InputError(
            f"{sheet.path}: column '{missing[0]}' is missing; a cross-covariance is not a symmetric matrix"
        )
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
                    f"upper triangle, zeros included; {naming(wanted)}; --state a,b judges fewer components"
                )
            out[:, i, j], out[:, j, i] = sheet.numbers(there[0]), sheet.numbers(there[-1])
    return symmetric(out, sheet.place)


def require_columns(sheet: TableRows, axes: tuple[str, ...]) -> None:
    """Refuse a table that lacks a column of the state."""
    missing = [axis for axis in axes if axis not in sheet]
    if missing:
        hint = ""
        if axes == POSE:
            hint = " (poses in space have x, y, z, qx, qy, qz, qw); name other states with --state a,b,c"
        raise InputError(
            f"{sheet.path}: column '{missing[0]}' is missing; there are: {sheet.columns}; {naming(missing[0])}{hint}"
        )


def own_column(sheet: TableRows, r: Reading) -> Array | None:
    """Cells of the column of ``--by``, (N,); None where it is of another file, or not asked for."""
    if r.by is None or r.by_file is not None:
        return None
    if r.by not in sheet:
        hint = "a table with t or run and the column goes with --by-file"
        raise InputError(f"--by {r.by}: {sheet.path} has no such column; there are: {sheet.columns}; {hint}")
    return sheet.data[r.by]


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
