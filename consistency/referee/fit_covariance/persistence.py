"""Errors that last for a whole drive, and a truth that errs itself: named, never exported as white noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import stats

from consistency.referee.errors import InputError
from consistency.referee.fit_covariance.drives import Drive
from consistency.referee.fit_covariance.motion_windows import (
    ENOUGH,
    DriveWindows,
    in_plane,
    mean_square,
    motions_between,
)
from consistency.referee.fit_covariance.refusals import RotationGrowth
from consistency.referee.fit_covariance.systematic_errors import FORWARD, jacobian_of_mean, normal_equations
from consistency.referee.fit_covariance.white_noise import WhiteNoise
from consistency.referee.geometry.lie_groups import inverse, log
from consistency.referee.readers.pipeline.relative_motions import BENT
from consistency.referee.types import Array, Indices

SURE = 0.01  # chance to name a term where there is none, all terms together
MOST = 0.5  # share of an axis' variance over the span
SHARED = 0.7  # correlation of two estimators' errors from which the truth's own are behind both
FEWEST = 8  # windows that both estimators have
TERMS = ("the scale of the way", "the scale of turns", "the drift of the heading with the way")
UNITS = {TERMS[0]: "", TERMS[1]: "", TERMS[2]: " rad/m"}


@dataclass(frozen=True)
class PersistentError:
    """An error that lasts for a whole drive, and differs between drives."""

    term: str  # of TERMS
    sigma: float  # between drives
    share: float  # of the stated variance of an axis over the span, the largest

    @property
    def decides(self) -> bool:
        """Whether few drives, which each have one value of it, do not tell the covariance of others.

        A scale lasts; a drift that is named may last for a part of a drive only, and decides where it is most of an
        axis.
        """
        return self.term in TERMS[:2] or self.share >= MOST


def doubts(
    noise: WhiteNoise,
    windows: DriveWindows,
    growth: RotationGrowth,
    persistent: Sequence[PersistentError],
) -> list[str]:
    """Sentences on errors that outlast a window or a drive, and on angles beyond first order."""
    found = []
    if growth.persists:
        found.append(
            f"the squared rotation error grows with the span to the power of {growth.power:.2g}, where white noise has "
            "1: errors last longer than a window, so that longer spans have more than this model says"
        )
    variances = noise.variances(noise.mean.corrected(windows.pieces))
    sigma = float(np.sqrt(np.median(variances[:, windows.d :].max(axis=1))))
    if sigma > BENT:
        found.append(
            f"the sigma of a rotation over the span is {sigma:.2g} rad: beyond {BENT:g} a covariance to first order is "
            "doubtful, so take a shorter span"
        )
    for each in persistent:
        found.append(
            f"{each.term} differs between drives (sigma {each.sigma:.2g}{UNITS[each.term]}): add a state for it to the "
            "filter; it is not in the exported covariance"
        )
    return found


def persistent_errors(noise: WhiteNoise, windows: DriveWindows) -> tuple[PersistentError, ...]:
    """Terms that differ between drives by more than white noise, from ``ENOUGH`` drives on.

    Each drive has means of its own, by generalised least squares on the estimated motion; their differences are
    compared with their errors by Cochran's (1954) chi-square. Where turns are measured with noise these means are too
    small, by the same factor in drives that turn alike. Of several axes of the drift the first that differs is named.
    """
    drives = np.unique(windows.drive)
    if len(drives) < ENOUGH:
        return ()
    corrected = noise.mean.applied(windows)
    effects = mean_square(jacobian_of_mean(corrected.pieces))  # (n, p), of a term of 1 on squares of an axis
    stated = noise.variances(corrected.pieces).mean(axis=0)
    own = [_own_mean(noise, windows.of(windows.drive == drive)) for drive in drives]
    values, variances = (np.array(each) for each in zip(*own, strict=True))  # (drives, p)
    terms = values.shape[1]
    found: dict[str, PersistentError] = {}
    for term in range(terms):
        variance = variance_between(values[:, term], variances[:, term], SURE / terms)
        if variance > 0:
            name = TERMS[min(term, len(TERMS) - 1)]
            share = float((variance * effects[:, term] / stated).max())
            found.setdefault(name, PersistentError(name, float(np.sqrt(variance)), share))
    return tuple(found.values())


def variance_between(values: Array, variances: Array, chance: float) -> float:
    """Variance between drives, beyond that of their values, (drives,); 0 where none is shown."""
    known = np.isfinite(variances) & (variances > 0)
    if known.sum() < ENOUGH:
        return 0.0
    value = values[known]
    weight = 1.0 / variances[known]
    center = (weight * value).sum() / weight.sum()
    statistic = float((weight * (value - center) ** 2).sum())
    dof = len(value) - 1
    if stats.chi2.sf(statistic, dof) > chance:
        return 0.0
    # DerSimonian & Laird (1986)
    return float((statistic - dof) / (weight.sum() - (weight**2).sum() / weight.sum()))


def _own_mean(noise: WhiteNoise, windows: DriveWindows) -> tuple[Array, Array]:
    """Scale, turn and drift (p,) that a drive has beyond the mean of all, and their variances; infinite if unknown."""
    C = noise.covariance(noise.mean.corrected(windows.pieces))
    equations = normal_equations(windows, noise.mean, C, [FORWARD])[FORWARD]
    H, g = equations.A.sum(axis=0), equations.b.sum(axis=0)
    size = np.sqrt(np.maximum(np.diag(H), 1e-300))
    inverted = np.linalg.pinv(H / np.outer(size, size), rcond=1e-6)
    variance = np.where(np.diag(H) > 1e-200, np.diag(inverted) / size**2, np.inf)
    return inverted @ (g / size) / size, variance


# --- a second estimator -----------------------------------------------------------------------------------------------


class SecondErrors(NamedTuple):
    """Errors of a second estimator over the same windows, for each of n axes."""

    correlation: Array  # (n,), with those of the first
    size: Array  # (n,), standard deviation over that of the first

    @property
    def is_shared(self) -> Array:
        """Which errors both have, (n,) bool: they are those of the truth, or of what both use."""
        return np.asarray(self.correlation > SHARED)

    @property
    def is_rough(self) -> Array:
        """Where the second errs so much more that even a truth with all errors of the first would not be seen."""
        return np.asarray(self.size > 1.0 / SHARED)


def errors_of_second(noise: WhiteNoise, windows: DriveWindows, second: Sequence[Drive]) -> SecondErrors:
    """Compare the errors of another estimator with the corrected ones.

    Raises
    ------
    InputError
        The second one has other drives, or no window in common.
    """
    corrected = noise.mean.applied(windows).errors
    first, other = [], []
    for i in np.unique(windows.drive):
        drive = windows.drives[i]
        twin = _same_drive(drive, second, len(windows.drives))
        rows = np.flatnonzero(windows.drive == i)
        start = _rows_at(twin, drive, windows.first[rows])
        end = _rows_at(twin, drive, windows.last[rows])
        both = (start >= 0) & (end >= 0)
        estimated = motions_between(twin.estimate, start[both], end[both])
        if windows.d == 2 and twin.d == 3:
            estimated = in_plane(estimated)
        true = windows.true[rows[both]]
        if estimated.shape[1:] != true.shape[1:]:
            raise InputError("--second: needs poses of the same kind, in the plane or in space")
        errors = log(inverse(estimated) @ true)
        first.append(corrected[rows[both]])
        other.append(errors - errors.mean(axis=0) if len(errors) else errors)
    a, b = np.concatenate(first), np.concatenate(other)
    if len(a) < FEWEST:
        raise InputError(f"--second: has {len(a)} windows in common; its times must be those of the estimates")
    size, size_of_second = (np.maximum(each.std(axis=0), 1e-300) for each in (a, b))
    covariance = ((a - a.mean(axis=0)) * (b - b.mean(axis=0))).mean(axis=0)
    return SecondErrors(covariance / (size * size_of_second), size_of_second / size)


def _same_drive(drive: Drive, second: Sequence[Drive], drives: int) -> Drive:
    """The second estimator's drive of this name; a single one needs no name."""
    if len(second) == drives == 1:
        return second[0]
    for each in second:
        if each.name == drive.name:
            return each
    raise InputError(f"--second: has no drive '{drive.name}'; it needs the same drives")


def _rows_at(twin: Drive, drive: Drive, rows: Indices) -> Indices:
    """Rows of another drive at the times of some rows; -1 where it has none within half its own period."""
    own, other = drive.t, twin.t
    if not (np.isfinite(own).all() and np.isfinite(other).all()):
        own, other = drive.row.astype(float), twin.row.astype(float)
    at = own[rows]
    near = np.searchsorted(0.5 * (other[1:] + other[:-1]), at)
    period = 0.51 * float(np.median(np.diff(other)))
    return np.where(np.abs(other[near] - at) <= period, near, -1)
