"""Ratios of true to stated covariance on drives that chose nothing, and what they show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import special, stats

from consistency.referee.defaults import CONFIDENCE, DETECT
from consistency.referee.errors import InputError
from consistency.referee.fit_covariance.drives import Drive
from consistency.referee.fit_covariance.motion_windows import BLOCKS, ENOUGH, DriveWindows
from consistency.referee.fit_covariance.white_noise import WhiteNoise, fit_noise
from consistency.referee.readers.runs_to_record import listed
from consistency.referee.types import Array, Indices

DECIDE = 50  # windows that decide where drives are fewer than ENOUGH
HALF = "half"


@dataclass(frozen=True)
class Fold:
    """A fit to some drives or first halves, and what it is judged by."""

    noise: WhiteNoise
    judged: Indices  # drives
    since: Array  # (drives,), row from which a window may be judged; 0 where the whole drive is

    def judges(self, windows: DriveWindows) -> Array:
        """Which windows chose nothing of this fit, (W,)."""
        return np.asarray(np.isin(windows.drive, self.judged) & (windows.first >= self.since[windows.drive]))


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
        return "overconfident" if self.low > 1.0 else "conservative" if self.high < 1.0 else "undecided"

    @property
    def reach(self) -> tuple[float, float]:
        """Ratio of a new drive: two standard deviations between drives about the mean."""
        return self.value * float(np.exp(-2 * self.spread)), self.value * float(np.exp(2 * self.spread))


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
    drives: Sequence[Drive],
    windows: DriveWindows,
    held_out: str | None,
    correct: bool | str,
    jitter: Array | float = 0.0,
) -> tuple[WhiteNoise, list[Fold]]:
    """The fit that is handed out, and those that are judged.

    Parameters
    ----------
    held_out : names of drives that are judged and not fitted, with commas; "half": the first half of every drive is
        fitted and the second judged; None: each drive is judged by a fit to all others

    Raises
    ------
    InputError
        A name is no drive, or nothing is left to fit or to judge.
    """
    none = np.zeros(len(drives), np.int64)
    every = np.arange(len(drives))
    if held_out == HALF or (held_out is None and len(drives) == 1):
        ends = [windows.last[windows.drive == i] for i in every]
        middle = np.array([int(each[(len(each) - 1) // 2]) if len(each) else 0 for each in ends])  # rows at half time
        early = windows.of(windows.last <= middle[windows.drive])
        return fit_noise(windows, correct, jitter), [Fold(fit_noise(early, correct, jitter), every, middle)]
    if held_out is None:
        fits = [fit_noise(windows.of(windows.drive != i), correct, jitter) for i in np.unique(windows.drive)]
        return fit_noise(windows, correct, jitter), [
            Fold(fit, np.array([i]), none) for i, fit in zip(np.unique(windows.drive), fits, strict=True)
        ]
    names = [name.strip() for name in held_out.split(",")]
    known = [drive.name for drive in drives]
    if unknown := [name for name in names if name not in known]:
        raise InputError(f"--held-out {held_out}: no drive '{unknown[0]}'; there are {listed(known)}, or 'half'")
    judged = np.array([known.index(name) for name in names])
    rest = ~np.isin(windows.drive, judged)
    if not rest.any() or rest.all():
        raise InputError(f"--held-out {held_out}: leaves no window to {'fit' if not rest.any() else 'judge'}")
    noise = fit_noise(windows.of(rest), correct, jitter)
    return noise, [Fold(noise, judged, none)]


def judged_by(folds: Sequence[Fold], windows: DriveWindows, drives: int, general: bool) -> JudgedSpan:
    """Ratios of the windows of a span, each by the fit that it did not choose; of the whole and of each axis."""
    parts = []
    for fold in folds:
        some = windows.of(fold.judges(windows))
        whole, axes = fold.noise.nees(some)
        parts.append((some.drive, np.column_stack([whole, axes])))
    drive, values = (np.concatenate(each) for each in zip(*parts, strict=True))
    by_drive, counts = np.full((drives, values.shape[1]), np.nan), np.bincount(drive, minlength=drives)
    for i in np.unique(drive):
        by_drive[i] = values[drive == i].mean(axis=0)
    n = values.shape[1] - 1
    ratios = [ratio_of(by_drive[:, k], values[:, k], general, counts * (1 if k else n)) for k in range(values.shape[1])]
    return JudgedSpan(windows.span.option, ratios[0], tuple(ratios[1:]), by_drive)


def ratio_of(by_drive: Array, values: Array, general: bool = True, dof: Array | None = None) -> Ratio:
    """Geometric mean of the ratios of drives, (drives,), with Student's interval of its logarithm.

    The logarithm of a mean square with few degrees of freedom, ``dof`` (drives,), is too small on average, by what a
    chi-square has (Bartlett & Kendall 1946, "The statistical analysis of variance-heterogeneity and the logarithmic
    transformation", J. R. Statist. Soc. Suppl. 8).
    A single drive has an interval from the means of consecutive windows, of ``values`` (W,), which holds for it alone.
    """
    there = np.isfinite(by_drive) & (by_drive > 0)
    known = by_drive[there]
    tail = 0.5 * (1.0 - CONFIDENCE)
    if len(known) > 1:
        logs = np.log(known)
        if dof is not None:
            logs += np.log(0.5 * dof[there]) - special.digamma(0.5 * dof[there])
        spread = float(logs.std(ddof=1))
        reach = float(stats.t.isf(tail, len(logs) - 1)) * spread / np.sqrt(len(logs))
        center = float(logs.mean())
    elif len(known) == 1:
        blocks = np.array([part.mean() for part in np.array_split(values, min(BLOCKS, len(values)))])
        k, center, spread = len(blocks), float(np.log(values.mean())), float("nan")
        reach = float(stats.t.isf(tail, k - 1) * blocks.std(ddof=1) / np.sqrt(k) / blocks.mean()) if k > 1 else np.inf
    else:
        return Ratio(*(float("nan"),) * 4, drives=0, windows=len(values), general=general)
    low, high = float(np.exp(center - reach)), float(np.exp(min(center + reach, 700.0)))
    return Ratio(float(np.exp(center)), low, high, spread, len(known), len(values), general)
