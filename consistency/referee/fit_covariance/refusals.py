"""What makes a fit of white noise meaningless, each with its reason and remedy; limits from drives of seven systems."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy import stats

from consistency.referee.errors import InputError
from consistency.referee.fit_covariance.drives import Drive
from consistency.referee.fit_covariance.motion_windows import (
    ROUNDED,
    STILL,
    DriveWindows,
    mean_square,
    motions_between,
    norms,
    rotation_vectors,
)
from consistency.referee.fit_covariance.systematic_errors import Mean, fit_mean, no_mean
from consistency.referee.geometry.lie_groups import inverse, log
from consistency.referee.types import Array, Indices

CUT = 0.05  # share of windows with a jump
TURNED = 0.1  # share of the squared error of positions that a constant turn of the body explains
SCALE = 1.3  # of the true over the estimated way
SHRINKING = 0.5  # power of the span that the squared rotation error grows with; 1 is white noise
PERSISTENT = 1.4  # the same, from which errors last longer than a window
ERRORS = 3.0  # standard errors that the power must be from 1, too
LONGER = (1, 2, 3, 5, 8, 12, 20, 30, 50)  # multiples of the span
CONSTANT = 1e-6  # of a rotation matrix, by which placeholders differ at most
FOLLOWS = 0.1  # of the way: steps agree by as much more in the body than in the world where the path turns with it
FEW = 8  # windows that a mean square needs
FAR, NEAR = 20, 1  # spans between two passes of a place, along the way at least and in space at most
RARE = 0.002  # probability that white noise shows as much of a turned body, or as little between passes
LIVE = "record the live odometry, before loops are closed or a map corrects it"


@dataclass(frozen=True)
class RotationGrowth:
    """Power of the span with which the squared rotation error grows; NaN where drives are too short to tell."""

    power: float
    error: float  # standard error

    @property
    def shrinks(self) -> bool:
        return self.power < SHRINKING and self.power + ERRORS * self.error < 1.0

    @property
    def persists(self) -> bool:
        return self.power > PERSISTENT and self.power - ERRORS * self.error > 1.0


class Revisits(NamedTuple):
    """Rotation error between two passes of a place over that of windows of ten spans; NaN where there are no passes."""

    ratio: float = float("nan")
    chance: float = 1.0  # that white noise has as little

    @property
    def are_closed(self) -> bool:
        """Whether loops are closed."""
        return self.ratio < 1.0 and self.chance < RARE


class BodyTurn(NamedTuple):
    """A constant turn B of the body, with M = B^-1 D B."""

    angle: float  # rad
    share: float  # of squared errors of positions that it explains, beyond what the means do
    chance: float  # that independent errors of windows have as much of it


# --- poses ------------------------------------------------------------------------------------------------------------


def require_poses(drives: Sequence[Drive]) -> None:
    """Refuse estimates or a truth that are increments, or positions with placeholders of orientations."""
    for drive in drives:
        _require_poses(drive.name, "estimates", drive.estimate, drive.truth, "give --motions")
        _require_poses(drive.name, "truth", drive.truth, drive.estimate, "compound them to poses")


def _require_poses(
    drive: str,
    name: str,
    T: Array,
    other: Array,
    remedy: str,
) -> None:
    if _are_placeholders(T, other):
        raise InputError(
            f"{drive}: all rows of the {name} have one orientation, though the path turns: it is a placeholder, as "
            f"with positions alone; motions are compared in the body's frame, so give {name} with orientations"
        )
    if _are_increments(T, other):
        raise InputError(f"{drive}: rows of the {name} seem to be motions since the row before, not poses; {remedy}")


def _are_placeholders(T: Array, other: Array) -> bool:
    """Whether orientations are one constant, though those of another follow a path that turns."""
    d = T.shape[-1] - 1
    if np.abs(T[:, :d, :d] - T[0, :d, :d]).max() > CONSTANT:
        return False
    steps = np.diff(other[:, :-1, -1], axis=0)
    in_body = np.swapaxes(other[:-1, :d, :d], -1, -2) @ steps[..., None]
    agree_in_body = np.linalg.norm(in_body.sum(axis=0))
    agree_in_world = np.linalg.norm(steps.sum(axis=0))
    return bool(agree_in_body - agree_in_world > FOLLOWS * norms(steps).sum())


def _are_increments(T: Array, other: Array) -> bool:
    """Whether positions have the size of the steps of another, in most rows that move, and their own steps do not."""
    sizes = norms(T[1:, :-1, -1])
    own = _steps(T)
    steps = _steps(other)
    moves = steps > STILL * np.median(steps)
    alike = (sizes < SCALE * steps) & (sizes > steps / SCALE) & moves
    return bool(alike.sum() > 0.5 * moves.sum() and own.sum() < steps.sum() / SCALE)


def _steps(T: Array) -> Array:
    """Distances between neighbouring poses, (N - 1,), m."""
    return norms(np.diff(T[:, :-1, -1], axis=0))


# --- drives -----------------------------------------------------------------------------------------------------------


def require_sound(windows: DriveWindows, correct: bool) -> None:
    """Refuse drives that no white noise describes.

    Raises
    ------
    InputError
        Jumps, a body frame that differs, a scale that is not metric, or errors that do not grow.
    """
    size, unit = windows.span.size, windows.span.unit
    cut = windows.jumps / max(len(windows.drive) + windows.jumps, 1)
    if cut > CUT:
        raise InputError(
            f"--span {windows.span.option}: {100 * cut:.0f} % of the windows have a jump, more than {100 * CUT:.0f} %: "
            "a model without them is none of this odometry; if the clocks of estimates and truth differ, give their "
            "--time-offset S, or 'estimate'; otherwise mend the jumps, or state them as failures of the odometry"
        )
    growth = rotation_growth(windows, no_mean(windows))  # a map leaves no mean to correct
    rotations = windows.errors[:, windows.d :]
    rounding = float(np.sqrt(mean_square(rotations).sum()))
    if growth.shrinks and rounding < ROUNDED:
        raise InputError(
            f"rotations of estimate and truth differ by {rounding:.2g} rad, as by rounding, and not by more over "
            "longer spans: one was taken from the other, so that there is no error of rotations to fit; give those "
            "that the odometry estimates itself"
        )
    turn = body_turn(windows)
    if turn.share > TURNED and turn.chance < RARE:
        raise InputError(
            f"a constant turn of the body by {np.rad2deg(turn.angle):.3g} degrees explains {100 * turn.share:.4g} % of "
            "the squared error of positions: the poses are of two body frames; give both of one body, by the "
            "calibration between them"
        )
    scale = fit_mean(windows).way
    if correct and not 1.0 / SCALE <= scale <= SCALE:
        raise InputError(
            f"the true way is {scale:.3g} times the estimated one: the scale is not metric, as with a single camera; "
            "fit after the scale is known (stereo, inertial, wheels), or state it by a scale state"
        )
    closed = f": loops are closed, or a map is used, so that there are no increments; {LIVE}"
    if growth.shrinks:
        raise InputError(
            f"the squared rotation error grows with the span to the power of {growth.power:.2g} (1 is white noise)"
            + closed
        )
    passes = revisits(windows)
    if passes.are_closed:
        raise InputError(
            f"rotation errors between two passes of a place are {passes.ratio:.2g} of those of {10 * size:g} {unit}"
            + closed
        )


def body_turn(windows: DriveWindows) -> BodyTurn:
    """Find the constant turn B with M = B^-1 D B that fits best (Wahba 1965), and its chance by F."""
    d = windows.d
    estimated = _vectors(windows.motions)
    true = _vectors(windows.true)
    before, after = _squares_left(windows), 0.0
    B = np.eye(d + 1)
    for _ in range(2):  # what is left holds the turn about a straight way, which nothing tells, at none
        U, _, V = np.linalg.svd(true.T @ estimated + after * np.eye(d))
        sign = np.eye(d)
        sign[-1, -1] = np.sign(np.linalg.det(U @ V))
        B[:d, :d] = (U @ sign @ V).T
        after = _squares_left(replace(windows, pieces=inverse(B) @ windows.pieces @ B))
    cosine = (np.trace(B[:d, :d]) - (d - 2)) / 2.0
    angle = float(np.arccos(np.clip(cosine, -1.0, 1.0)))
    share = 1.0 - after / before if before > 0 else 0.0
    turns = len(windows.axes) - d
    rest = d * len(windows.drive) - 2 * turns - 2  # degrees of freedom less those of the mean and the turn
    gain = max(before - after, 0.0) / max(after, 1e-300)
    chance = float(stats.f.sf(gain * rest / turns, turns, rest)) if rest > 0 else 1.0
    return BodyTurn(angle, share, chance)


def _vectors(motions: Array) -> Array:
    """What a turn of the body turns: positions (W, 2) in the plane; positions and rotations (2 W, 3) in space."""
    d = motions.shape[-1] - 1
    positions = motions[:, :-1, -1]
    if d == 2:
        return positions
    return np.concatenate([positions, rotation_vectors(motions[:, None])[:, 0]])


def _squares_left(windows: DriveWindows) -> float:
    """Sum of squared errors of positions that the means leave."""
    corrected = fit_mean(windows).applied(windows)
    errors = corrected.motions[:, :-1, -1] - windows.true[:, :-1, -1]
    return float((errors**2).sum())


def rotation_growth(windows: DriveWindows, mean: Mean) -> RotationGrowth:
    """Fit the growth by weighted least squares of the logarithms of mean squares and spans.

    A mean square of W windows has a relative variance of 2 / W; errors of several spans depend on each other, which
    doubles the variance of the power at most.
    """
    squares, counts = [], []
    for times in LONGER:
        some = windows.over(windows.span.size * times)
        if some is None or len(some.drive) < FEW:
            break
        rotations = mean.applied(some).errors[:, some.d :]
        squares.append(mean_square(rotations).sum())
        counts.append(len(some.drive))
    if len(squares) < 3:
        return RotationGrowth(float("nan"), float("nan"))
    x = np.log(LONGER[: len(squares)])
    y = np.log(np.maximum(squares, 1e-300))
    weight = 0.5 * np.array(counts, float)
    x = x - (weight * x).sum() / weight.sum()
    information = float((weight * x**2).sum())
    power = float((weight * x * y).sum()) / information
    return RotationGrowth(power, float(np.sqrt(2.0 / information)))


def revisits(windows: DriveWindows) -> Revisits:
    """Compare rotation errors between passes of a place with those of windows of ten spans.

    Passes are ``FAR`` spans of the way apart, so that white noise has twice the square at least; its chance is by F
    with the degrees of freedom of both. Passes of a drive do not overlap along the way. Motions are compared as they
    are, because a loop that is closed has no mean to correct.
    """
    if windows.span.unit != "m":
        return Revisits()
    size = windows.span.size
    of_passes, of_windows = [], []
    for drive in windows.drives:
        place = drive.truth[:, :-1, -1]
        way = np.append(0.0, np.cumsum(_steps(drive.truth)))
        rows = np.searchsorted(way, np.arange(0.0, way[-1], size / 2))
        pairs = _passes(place[rows], way[rows], FAR * size, NEAR * size)
        ends = np.searchsorted(way, np.arange(0.0, way[-1], 10 * size))
        of_passes.append(_turned(drive, rows[pairs[:, 0]], rows[pairs[:, 1]]))
        of_windows.append(_turned(drive, ends[:-1], ends[1:]))
    passes = np.concatenate(of_passes)
    others = np.concatenate(of_windows)
    if not len(passes) or not (others**2).mean() > 0:
        return Revisits()
    ratio = float((passes**2).mean() / (others**2).mean())
    turns = len(windows.axes) - windows.d
    chance = stats.f.cdf(ratio / 2.0, turns * len(passes), turns * len(others))
    return Revisits(float(np.sqrt(ratio)), float(chance))


def _passes(place: Array, way: Array, far: float, near: float) -> Indices:
    """Pairs (k, 2) of points that are near in space and far along the way; the way between pairs does not overlap."""
    pairs = []
    i = 0
    while i < len(place):
        j = int(np.searchsorted(way, way[i] + far))
        apart = norms(place[j:] - place[i])
        close = np.flatnonzero(apart < near)
        if not len(close):
            i += 1
            continue
        first = np.split(close, np.flatnonzero(np.diff(close) > 1) + 1)[0]  # pass, of which the nearest point
        pairs.append((i, j + int(first[np.argmin(apart[first])])))
        i = pairs[-1][1]
    return np.array(pairs, np.int64).reshape(-1, 2)


def _turned(drive: Drive, first: Indices, last: Indices) -> Array:
    """Angles of the rotation error of motions, rad."""
    estimated = motions_between(drive.estimate, first, last)
    true = motions_between(drive.truth, first, last)
    return norms(log(inverse(estimated) @ true)[:, drive.d :])
