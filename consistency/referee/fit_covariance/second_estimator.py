"""Errors of a second estimator on the same drives: those that both have are the truth's."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from consistency.referee.errors import InputError
from consistency.referee.fit_covariance.drives import Drive
from consistency.referee.fit_covariance.motion_windows import (
    DriveWindows,
    matrices_of,
    motions_between,
    root_mean_square,
)
from consistency.referee.fit_covariance.white_noise import WhiteNoise
from consistency.referee.geometry.lie_groups import inverse, log
from consistency.referee.types import Array, Indices

SHARED = 0.7  # correlation of two estimators' errors from which the truth's own are behind both
FEWEST = 8  # windows that both estimators have


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
        estimated = motions_between(twin.estimate, start[both], end[both], planar=windows.d == 2)
        if estimated.shape[1] != len(windows.axes):
            raise InputError("--second: needs poses of the same kind, in the plane or in space")
        errors = log(inverse(matrices_of(estimated)) @ windows.true[rows[both]])
        first.append(corrected[rows[both]])
        other.append(errors - errors.mean(axis=0) if len(errors) else errors)
    a, b = np.concatenate(first), np.concatenate(other)
    if len(a) < FEWEST:
        raise InputError(f"--second: has {len(a)} windows in common; its times must be those of the estimates")
    a -= a.mean(axis=0)
    b -= b.mean(axis=0)
    size, size_of_second = root_mean_square(a), root_mean_square(b)
    correlation = (a * b).mean(axis=0) / (size * size_of_second)
    return SecondErrors(correlation, size_of_second / size)


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
