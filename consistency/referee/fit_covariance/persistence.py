"""Errors that last for a whole drive, and a truth that errs itself: named, never exported as white noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import stats

from consistency.referee.errors import InputError
from consistency.referee.fit_covariance.drives import Drive
from consistency.referee.fit_covariance.motion_windows import ENOUGH, DriveWindows, in_plane
from consistency.referee.fit_covariance.refusals import RotationGrowth
from consistency.referee.fit_covariance.systematic_errors import error_derivatives
from consistency.referee.fit_covariance.white_noise import WhiteNoise
from consistency.referee.geometry.groups import inverse, log
from consistency.referee.readers.relative_motions import BENT
from consistency.referee.types import Array

SURE = 0.01  # chance to name a term where there is none, all terms together
MOST = 0.5  # share of an axis' variance over the span
SHARED = 0.7  # correlation of two estimators' errors from which the truth's own are behind both
TERMS = ("the scale of the way", "the scale of turns", "the drift of the heading with the way")
UNITS = dict(zip(TERMS, ("", "", " rad/m"), strict=True))


@dataclass(frozen=True)
class Lasting:
    """An error that lasts for a whole drive, and differs between drives."""

    term: str
    sigma: float  # between drives
    share: float  # of the stated variance of an axis over the span, the largest

    @property
    def decides(self) -> bool:
        """Whether few drives, which each have one value of it, do not tell the covariance of others.

        A scale lasts; a drift that is named may last for a part of a drive only, and decides where it is most of an
        axis.
        """
        return self.term in TERMS[:2] or self.share >= MOST


def doubts(noise: WhiteNoise, windows: DriveWindows, growth: RotationGrowth, lasting: Sequence[Lasting]) -> list[str]:
    """Sentences on errors that outlast a window or (:func:`persistent`) a drive, and on angles beyond first order."""
    found = []
    if growth.persists:
        found.append(
            f"the squared rotation error grows with the span to the power of {growth.power:.2g}, where white noise has "
            "1: errors last longer than a window, so that longer spans have more than this model says"
        )
    now = noise.mean.applied(windows)
    angles = np.diagonal(noise.covariance(now.pieces), axis1=1, axis2=2)[:, now.d :].max(axis=1)
    if (sigma := float(np.sqrt(np.median(angles)))) > BENT:
        found.append(
            f"the sigma of a rotation over the span is {sigma:.2g} rad: beyond {BENT:g} a covariance to first order is "
            "doubtful, so take a shorter span"
        )
    return found + [
        f"{each.term} differs between drives (sigma {each.sigma:.2g}{UNITS[each.term]}): add a state for it to the "
        "filter; it is not in the exported covariance"
        for each in lasting
    ]


def persistent(noise: WhiteNoise, windows: DriveWindows) -> tuple[Lasting, ...]:
    """Terms that differ between drives by more than white noise, from ``ENOUGH`` drives on.

    Each drive has means of its own, by generalised least squares; their differences are compared with their errors by
    Cochran's (1954) chi-square. Of several axes of the drift the first that differs is named.
    """
    names = np.unique(windows.drive)
    if len(names) < ENOUGH:
        return ()
    found: dict[str, Lasting] = {}
    now = noise.mean.applied(windows)
    effect = (error_derivatives(now.pieces) ** 2).mean(axis=0)  # (n, p), of a term of 1 on the mean square of an axis
    stated = np.diagonal(noise.covariance(now.pieces), axis1=1, axis2=2).mean(axis=0)
    own = [_means(noise, now.of(windows.drive == name)) for name in names]
    for term in range(own[0][0].shape[0]):
        value, variance = (np.array([each[k][term] for each in own]) for k in (0, 1))
        weight = np.where(np.isfinite(variance) & (variance > 0), 1.0 / np.where(variance > 0, variance, 1.0), 0.0)
        if (weight > 0).sum() < ENOUGH:
            continue
        center = (weight * value).sum() / weight.sum()
        statistic, dof = float((weight * (value - center) ** 2).sum()), int((weight > 0).sum()) - 1
        if stats.chi2.sf(statistic, dof) > SURE / own[0][0].shape[0]:
            continue
        # DerSimonian & Laird (1986): variance between drives beyond that of the estimates
        between = (statistic - dof) / (weight.sum() - (weight**2).sum() / weight.sum())
        kind = TERMS[min(term, len(TERMS) - 1)]
        found.setdefault(
            kind, Lasting(kind, float(np.sqrt(between)), float((between * effect[:, term] / stated).max()))
        )
    return tuple(found.values())


def _means(noise: WhiteNoise, windows: DriveWindows) -> tuple[Array, Array]:
    """Scale, turn and drift (p,) that a drive has beyond the mean of all, and their variances; infinite if unknown."""
    C, X, e = noise.covariance(windows.pieces), error_derivatives(windows.pieces), windows.errors
    solved = np.linalg.solve(C, np.concatenate([X, e[..., None]], axis=-1))
    H = (np.swapaxes(X, 1, 2) @ solved[..., :-1]).sum(axis=0)
    g = (np.swapaxes(X, 1, 2) @ solved[..., -1:]).sum(axis=0)[:, 0]
    size = np.sqrt(np.maximum(np.diag(H), 1e-300))
    scaled = np.linalg.pinv(H / np.outer(size, size), rcond=1e-6)
    known = np.diag(H) > 1e-200
    return scaled @ (g / size) / size, np.where(known, np.diag(scaled) / size**2, np.inf)


class Second(NamedTuple):
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


def errors_of_second(
    noise: WhiteNoise, windows: DriveWindows, drives: Sequence[Drive], second: Sequence[Drive]
) -> Second:
    """Errors of another estimator beside the corrected ones.

    Raises
    ------
    InputError
        The second one has other drives, or no window in common.
    """
    named = {drive.name: drive for drive in second}
    own, other = [], []
    corrected = noise.mean.applied(windows).errors
    for i in np.unique(windows.drive):
        drive, rows = drives[i], np.flatnonzero(windows.drive == i)
        twin = named.get(drive.name) or (second[0] if len(second) == len(drives) == 1 else None)
        if twin is None:
            raise InputError(f"--second: has no drive '{drive.name}'; it needs the same drives")
        place = [_at(twin, drive, ends[rows]) for ends in (windows.first, windows.last)]
        both = (place[0] >= 0) & (place[1] >= 0)
        T = twin.estimate
        D = inverse(T[place[0][both]]) @ T[place[1][both]]
        true = windows.true[rows][both]
        D = in_plane(D) if windows.d == 2 and twin.d == 3 else D
        if D.shape[1:] != true.shape[1:]:
            raise InputError("--second: needs poses of the same kind, in the plane or in space")
        error = log(inverse(D) @ true)
        own.append(corrected[rows][both])
        other.append(error - error.mean(axis=0) if len(error) else error)
    a, b = np.concatenate(own), np.concatenate(other)
    if len(a) < 8:
        raise InputError(f"--second: has {len(a)} windows in common; its times must be those of the estimates")
    a, b = a - a.mean(axis=0), b - b.mean(axis=0)
    own_size, size = (np.maximum(np.sqrt((each**2).mean(axis=0)), 1e-300) for each in (a, b))
    return Second((a * b).mean(axis=0) / (own_size * size), size / own_size)


def _at(twin: Drive, drive: Drive, rows: Array) -> Array:
    """Rows of another drive at the times of some rows; -1 where it has none within half its own period."""
    clock = np.isfinite(drive.t).all() and np.isfinite(twin.t).all()
    own, other = (drive.t, twin.t) if clock else (drive.row.astype(float), twin.row.astype(float))
    at = own[rows]
    near = np.clip(np.searchsorted(other, at), 1, len(other) - 1)
    near = near - (at - other[near - 1] < other[near] - at)
    period = 0.51 * float(np.median(np.diff(other)))
    return np.where(np.abs(other[near] - at) <= period, near, -1)
