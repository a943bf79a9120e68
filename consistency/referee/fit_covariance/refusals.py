"""What makes a fit of white noise meaningless, each with its reason and remedy; limits from drives of seven systems."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats
from scipy.spatial.transform import Rotation

from consistency.referee.errors import InputError
from consistency.referee.fit_covariance.drives import Drive
from consistency.referee.fit_covariance.motion_windows import ROUNDED, STILL, DriveWindows, windows_at
from consistency.referee.fit_covariance.systematic_errors import Mean, fit_mean, none_of
from consistency.referee.geometry.groups import inverse, log
from consistency.referee.types import Array

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
RARE = 0.002  # chance that white noise shows as much of a turned body, or as little between passes
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


def require_poses(drives: Sequence[Drive]) -> None:
    """Refuse estimates or a truth that are no poses, but increments, or positions with placeholders of orientations."""
    for drive in drives:
        names = ("estimates", "truth")
        both = drive.estimate, drive.truth
        for name, T, other in zip(names, both, reversed(both), strict=True):
            if _are_placeholders(T, other):
                raise InputError(
                    f"{drive.name}: all rows of the {name} have one orientation, though the path turns: it is a "
                    "placeholder, as with positions alone; motions are compared in the body's frame, so give "
                    f"{name} with orientations"
                )
            if _are_increments(T, other):
                remedy = "give --motions" if name == "estimates" else "compound them to poses"
                raise InputError(
                    f"{drive.name}: rows of the {name} seem to be motions since the row before, not poses; {remedy}"
                )


def _are_placeholders(T: Array, other: Array) -> bool:
    """Whether orientations are one constant, though those of another follow a path that turns."""
    d = T.shape[-1] - 1
    if np.abs(T[:, :d, :d] - T[0, :d, :d]).max() > CONSTANT:
        return False
    steps = np.diff(other[:, :d, d], axis=0)[..., None]
    along = np.swapaxes(other[:-1, :d, :d], -1, -2) @ steps
    in_world, in_body = (np.linalg.norm(each.sum(axis=0)) for each in (steps, along))
    return bool(in_body - in_world > FOLLOWS * np.linalg.norm(steps, axis=1).sum())


def _are_increments(T: Array, other: Array) -> bool:
    """Whether positions have the size of the steps of another, in most rows that move, and their own steps do not."""
    sizes = np.linalg.norm(T[1:, :-1, -1], axis=1)
    own, steps = (np.linalg.norm(np.diff(each[:, :-1, -1], axis=0), axis=1) for each in (T, other))
    moves = steps > STILL * np.median(steps)
    alike = (sizes < SCALE * steps) & (sizes > steps / SCALE) & moves
    return bool(alike.sum() > 0.5 * moves.sum() and own.sum() < steps.sum() / SCALE)


def require_sound(drives: Sequence[Drive], windows: DriveWindows, planar: bool, correct: bool) -> None:
    """Refuse drives that no white noise describes.

    Raises
    ------
    InputError
        Jumps, a body frame that differs, a scale that is not metric, or errors that do not grow.
    """
    span = windows.span.option
    if windows.cut > CUT:
        raise InputError(
            f"--span {span}: {100 * windows.cut:.0f} % of the windows have a jump, more than {100 * CUT:.0f} %: a "
            "model without them is none of this odometry; if the clocks of estimates and truth differ, give their "
            "--time-offset S, or 'estimate'; otherwise mend the jumps, or state them as failures of the odometry"
        )
    growth = rotation_growth(drives, windows, planar, none_of(windows))  # a map leaves no mean to correct
    rounding = float(np.sqrt((windows.errors[:, windows.d :] ** 2).sum(axis=1).mean()))
    if growth.shrinks and rounding < ROUNDED:
        raise InputError(
            f"rotations of estimate and truth differ by {rounding:.2g} rad, as by rounding, and not by more over "
            "longer spans: one was taken from the other, so that there is no error of rotations to fit; give those "
            "that the odometry estimates itself"
        )
    angle, share, chance = body_turn(windows)
    if share > TURNED and chance < RARE:
        raise InputError(
            f"a constant turn of the body by {np.rad2deg(angle):.3g} degrees explains {100 * share:.4g} % of the "
            "squared error of positions: the poses are of two body frames; give both of one body, by the calibration "
            "between them"
        )
    scale = fit_mean(windows).way
    if correct and not 1.0 / SCALE <= scale <= SCALE:
        raise InputError(
            f"the true way is {scale:.3g} times the estimated one: the scale is not metric, as of a single camera; "
            "fit after the scale is known (stereo, inertial, wheels), or state it by a scale state"
        )
    revisit, chance = revisits(drives, windows)
    returns = revisit < 1.0 and chance < RARE
    if growth.shrinks or returns:
        shown = (
            f"the squared rotation error grows with the span to the power of {growth.power:.2g} (1 is white noise)"
            if growth.shrinks
            else f"rotation errors between two passes of a place are {revisit:.2g} of those of "
            f"{10 * windows.span.size:g} {windows.span.unit}"
        )
        raise InputError(f"{shown}: loops are closed, or a map is used, so that there are no increments; {LIVE}")


def body_turn(windows: DriveWindows) -> tuple[float, float, float]:
    """Angle of the constant turn B with M = B^-1 D B that fits best, rad (Wahba 1965), and the share that it explains.

    The share is of squared errors of positions, beyond what the means explain; then the chance that independent errors
    of windows have as much of it, by F.
    """
    D, M, d = windows.motions, windows.true, windows.d
    both = [D[:, :d, d], M[:, :d, d]]
    if d == 3:
        turns = (Rotation.from_matrix(T[:, :3, :3]).as_rotvec() for T in (D, M))
        both = [np.concatenate([each, turn]) for each, turn in zip(both, turns, strict=True)]
    before, after = _squared(windows), 0.0
    for _ in range(2):  # what is left holds the turn about a straight way, which nothing tells, at none
        U, _, V = np.linalg.svd(both[1].T @ both[0] + after * np.eye(d))
        sign = np.eye(d)
        sign[-1, -1] = np.sign(np.linalg.det(U @ V))
        B = np.eye(d + 1)
        B[:d, :d] = (U @ sign @ V).T
        after = _squared(replace(windows, pieces=inverse(B) @ windows.pieces @ B))
    cosine = (np.trace(B[:d, :d]) - (d - 2)) / 2.0
    angles, rest = (1, d * len(D) - 4) if d == 2 else (3, d * len(D) - 8)
    gain = max(before - after, 0.0) / max(after, 1e-300)
    chance = float(stats.f.sf(gain * rest / angles, angles, rest)) if rest > 0 else 1.0
    return float(np.arccos(np.clip(cosine, -1.0, 1.0))), 1.0 - after / before if before > 0 else 0.0, chance


def _squared(windows: DriveWindows) -> float:
    """Sum of squared errors of positions that the means leave."""
    d = windows.d
    corrected = fit_mean(windows).applied(windows)
    return float(((corrected.motions[:, :d, d] - windows.true[:, :d, d]) ** 2).sum())


def rotation_growth(drives: Sequence[Drive], windows: DriveWindows, planar: bool, mean: Mean) -> RotationGrowth:
    """Weighted least squares of the logarithms of mean squares and spans.

    A mean square of W windows has a relative variance of 2 / W; errors of several spans depend on each other, which
    doubles the variance of the power at most.
    """
    spans, squares, counts = [], [], []
    for times in LONGER:
        some = windows_at(drives, windows, windows.span.size * times, planar)
        if some is None or len(some.drive) < FEW:
            break
        spans.append(times)
        error = mean.applied(some).errors[:, some.d :]  # of the rotation
        squares.append(float((error**2).sum(axis=1).mean()))
        counts.append(len(some.drive))
    if len(spans) < 3:
        return RotationGrowth(float("nan"), float("nan"))
    x, y, weight = np.log(spans), np.log(np.maximum(squares, 1e-300)), 0.5 * np.array(counts, float)
    x = x - (weight * x).sum() / weight.sum()
    information = float((weight * x**2).sum())
    return RotationGrowth(float((weight * x * y).sum()) / information, float(np.sqrt(2.0 / information)))


def revisits(drives: Sequence[Drive], windows: DriveWindows) -> tuple[float, float]:
    """Rotation error between two passes of a place over that of windows of ten spans; NaN where there are no passes.

    Also the chance that white noise has as little: passes are ``FAR`` spans of the way apart, so that it has twice the
    square at least, and F with the degrees of freedom of both. Passes of a drive do not overlap along the way. Motions
    are compared as they are, because a loop that is closed has no mean to correct.
    """
    unknown = float("nan"), 1.0
    if windows.span.unit != "m":
        return unknown
    size, passes, windowed = windows.span.size, [], []
    for drive in drives:
        place = drive.truth[:, : drive.d, drive.d]
        way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(place, axis=0), axis=1))])
        at = np.searchsorted(way, np.arange(0.0, way[-1], size / 2))
        pairs = _pairs(place[at], way[at], FAR * size, NEAR * size)
        ends = np.searchsorted(way, np.arange(0.0, way[-1], 10 * size))
        passes.append(_turned(drive, at[pairs[:, 0]], at[pairs[:, 1]]))
        windowed.append(_turned(drive, ends[:-1], ends[1:]))
    first, second = (np.concatenate(each) for each in (passes, windowed))
    if not len(first) or not (second**2).mean() > 0:
        return unknown
    ratio, kinds = float((first**2).mean() / (second**2).mean()), 1 if windows.d == 2 else 3
    return float(np.sqrt(ratio)), float(stats.f.cdf(ratio / 2.0, kinds * len(first), kinds * len(second)))


def _pairs(place: Array, way: Array, far: float, near: float) -> Array:
    """Pairs (k, 2) of points that are near in space and far along the way; the way between pairs does not overlap."""
    pairs, i = [], 0
    while i < len(place):
        j = int(np.searchsorted(way, way[i] + far))
        apart = np.linalg.norm(place[j:] - place[i], axis=1)
        close = np.flatnonzero(apart < near)
        if len(close):  # of the first pass the nearest point
            first = close[: int(np.argmax(np.append(np.diff(close) > 1, True))) + 1]
            pairs.append((i, j + int(first[np.argmin(apart[first])])))
        i = pairs[-1][1] if len(close) else i + 1
    return np.array(pairs, np.int64).reshape(-1, 2)


def _turned(drive: Drive, first: Array, last: Array) -> Array:
    """Angles of the rotation error of motions, rad."""
    D, M = (inverse(each[first]) @ each[last] for each in (drive.estimate, drive.truth))
    return np.asarray(np.linalg.norm(log(inverse(D) @ M)[:, drive.d :], axis=1))
