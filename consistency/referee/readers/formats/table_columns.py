"""Columns of a table as arrays: order of its rows, covariances, deviations, innovations."""

from __future__ import annotations

import itertools

import numpy as np

from consistency.referee.column_names import COVARIANCE, OWN_COVARIANCE
from consistency.referee.errors import InputError
from consistency.referee.readers.formats.named_columns import DEVIATIONS, naming, spelled
from consistency.referee.readers.formats.sheet import NIS_DOF, TableRows, are_dof
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
    order = np.lexsort((values, runs))
    if key == "t":
        order = np.argsort(runs, kind="stable")
    stuck = np.flatnonzero((np.diff(runs[order]) == 0) & (np.diff(values[order]) <= 0))
    if not len(stuck):
        return order
    before, row = order[stuck[0] : stuck[0] + 2]
    of, hint = "", "; several runs need a column 'run'"
    if "run" in sheet:
        of = f" of run {runs[row]}"
        hint = ""
        if "filter" not in sheet:
            hint = "; several estimators need a column 'filter'"
    what = "is less than the one before"
    if values[before] == values[row]:
        what = "is duplicated"
    raise InputError(f"{sheet.place(row)}: {key} {exact(values[row])}{of} {what}{hint}")


def by_run(sheet: TableRows, key: str) -> tuple[TableRows, Array]:
    """The rows in the order of :func:`row_order`, and the run of each, (N,): 0 without a column ``run``."""
    runs = np.zeros(len(sheet), int)
    if "run" in sheet:
        runs = sheet.numbers("run", whole=True).astype(int)
    order = row_order(sheet, runs, key)
    return sheet.rows(order), runs[order]


def cross_covariances(sheet: TableRows) -> Array | None:
    """Cross-covariances with the row before, columns C_xx, C_xy, C_xh, C_yx, ..., (N, 3, 3); None without any."""
    columns = []
    missing = []
    for a, b in itertools.product(POSE, repeat=2):
        short = f"C_{a[0]}{b[0]}"
        there = sheet.among([short, f"C_{a}_{b}"])
        columns += there[:1]
        if not there:
            missing.append(short)
    if not columns:
        return None
    if missing:
        what = f"column '{missing[0]}' is missing; a cross-covariance is not a symmetric matrix"
        raise InputError(f"{sheet.path}: {what}")
    return sheet.matrix(columns).reshape(-1, 3, 3)


def has_own(sheet: TableRows) -> bool:
    """Whether the rows are of a filter of the bench that states the covariance of an error of its own."""
    return sheet.has(*OWN_COVARIANCE) and not any(sheet.empty(name).all() for name in OWN_COVARIANCE)


def entry_names(a: str, b: str, short: bool) -> tuple[list[str], list[str]]:
    """Names of the covariance of two components in the upper and in the lower triangle; ``short`` ones as P_xh too."""
    upper = [f"P_{a}_{b}"]
    lower = [f"P_{b}_{a}"]
    if short and (a, b) in OWN_NAMES:
        upper.append(OWN_NAMES[a, b])
        lower.append(LOWER_NAMES[a, b])
    return upper, lower


def stated_deviations(sheet: TableRows, axes: tuple[str, ...]) -> Array | None:
    """Standard deviations (N, n) of a table without cross terms: sigma_x, std_x, sx, or P_x_x alone; None of others."""
    for a, b in itertools.combinations(axes, 2):
        upper, lower = entry_names(a, b, short=True)
        if sheet.among(upper + lower):
            return None
    variances = []
    for axis in axes:
        names, _ = entry_names(axis, axis, short=True)
        variances += sheet.among(names)[:1]
    if len(variances) == len(axes) > 1:
        P = sheet.matrix(variances)
        return np.asarray(np.sign(P) * np.sqrt(np.abs(P)))
    for spelling in DEVIATIONS:
        names = spelled(spelling, axes)
        if sheet.has(*names) and not variances:
            return sheet.matrix(names)
    return None


def stated_covariance(sheet: TableRows, axes: tuple[str, ...], own: bool = False) -> Array:
    """(N, n, n) from the upper triangle; a lower triangle beside it must agree. ``own``: of the columns own_P_*."""
    require_columns(sheet, axes)
    n = len(axes)
    out = np.empty((len(sheet), n, n))
    if own:
        for name, (i, j) in OWN_COVARIANCE.items():
            out[:, i, j] = out[:, j, i] = sheet.numbers(name)
        return out
    for i, j in itertools.combinations_with_replacement(range(n), 2):
        upper, lower = entry_names(axes[i], axes[j], short=axes == POSE)
        there = sheet.among(upper + lower)
        if not there:
            what = f"column '{upper[-1]}' is missing; the covariance of {', '.join(axes)} needs its upper triangle"
            advice = f"{naming(upper[-1])}; --state a,b judges fewer components"
            raise InputError(f"{sheet.path}: {what}, zeros included; {advice}")
        out[:, i, j] = sheet.numbers(there[0])
        out[:, j, i] = sheet.numbers(there[-1])
    return symmetric(out, sheet.place)


def require_columns(sheet: TableRows, axes: tuple[str, ...]) -> None:
    """Refuse a table that lacks a column of the state."""
    for axis in axes:
        if axis in sheet:
            continue
        hint = ""
        if axes == POSE:
            hint = " (poses in space have x, y, z, qx, qy, qz, qw); name other states with --state a,b,c"
        what = f"column '{axis}' is missing; there are: {sheet.columns}"
        raise InputError(f"{sheet.path}: {what}; {naming(axis)}{hint}")


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
        raise InputError(f"{sheet.path}: column 'nis_dof' is missing; {NIS_DOF}")
    nis = sheet.numbers("nis")
    dof = sheet.numbers("nis_dof")
    known = np.isfinite(nis)
    bad = (nis < 0) | np.isinf(nis) | (known & ~are_dof(dof))
    what = "nis {:g} with nis_dof {:g}; nis must be 0 or more, nis_dof a whole number from 0 to below 2^31".format
    refuse(bad, sheet.place, lambda row: what(nis[row], dof[row]))
    return nis, np.where(known, dof, 0.0)
