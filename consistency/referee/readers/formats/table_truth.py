"""The truth of the rows of a table: its samples by run, and which of them belong to which estimate."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from consistency.referee.diagnostics.words.numbers import plural
from consistency.referee.errors import InputError
from consistency.referee.readers.formats.sheet import TableRows, refuse
from consistency.referee.readers.formats.table_columns import require_columns, row_order, stated_covariance
from consistency.referee.readers.matching import Manifold, nearest, truth_at, unit_apart
from consistency.referee.readers.options import COLUMNS
from consistency.referee.readers.runs_to_record import listed
from consistency.referee.types import Array, Indices


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
        own, found, match, apart, _ = truth_at(keys[rows], there.keys, there.values, manifold_of(convention), tolerance)
        furthest = max(furthest, float(apart.max(initial=0.0)))
        if not len(own):
            spans = [f"{each.min():.10g} to {each.max():.10g}" for each in (keys[rows], there.keys)]
            odd = unit_apart(keys[rows], there.keys, (sheet.path, truth.path))
            within = f" within {tolerance:g} s (--max-dt){odd}" if key == "t" else ""
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
            f"{name}: no estimates of {plural(len(absent), 'run')} of the truth ({listed(absent)}); "
            "if the filter broke down there, write a row of NaN, so that the failure counts"
        )
    if not keep.all():
        notes.append(f"{name}: {int((~keep).sum())} of {len(keep)} estimates have no truth and are left out")
    if furthest > 1e-6:
        notes.append(f"{name}: the truth is interpolated, from samples up to {furthest:.2g} s away")
    return keep, true, of_truth, notes


def _same_instants(sheet: TableRows, truth: TableRows, keep: Array, partner: Array, max_dt: float) -> None:
    own, other = sheet.numbers("t"), truth.numbers("t")[partner]
    where = f"in the same step of {truth.path}; number the same instants by the same step, or raise --max-dt"
    off = keep & (np.abs(own - other) > max_dt + 1e-6)
    refuse(off, sheet.place, lambda row: f"t is {own[row]:.10g}, but {other[row]:.10g} {where}")
