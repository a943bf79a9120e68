"""Runs of an estimator as arrays over (runs, steps), with failures and left-out steps.

A log may also be cut into windows.
"""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from consistency.referee.diagnostics.nees import nees
from consistency.referee.diagnostics.number_words import plural, short
from consistency.referee.diagnostics.record import (
    INDEFINITE,
    Bound,
    BoundErrors,
    Errors,
    InnovationRecord,
    Origin,
    Record,
    Runs,
    Truth,
)
from consistency.referee.diagnostics.whitening import (
    DEFICIENT,
    ROUNDED,
    Validity,
    asymmetric,
    classify,
    of_runs,
)
from consistency.referee.errors import InputError
from consistency.referee.readers.places import Places, listed, refuse
from consistency.referee.readers.truth_matching import Estimator, Poses, at, finite_rows, submatrices
from consistency.referee.types import Array, Failure, Indices

STILL = (
    "not estimated and left out: their errors are 0 in every row, and their variances one constant each, as for a "
    "robot in the plane"
)
LEVEL = (
    "not estimated and left out, as by --axes {}: they never change in truth and estimates, as for a robot in the "
    "plane, and their variances are one constant each; --axes {} judges them, too"
)
FIXED = "never change in the estimates, but in the truth or in their variance; if they are not estimated, add --axes {}"
MIXED = 0.01  # of the largest entry, beyond which two that should be the same are not so by rounding
NO_ERROR = 1e-9  # m or rad: rounding of what is not estimated
NO_CHANGE = 1e-6  # m or rad: rounding, to four bytes or in a text, of a height or a tilt that never changes
FEWEST = 3  # rows of a run that show that
BESIDE = 1.0  # s, of the truth before and after the estimates
ARRAYS = (
    "error",
    "covariance",
    "nis",
    "nis_dof",
    "truth_covariance",
    "path",
    "by",
    "bound_ratios",
    "regions",
)  # of a track, as in a record
UNITS = {"": "step", "s": "s", "m": "m"}
FORMS = "a whole number of steps (100), seconds (10s) or metres along the true path (50m)"
ROUNDING = 1e-6  # of steps, s or m: a double holds the seconds since 1970 to a quarter of that
MARGINAL = (
    "covariances of two poses do not tell that of the motion between them; give their cross-covariances, or motions "
    "with --motions (docs/files.md, Relative poses)"
)
OVERSHOOT = 0.5  # of its size that a window may be too long, where rows or truth are missing


@dataclass(frozen=True)
class Track:
    """One run as it stands in a file: its rows in order, each with the step it belongs to."""

    run: int
    column: Indices  # (k,), increasing, 0..T-1
    place: Places  # (k,), "est.csv, line 7"
    error: Array | None = None  # (k, n), NaN where the estimate is
    covariance: Array | None = None  # (k, n, n)
    nis: Array | None = None  # (k,)
    nis_dof: Array | None = None  # (k,)
    t: Array | None = None  # (k,), s; of windows, of their beginnings
    truth_covariance: Array | None = None  # (k, n, n), of the truth itself; NaN where it has none
    path: Array | None = None  # (k, 2, 2 or 3), m, true and estimated positions
    by: Array | None = None  # (k,), values of the column that makes groups
    bound_ratios: Array | None = None  # (k, bounds), errors over their bounds
    regions: Array | None = None  # (k, bounds), of the Stanford diagram

    def part(self, index: Sequence[int]) -> Track:
        assert self.error is not None
        assert self.covariance is not None
        if len(index) == self.error.shape[1]:
            return self
        of_truth = self.truth_covariance
        if of_truth is not None:
            of_truth = submatrices(of_truth, index)
        P = submatrices(self.covariance, index)
        return replace(self, error=self.error[:, index], covariance=P, truth_covariance=of_truth)


def in_columns(tracks: Sequence[Track], columns: Sequence[Indices]) -> list[Track]:
    """Tracks whose rows belong to other steps, (k,) each."""
    return [replace(track, column=column) for track, column in zip(tracks, columns, strict=True)]


def assemble(
    name: str,
    tracks: Sequence[Track],
    t: Array,
    axes: tuple[str, ...],
    file: str,
    convention: str = "",
    notes: Sequence[str] = (),
    may_end: bool = False,
    independent: bool = False,
    bounds: tuple[Bound, ...] = (),
) -> Record:
    """Assemble tracks on the common steps, find failures, and leave out exactly known starts.

    Parameters
    ----------
    t : (steps,), s, NaN where a step has no time
    axes : names of the components of the error
    file : where the estimates are from, for messages
    may_end : a run that ends before the others is not a sign of a broken filter
    independent : rows are independent, so that a broken one fails alone, and the run continues
    bounds : over which the tracks have errors

    Raises
    ------
    InputError
        No covariance of any run has full rank, or two runs are the same.
    """
    tracks = sorted(tracks, key=lambda track: track.run)
    _require_different(file, tracks)
    failures = []
    parts = []
    short = []
    skipped = 0
    longest = longest_start(tracks)
    rows = [_soundness(track) for track in tracks] if independent else []
    independent = any((error_ok & (kind == Validity.VALID)).any() for error_ok, kind in rows)
    for i, track in enumerate(tracks):
        if independent:
            error_ok, kind = rows[i]
            counted = error_ok & (kind == Validity.VALID)
            broken = [(int(row), _reason(error_ok[row], kind[row])) for row in np.flatnonzero(~counted)]
        else:
            start, end, reason = judged_rows(track, longest)
            counted = np.arange(end) >= start
            broken = [(end, reason)] if reason else []
            if not reason and end and track.column[end - 1] < len(t) - 1:
                short.append(track.run)
            skipped += start
        parts.append(_cut(track, counted))
        for row, reason in broken:
            failures.append(Failure(name, track.run, int(track.column[row]) + 1, f"{reason} ({track.place[row]})"))
    arrays = _on_steps(parts, len(t))
    if not failures and arrays["nees"] is not None and np.isnan(arrays["nees"]).all():
        raise InputError(_singular(file, tracks, axes))
    notes = list(notes)
    if skipped:
        notes.append(f"{name}: {skipped} estimates before the covariance has full rank are left out")
    if short and not (may_end or independent):
        notes.append(
            f"{name}: {plural(len(short), 'run')} of {len(parts)} ({listed(short)}) end before step {len(t)}; "
            "if the filter broke down there, write a row of NaN, so that the failure counts"
        )
    dof = len(axes) if arrays["error"] is not None else 0
    bounded = None
    if arrays["bound_ratios"] is not None:
        bounded = BoundErrors(bounds, arrays["bound_ratios"], arrays["regions"])
    numbers = np.array([track.run for track in tracks], dtype=np.int64)
    return Record(
        name,
        Errors(
            arrays["error"],
            arrays["covariance"],
            arrays["nees"],
            dof,
            axes,
            convention=convention,
            bounded=bounded,
        ),
        InnovationRecord(arrays["nis"], arrays["nis_dof"]),
        Runs(numbers, t=t, times=arrays["t"], by=arrays["by"]),
        tuple(failures),
        Truth(arrays["truth_covariance"]),
        origin=Origin(notes=tuple(notes), path=arrays["path"]),
    )


def _on_steps(tracks: Sequence[Mapping[str, Any]], steps: int) -> dict[str, Any]:
    """Arrays of tracks by name, (k, ...) each, over (runs, steps), NaN where a run has no row."""
    arrays: dict[str, Any] = {}
    for key in (*ARRAYS, "nees", "t"):
        arrays[key] = None
        for row, track in enumerate(tracks):
            values = track.get(key)
            if values is None:
                continue
            if arrays[key] is None:
                shape = (len(tracks), steps, *values.shape[1:])
                arrays[key] = np.full(shape, np.nan)
            arrays[key][row, track["column"]] = values
    return arrays


def with_failed_runs(record: Record, failed: Mapping[int, str]) -> Record:
    """The record with runs that left no estimates: NaN throughout, and failed in step 1 for the reason given by run."""
    if not failed:
        return record
    numbers = np.append(record.run_numbers, list(failed))
    order = np.argsort(numbers)

    def with_rows(array: Array) -> Array:
        nothing = np.full((len(failed), *array.shape[1:]), np.nan)
        return np.concatenate([array, nothing])[order]

    longer = replace(record, groups=None).changed(with_rows)
    failures = list(record.failures)
    for run, reason in failed.items():
        failures.append(Failure(record.name, run, 1, reason))
    failures.sort(key=lambda failure: failure.run)
    runs = replace(longer.runs, numbers=numbers[order])
    return replace(longer, runs=runs, groups=record.groups, failures=tuple(failures))


def _require_different(file: str, tracks: Sequence[Track]) -> None:
    """Refuse a run that is duplicated: the verdict counts runs that share no noise."""
    seen: dict[bytes, Track] = {}
    for track in tracks:
        if track.error is None or len(track.error) < 2 or not np.nan_to_num(track.error).any():
            continue
        error = np.ascontiguousarray(track.error)
        digest = hashlib.sha256(error.tobytes()).digest()
        other = seen.setdefault(digest, track)
        if other is not track:
            raise InputError(
                f"{file}: the runs that start at {other.place[0]} and {track.place[0]} are identical; "
                "remove the duplicate"
            )


def symmetric(covariance: Array, place: Callable[[int], str], one_triangle: bool = False) -> Array:
    """The matrices (k, n, n) made exactly symmetric; refused where they are not nearly so.

    With ``one_triangle`` zeros take the value of their mirror image, where one triangle of every matrix is all zeros
    and the other of none.
    """
    out = np.empty(covariance.shape)
    if one_triangle:
        upper = np.triu(covariance, 1).any(axis=(1, 2))
        lower = np.tril(covariance, -1).any(axis=(1, 2))
        is_upper = upper.all() and not lower.any()
        is_lower = lower.all() and not upper.any()
        one_triangle = bool(is_upper or is_lower)
    with np.errstate(invalid="ignore"):  # of infinite ones
        for piece in of_runs(out):
            P = covariance[piece]
            if one_triangle:
                P = np.where(P == 0, np.swapaxes(P, -1, -2), P)
            rows = Places(place, np.arange(piece.start, piece.stop))
            refuse(asymmetric(P, ROUNDED), rows.__getitem__, partial(_asymmetric_text, P))
            out[piece] = 0.5 * (P + np.swapaxes(P, -1, -2))
    return out


def _asymmetric_text(P: Array, row: int) -> str:
    """What is wrong with a matrix that is not symmetric, by the pair of entries that differ most."""
    gap = np.abs(P[row] - P[row].T)
    i, j = (int(k) for k in np.unravel_index(gap.argmax(), gap.shape))
    if gap[i, j] <= MIXED * np.abs(P[row]).max():
        return "the covariance is not symmetric; write P = (P + P') / 2"
    return (
        f"the covariance is not symmetric: row {i + 1}, column {j + 1} holds {P[row, i, j]:.6g}, but row {j + 1}, "
        f"column {i + 1} {P[row, j, i]:.6g}. That is more than rounding: write all entries of P in their order"
    )


def longest_start(tracks: Sequence[Track]) -> int:
    """Rows that a start known exactly may take, in which a covariance is singular; 0 where a run begins otherwise."""
    starts = []
    for track in tracks:
        P = track.covariance
        start = 0
        if P is not None and len(P) and classify(P[:1], ROUNDED)[0] != Validity.VALID:
            start = _first(classify(P, ROUNDED) == Validity.VALID)
        if start == 0 and len(track.column):
            return 0
        starts.append((start, len(track.column)))
    ended = [start for start, rows in starts if start < rows]
    if not ended:
        return max((rows for _, rows in starts), default=0)
    if min(start for start, _ in starts) == 0:
        return 0
    return max(ended)


def _first(full: Array) -> int:
    """Index of the first that is true; their number if none is."""
    return int(np.argmax(np.append(full, True)))


def judged_rows(track: Track, longest: int, what: str = "estimate") -> tuple[int, int, str]:
    """First row that is judged, first broken row, and why it is broken: ``what`` is not finite, ..."""
    rows = len(track.column)
    error_ok, kind = _soundness(track)
    full: Array = np.asarray(kind == Validity.VALID)
    start = min(_first(full), longest)
    bad: Array = ~error_ok | ~full
    bad[:start] = ~error_ok[:start] | (kind[:start] != Validity.DEFICIENT)
    if not bad.any():
        return start, rows, ""
    end = int(np.argmax(bad))
    return min(start, end), end, _reason(error_ok[end], kind[end], what)


def _soundness(track: Track) -> tuple[Array, Indices]:
    """Whether the error of each row is finite, and what its covariance is, (k,) both."""
    rows = len(track.column)
    error_ok = np.ones(rows, bool) if track.error is None else finite_rows(track.error)
    kind = np.zeros(rows, int) if track.covariance is None else classify(track.covariance, ROUNDED)
    return error_ok, kind


def _reason(error_ok: bool, kind: int, what: str = "estimate") -> str:
    """Why a row is broken."""
    if not error_ok:
        return f"{what} is not finite"
    return "covariance is not finite" if kind == Validity.NOT_FINITE else INDEFINITE


def _cut(track: Track, counted: Array) -> dict[str, Any]:
    """Arrays by name of as many rows as ``counted`` (k,) has, with the NEES of those that count."""
    end = len(counted)
    arrays: dict[str, Any] = {}
    for key in ("column", "t", *ARRAYS):
        arrays[key] = at(getattr(track, key), slice(end))
    error, P = arrays["error"], arrays["covariance"]
    if error is None or P is None:
        return arrays
    values = np.full(end, np.nan)
    values[counted] = nees(error[counted], P[counted])
    if not counted.all():
        P = np.where(counted[:, None, None], P, np.nan)
    return {**arrays, "covariance": P, "nees": values}


def not_estimated(errors: Sequence[Array], variances: Sequence[Array]) -> Indices:
    """Components whose errors are 0 in every row while their variance is one constant, (n,) of bool.

    None where a component with errors has no variance, as both may be in the wrong row, and where every error is 0.

    Parameters
    ----------
    errors, variances : (k, n) of each run
    """
    variance = np.concatenate(variances)
    variance = variance[~np.isnan(variance).any(axis=1)]
    still = ~(np.abs(np.concatenate(errors)) > NO_ERROR).any(axis=0)
    constant = (variance == variance[:1]).all(axis=0)
    idle: Indices = still & constant & (len(variance) > 1)
    none = (np.abs(variance) <= ROUNDED.zero).all(axis=0)
    return np.zeros(len(idle), bool) if still.all() or none.any() else idle


def estimated_components(e: Estimator, errors: Sequence[Array], judged: Sequence[int]) -> tuple[list[int], list[str]]:
    """Components, of those judged, that a robot in the plane estimates, too; and a note on the others."""
    part = np.array(judged)
    variances = []
    of_part = []
    for p, error in zip(e.runs, errors, strict=True):
        variances.append(p.variances[p.own.stated][:, part])
        of_part.append(error[:, part])
    idle = not_estimated(of_part, variances)
    if not idle.any():
        return list(judged), []
    names = ", ".join(np.array(e.error.axes)[part[idle]])
    note = f"{e.said}: {names} are {STILL}; --axes {','.join(e.error.axes)} judges them, too"
    return part[~idle].tolist(), [note]


def level_components(e: Estimator, judged: Sequence[int]) -> tuple[list[int], list[str]]:
    """Components, of those judged, without a z, roll or pitch that a robot in the plane does not estimate, and notes.

    Such a component never changes in the truth nor in the estimates, which may differ by a constant, and its variance
    is one constant. The constant error of a component that moves is a bias.
    """
    part = list(judged)
    near = []
    for p in e.runs:
        from_, to = p.own.t.min(initial=np.inf) - BESIDE, p.own.t.max(initial=-np.inf) + BESIDE
        near.append(p.true.values[(p.true.t >= from_) & (p.true.t <= to)])
    fixed = unchanging(e.runs, [p.own.estimate for p in e.runs])[part]
    variance = np.concatenate([p.variances[p.own.stated][:, part] for p in e.runs])
    variance = variance[~np.isnan(variance).any(axis=1)]
    constant = np.isclose(variance, variance[:1], rtol=NO_ERROR, atol=0.0).all(axis=0)
    none = (np.abs(variance) <= ROUNDED.zero).all(axis=0)
    idle = fixed & constant & unchanging(e.runs, near)[part]
    if not fixed.any() or idle.all() or (none & ~idle).any():  # a variance may be in the wrong row
        return part, []
    notes = []
    names = np.array(e.error.axes)[part]
    for which, what, left in ((idle, f"are {LEVEL}", ~idle), (fixed & ~idle, FIXED, ~fixed)):
        if which.any():
            notes.append(f"{e.said}: {', '.join(names[which])} {what.format(','.join(names[left]), ','.join(names))}")
    return np.array(part)[~idle].tolist(), notes


def unchanging(runs: Sequence[Poses], states: Sequence[Array]) -> Indices:
    """Which components (n,) are a third coordinate, or roll and pitch, that never change in any run.

    Runs that are too short, or that do not move along the first two coordinates, do not count.

    Parameters
    ----------
    states : (k, m) of each run, estimates or truth
    """
    n = runs[0].own.covariance.shape[-1]
    found = np.zeros((0, n), bool)
    for p, values in zip(runs, states, strict=True):
        values = values[finite_rows(values)]
        if len(values) < FEWEST or _same(values[:, :2]):
            continue
        still = np.zeros(n, bool)
        still[2:3] = _same(values[:, 2:3])
        if p.manifold == "spatial":
            x, y, z, w = values[:, 3:7].T
            up = np.column_stack([2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y)])
            still[3:5] = _same(up)  # the world's z axis in those of the body
            if p.convention in ("left", "right"):  # mix the axes unless the body's z axis is the world's
                still[2] &= np.abs(up[:, :2]).max() <= NO_CHANGE
        found = np.vstack([found, still])
    return np.asarray(found.all(axis=0) & bool(len(found)))


def _same(values: Array) -> bool:
    """Whether each column has the same value in all rows (k, m)."""
    return bool(np.ptp(values, axis=0).max(initial=0.0) <= NO_CHANGE)


def _singular(file: str, tracks: Sequence[Track], axes: tuple[str, ...]) -> str:
    """Message that no covariance has full rank, and what to judge in place of all components."""
    P = np.concatenate([track.covariance for track in tracks if track.covariance is not None])
    errors = np.concatenate([track.error for track in tracks if track.error is not None])
    variances = np.abs(np.diagonal(P, axis1=-2, axis2=-1))
    none = (variances <= ROUNDED.zero).all(axis=0)
    still = ~(np.abs(errors) > NO_ERROR).any(axis=0)
    if none.all():
        return f"{file}: the covariance is zero in every step; nothing to judge"
    names = np.array(axes)
    singular = f"{file}: the covariance is singular in every step"
    if not none.any():
        scale = np.sqrt(variances)
        ranks = np.linalg.matrix_rank(P / (scale[:, :, None] * scale[:, None, :]), DEFICIENT, hermitian=True)
        rank = int(np.median(ranks))
        return (
            f"{singular}: its rank is {rank} of {len(names)}. Of an ensemble of {rank + 1} members, judge far fewer "
            "components than members at a time; where states follow from others, as in a quaternion, write those that "
            "the filter estimates by themselves"
        )
    singular += f" (variance zero: {', '.join(names[none])})"
    missing = none & ~still
    idle = ~none & still
    if missing.any() and idle.any():
        return (
            f"{singular}; {', '.join(names[missing])} has errors without a variance, and {', '.join(names[idle])} a "
            "variance without errors: write each variance in the row of its own component"
        )
    unused = none
    if not still.all():
        unused = none | idle
    left = ",".join(names[~unused])
    if missing.any():
        size = short(float(np.sqrt(np.nanmean(np.square(errors[:, missing])))))
        return (
            f"{singular}; errors of {', '.join(names[missing])} are not zero ({size} RMS), so the covariance is too "
            "small without bound: state the variance that the filter has. "
            f"--axes {left} for a trajectory, --state {left} for a table, judges the rest alone"
        )
    return (
        f"{singular}; judge only what the filter estimates: --axes {left} for a trajectory, --state {left} for a table"
    )


@dataclass(frozen=True)
class Relative:
    """Division of a log into windows, and the content of its file."""

    size: float
    unit: str  # step | s | m
    motions: bool = False  # each row is the motion since the row before, and errors of motions are independent
    independent: bool = False  # errors of windows are declared to be independent
    flag: str = "--relative"  # option that names the size, for messages

    @property
    def text(self) -> str:
        """100 steps, 10 s, 50 m."""
        unit = self.unit
        if unit == "step" and self.size != 1:
            unit = "steps"
        return f"{self.size:g} {unit}"

    @property
    def option(self) -> str:
        """Value of the option: 100, 10s, 50m."""
        if self.unit == "step":
            return f"{self.size:g}"
        return f"{self.size:g}{self.unit}"


def relative_of(size: str | float | None, motions: bool = False, windows: str | None = None) -> Relative | None:
    """Parse ``--relative``, ``--motions`` and ``--windows``; None without the first.

    Raises
    ------
    InputError
        The size is not valid, or another of the options is given without it.
    """
    if windows not in (None, "independent"):
        raise InputError(f"--windows must be 'independent', got '{windows}'")
    if size is None:
        if motions:
            raise InputError(
                "--motions: motions share no world with the truth; judge them with --relative 1, 10s or 50m"
            )
        if windows is not None:
            raise InputError("--windows goes with --relative, which cuts a log into windows")
        return None
    match = re.fullmatch(r"\s*([0-9.eE+-]+)\s*([sm]?)\s*", str(size))
    value = math.nan
    unit = "step"
    if match:
        unit = UNITS[match[2]]
        with suppress(ValueError):
            value = float(match[1])
    if not (math.isfinite(value) and value > 0) or (unit == "step" and value % 1):
        raise InputError(f"--relative {size}: must be {FORMS}")
    return Relative(value, unit, motions, motions or windows is not None)


def windows(t: Array, position: Array, rows: Indices, relative: Relative, file: str) -> tuple[Indices, Indices, int]:
    """First and last row (W,) of consecutive windows, and how many were left out because rows are missing.

    A window begins where the one before ends, and ends at the first row that is far enough. Steps, time and the true
    path decide, never an estimate, so that the choice does not depend on the errors.

    Parameters
    ----------
    t : (N,), s, NaN where it is not known
    position : (k, d), true positions at ``rows``, m
    rows : (k,), rows whose truth is known, increasing
    file : name of the file, for messages

    Raises
    ------
    InputError
        No window fits, or seconds are asked for and rows have no time.
    """
    place = rows.astype(float)
    if relative.unit == "s":
        if not np.isfinite(t[rows]).all():
            raise InputError(f"{file}: {relative.flag} {relative.option} needs a column t, in s")
        place = t[rows]
    elif relative.unit == "m":
        steps = np.linalg.norm(np.diff(position, axis=0), axis=1)
        place = np.append(0.0, np.cumsum(steps))
    first = []
    last = []
    skipped = i = 0
    while (j := int(np.searchsorted(place, place[i] + relative.size - ROUNDING))) < len(place):
        if place[j] - place[i] > (1.0 + OVERSHOOT) * relative.size:
            skipped += 1
        else:
            first.append(rows[i])
            last.append(rows[j])
        i = j
    if not first:
        raise InputError(_none(place, relative, file))
    return np.array(first, np.int64), np.array(last, np.int64), skipped


def _none(place: Array, relative: Relative, file: str) -> str:
    length = float(place[-1] - place[0])
    unit = {"step": " steps"}.get(relative.unit, f" {relative.unit}")
    if length < relative.size - ROUNDING:
        return f"{file}: {relative.flag} {relative.option}: only {length:.4g}{unit} have truth; ask for shorter windows"
    gap = float(np.median(np.diff(place)))
    return (
        f"{file}: {relative.flag} {relative.option}: rows with truth are {gap:.4g}{unit} apart in the median; "
        "ask for longer windows, or give a truth of a higher rate"
    )
