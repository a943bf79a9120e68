"""Ratios of true to stated covariance on drives that chose nothing, and what they show.

The judged motions become a record, and files that ``analyse --motions`` reads.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import special

from consistency.referee.column_names import COVARIANCE
from consistency.referee.defaults import DETECT
from consistency.referee.diagnostics.number_words import short
from consistency.referee.diagnostics.record import Record
from consistency.referee.diagnostics.verdict_parts import Interval
from consistency.referee.errors import InputError
from consistency.referee.fit_covariance.drives import BLOCKS, ENOUGH, DriveWindows
from consistency.referee.fit_covariance.estimation import mean_over_runs
from consistency.referee.fit_covariance.mean_and_noise import WhiteNoise
from consistency.referee.geometry import composed, propagated, to_left, vectors
from consistency.referee.readers.pipeline.relative_motions import relative_recording
from consistency.referee.readers.places import Places, listed
from consistency.referee.readers.runs_to_record import Relative
from consistency.referee.readers.truth_matching import Poses, make_poses
from consistency.referee.system import with_progress
from consistency.referee.types import Array, Indices

DECIDE = 50  # windows that decide where drives are fewer than ENOUGH
HALF = "half"
IN_TURN = "in turn"
NEVER = np.iinfo(np.int64).max  # no row
DIGITS = "%.17g"  # all that a number has
CONVENTIONS = {3: "so2", 6: "so3"}  # the defaults of files, so that they are read without further options


@dataclass(frozen=True)
class Fold:
    """A fit to some drives or first halves, and what it is judged by."""

    noise: WhiteNoise
    since: Indices  # (drives,), row from which windows are judged, NEVER in drives that are fitted alone

    @property
    def judged(self) -> Indices:
        """Drives with windows that are judged."""
        return np.flatnonzero(self.since < NEVER)

    def judges(self, windows: DriveWindows) -> Array:
        """Which windows chose nothing of this fit, (W,)."""
        return np.asarray(windows.first >= self.since[windows.drive])


@dataclass(frozen=True)
class Ratio:
    """Ratio of true to stated covariance, with its interval."""

    value: float  # geometric mean over drives
    low: float
    high: float
    spread: float  # standard deviation of its logarithm between drives; NaN with one
    drives: int
    windows: int
    general: bool = True  # False where the judged drives took part in the fit with their other half

    @property
    def status(self) -> str:
        """consistent, overconfident, conservative or undecided."""
        if not np.isfinite(self.low) or (self.drives < ENOUGH and self.windows < DECIDE):
            return "undecided"
        if self.low >= 1.0 / DETECT and self.high <= DETECT:
            return "consistent" if self.general and self.drives > 1 else "undecided"
        if self.low > 1.0:
            return "overconfident"
        return "conservative" if self.high < 1.0 else "undecided"

    @property
    def reach(self) -> tuple[float, float]:
        """Ratio of a new drive: two standard deviations between drives about the mean."""
        factor = float(np.exp(2 * self.spread))
        return self.value / factor, self.value * factor


@dataclass(frozen=True)
class JudgedSpan:
    """What the windows of one span show."""

    span: str
    whole: Ratio
    axes: tuple[Ratio, ...]  # of each component alone
    by_drive: Array  # (drives, 1 + n), of the whole and of each axis; NaN where a drive has no window

    @property
    def status(self) -> str:
        """That of the whole; where that is consistent, inconsistent or undecided if an axis is not."""
        if self.whole.status != "consistent":
            return self.whole.status
        found = {axis.status for axis in self.axes if axis.drives}  # an axis without any error tells nothing
        if found & {"overconfident", "conservative"}:
            return "inconsistent"
        return "undecided" if "undecided" in found else "consistent"


def folds_of(
    windows: DriveWindows,
    held_out: str | None,
    fit: Callable[[DriveWindows], WhiteNoise],
) -> tuple[WhiteNoise, list[Fold]]:
    """The fit that is handed out, and those that are judged.

    Parameters
    ----------
    held_out : names of drives that are judged and not fitted, with commas; "half": the first half of every drive is
        fitted and the second judged; None: each drive is judged by a fit to all others

    Raises
    ------
    InputError
        A name is not a drive, or nothing is left to fit or to judge.
    """
    every = np.arange(len(windows.drives))
    if held_out == HALF:
        half_time = np.zeros(len(every), int)
        for i in np.unique(windows.drive):
            ends = windows.last[windows.drive == i]
            half_time[i] = ends[(len(ends) - 1) // 2]
        since = [half_time]
    elif held_out is None:
        since = [np.where(every == i, 0, NEVER) for i in np.unique(windows.drive)]
    else:
        judged = named([drive.name for drive in windows.drives], held_out)
        is_judged = np.isin(windows.drive, judged)
        if is_judged.all() or not is_judged.any():
            raise InputError(f"--held-out {held_out}: leaves no window to {'fit' if is_judged.all() else 'judge'}")
        since = [np.where(np.isin(every, judged), 0, NEVER)]
    folds = []
    for each in with_progress(since, "fitting", "fits"):
        is_fitted = windows.last <= each[windows.drive]
        folds.append(Fold(fit(windows.of(is_fitted)), each))
    if held_out in (None, HALF):
        return fit(windows), folds
    return folds[0].noise, folds


def named(known: Sequence[str], held_out: str, what: str = "drive") -> Indices:
    """Places of the names of ``--held-out`` among those that are known.

    Raises
    ------
    InputError
        A name is not there.
    """
    names = [name.strip() for name in held_out.split(",")]
    for name in names:
        if name not in known:
            raise InputError(f"--held-out {held_out}: no {what} '{name}'; there are {listed(known)}, or 'half'")
    return np.array([known.index(name) for name in names])


def require_fixed_groups(record: Record) -> None:
    """Refuse groups that select on the outcome."""
    if record.groups is not None and record.groups.outcome:
        raise InputError(
            f"--by {record.groups.column}: {record.groups.outcome}, which selects on the outcome: by it a right "
            "statement has other ratios, too, so that factors would be wrong"
        )


def fitted_and_judged(labels: Sequence[str], counted: Array, held_out: str | None) -> tuple[Indices, Indices]:
    """Rows of the runs that are fitted, and of those that are judged, among them runs that failed from the start.

    Parameters
    ----------
    counted : (runs,) of bool, runs with a step that can be fitted
    """
    every = np.arange(len(labels))
    if held_out is None:
        return every[counted], every
    judged = every[len(every) // 2 :]
    if held_out != HALF:
        judged = named(labels, held_out, "run")
    fitted = np.setdiff1d(every[counted], judged)
    if len(fitted) < 2 or not counted[judged].any():
        raise InputError(f"--held-out {held_out}: leaves {len(fitted)} runs to fit; it takes 2, and 1 to judge")
    return fitted, judged


def judged_by(folds: Sequence[Fold], windows: DriveWindows, general: bool) -> JudgedSpan:
    """Ratios of the windows of a span, each by the fit that it did not choose; of the whole and of each axis."""
    drives, parts = [], []
    for fold in folds:
        some = windows.of(fold.judges(windows))
        drives.append(some.drive)
        parts.append(np.column_stack(fold.noise.nees(some)))
    drive = np.concatenate(drives)
    values = np.concatenate(parts)
    by_drive = np.full((len(windows.drives), values.shape[1]), np.nan)
    for i in np.unique(drive):
        by_drive[i] = values[drive == i].mean(axis=0)
    dof = np.bincount(drive, minlength=len(by_drive))
    axes = zip(by_drive.T[1:], values.T[1:], strict=True)
    return JudgedSpan(
        span=windows.span.option,
        whole=ratio_of(by_drive[:, 0], values[:, 0], general, len(windows.axes) * dof),
        axes=tuple(ratio_of(*axis, general, dof) for axis in axes),
        by_drive=by_drive,
    )


def ratio_of(
    by_drive: Array,
    values: Array,
    general: bool = True,
    dof: Array | None = None,
) -> Ratio:
    """Geometric mean of the ratios of drives, (drives,), with Student's interval of its logarithm.

    The logarithm of a mean square with few degrees of freedom, ``dof`` (drives,), is too small on average, by what a
    chi-square has (Bartlett & Kendall 1946, "The statistical analysis of variance-heterogeneity and the logarithmic
    transformation", J. R. Statist. Soc. Suppl. 8).
    A single drive has an interval from the means of consecutive windows, of ``values`` (W,), which holds for it alone.
    """
    known = np.isfinite(by_drive) & (by_drive > 0)
    ratios = by_drive[known]
    center = spread = reach = float("nan")
    if len(ratios) > 1:
        logs = np.log(ratios)
        if dof is not None:
            half = 0.5 * dof[known]
            logs += np.log(half) - special.digamma(half)
        center, _, high = mean_over_runs(logs)
        spread, reach = float(logs.std(ddof=1)), high - center
    elif len(ratios) == 1:
        parts = [part.mean() for part in np.array_split(values, min(BLOCKS, len(values)))]
        middle, _, high = mean_over_runs(np.array(parts))
        center = float(np.log(values.mean()))
        reach = (high - middle) / middle if len(parts) > 1 else np.inf
    value, low, high = np.exp(np.minimum([center, center - reach, center + reach], 700.0)).tolist()
    return Ratio(value, low, high, spread, len(ratios), len(values), general)


def shown(ratio: Ratio | Interval) -> str:
    """A ratio with its interval, where that is known."""
    if not np.isfinite([ratio.low, ratio.high]).all():
        return short(ratio.value)
    return f"{short(ratio.value)} [{short(ratio.low)}, {short(ratio.high)}]"


def stretches_of(windows: DriveWindows, folds: Sequence[Fold]) -> list[Poses]:
    """Each stretch of neighbouring windows of a drive that are judged; a window left out begins another."""
    found: list[Poses] = []
    for fold in folds:
        some = windows.of(fold.judges(windows))
        corrected = fold.noise.mean.applied(some)
        C = fold.noise.covariance(corrected.pieces)
        begins = np.flatnonzero(~some.follows) + 1
        for part in np.split(np.arange(len(C)), begins):
            if len(part):
                found.append(_stretch(len(found), corrected.of(part), C[part]))
    return found


def _stretch(run: int, windows: DriveWindows, C: Array) -> Poses:
    """Neighbouring windows of one drive as rows, the first of which is only where they start."""
    drive = windows.drives[windows.drive[0]]
    n = len(windows.axes)
    convention = CONVENTIONS[n]
    D = windows.motions
    P = propagated(np.linalg.inv(to_left(D, convention)), C)
    start = np.eye(windows.d + 1)[None]
    t = drive.t[np.append(windows.first, windows.last[-1])]
    return make_poses(
        place=Places(lambda row: f"{drive.name}, window {row}", np.arange(len(t))),
        t=t,
        estimate=vectors(np.concatenate([start, D])),
        covariance=np.concatenate([np.zeros((1, n, n)), P]),
        stated=np.ones(len(t), bool),
        true_t=t,
        truth=vectors(composed(np.concatenate([start, windows.true]))),
        manifold="planar" if n == 3 else "spatial",
        convention=convention,
        max_dt=0.0,
        run=run,
        files=(drive.name, drive.name),
    )


def record_of_motions(stretches: Sequence[Poses], axes: Sequence[str]) -> Record:
    """The record that ``analyse --motions --relative 1`` has of the written files."""
    one = Relative(1.0, "step", motions=True, independent=True)
    names = ("x", "y", "heading") if len(axes) == 3 else axes
    return relative_recording("motions", "motions", stretches, names, range(len(axes)), one)


def write_motions(stretches: Sequence[Poses], folder: Path) -> list[str]:
    """motions.csv and truth.csv in the plane, folders motions/ and truth/ of trajectories in space; their names.

    The tables have a clock where all stretches have one.
    """
    if stretches[0].d != 2:
        for part in ("motions", "truth"):
            (folder / part).mkdir()
        for each in stretches:
            file = f"{each.source.run:03d}-{str(each.source.files[0]).replace('/', '_')}.tum"
            covariances = each.own.covariance.reshape(len(each.own.t), -1)
            np.savetxt(folder / "motions" / file, np.column_stack([each.own.t, each.own.estimate, covariances]), DIGITS)
            np.savetxt(folder / "truth" / file, np.column_stack([each.own.t, each.true.values]), DIGITS)
        return ["motions", "truth"]
    motions, truth = [], []
    for each in stretches:
        keys = np.column_stack([np.full(len(each.own.t), each.source.run), np.arange(len(each.own.t)), each.own.t])
        stated = [each.own.covariance[:, i, j] for i, j in COVARIANCE.values()]
        motions.append(np.column_stack([keys, each.own.estimate, *stated]))
        truth.append(np.column_stack([keys, each.true.values]))
    head = np.array(["run", "step", "t", "x", "y", "heading", *COVARIANCE])
    for name, parts in (("motions", motions), ("truth", truth)):
        rows = np.concatenate(parts)
        known = ~np.isnan(rows).any(axis=0)
        columns = ",".join(head[: len(known)][known])
        np.savetxt(folder / f"{name}.csv", rows[:, known], DIGITS, ",", header=columns, comments="")
    return ["motions.csv", "truth.csv"]
