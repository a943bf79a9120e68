"""What white noise does not describe: drives that are refused, with reason and remedy, and errors that are warned of.

Limits are from drives of seven systems.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy import stats

from consistency.referee.errors import InputError
from consistency.referee.fit_covariance.drives import Drive
from consistency.referee.fit_covariance.mean_differences import TERMS, PersistentError
from consistency.referee.fit_covariance.motion_windows import (
    ROUNDED,
    STILL,
    DriveWindows,
    mean_square,
    norms,
    vectors_of,
)
from consistency.referee.fit_covariance.systematic_errors import Mean, fit_mean, no_mean
from consistency.referee.fit_covariance.white_noise import WhiteNoise
from consistency.referee.geometry.lie_groups import inverse, log
from consistency.referee.readers.pipeline.relative_motions import BENT
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
RARE = 0.002  # probability that white noise shows as much of a turned body


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
    cut = windows.jumps / max(len(windows.drive) + windows.jumps, 1)
    if cut > CUT:
        raise InputError(
            f"--span {windows.span.option}: {100 * cut:.0f} % of the windows have a jump, more than {100 * CUT:.0f} %: "
            "a model without them is none of this odometry; if the clocks of estimates and truth differ, give their "
            "--time-offset S, or 'estimate'; otherwise mend the jumps, or state them as failures of the odometry"
        )
    growth = rotation_growth(windows, no_mean(windows))  # a map leaves no mean to correct
    if growth.shrinks:
        rounding = float(np.sqrt(mean_square(windows.errors[:, windows.d :]).sum()))
        if rounding < ROUNDED:
            raise InputError(
                f"rotations of estimate and truth differ by {rounding:.2g} rad, as by rounding, and not by more over "
                "longer spans: one was taken from the other, and no error of rotations is left to fit; give those "
                "that the odometry estimates itself"
            )
        power = f"the squared rotation error grows with the span to the power of {growth.power:.2g} (1 is white noise)"
        if _rows_are_independent(windows.drives):
            raise InputError(
                f"{power}, and not from one row to four either: errors are independent from row to row. Detections or "
                "fixes state the covariance of a pose: state a constant one with them, and 'consistency correct' finds "
                "its factors. Of an odometry, loops are closed: record the live odometry, before a map corrects it"
            )
        raise InputError(
            f"{power}: loops are closed, or a map is used, and these poses hold no increments; record the live "
            "odometry, before loops are closed or a map corrects it"
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


def _rows_are_independent(drives: Sequence[Drive]) -> bool:
    """Whether the squared rotation error is hardly larger over four rows than over one."""
    squares = []
    for rows in (1, 4):
        errors = []
        for drive in drives:
            moved = [inverse(T[:-rows]) @ T[rows:] for T in (drive.estimate, drive.truth)]
            errors.append(log(inverse(moved[0]) @ moved[1])[:, drive.d :])
        squares.append(np.square(np.concatenate(errors)).sum(axis=1).mean())
    return bool(squares[1] < SCALE * squares[0])


def body_turn(windows: DriveWindows) -> BodyTurn:
    """Find the constant turn B with M = B^-1 D B that fits best (Wahba 1965), and its chance by F."""
    d, n = windows.d, len(windows.axes)
    estimated = _vectors(windows.motions)
    true = _vectors(windows.true)
    before, after = _squares_left(windows), 0.0
    for _ in range(2):  # what is left holds the turn about a straight way, which nothing tells, at none
        U, _, V = np.linalg.svd(true.T @ estimated + after * np.eye(d))
        sign = np.eye(d)
        sign[-1, -1] = np.sign(np.linalg.det(U @ V))
        B = (U @ sign @ V).T
        turned = np.array(windows.pieces)
        turned[..., :d] = turned[..., :d] @ B
        if d == 3:
            turned[..., d:] = turned[..., d:] @ B
        after = _squares_left(replace(windows, pieces=turned))
    cosine = (np.trace(B) - (d - 2)) / 2.0
    angle = float(np.arccos(np.clip(cosine, -1.0, 1.0)))
    share = 1.0 - after / before if before > 0 else 0.0
    turns = n - d
    rest = d * len(windows.drive) - 2 * turns - 2  # degrees of freedom less those of the mean and the turn
    gain = max(before - after, 0.0) / max(after, 1e-300)
    chance = float(stats.f.sf(gain * rest / turns, turns, rest)) if rest > 0 else 1.0
    return BodyTurn(angle, share, chance)


def _vectors(motions: Array) -> Array:
    """What a turn of the body turns: positions (W, 2) in the plane; positions and rotations (2 W, 3) in space."""
    found = vectors_of(motions)
    if found.shape[1] == 3:
        return found[:, :2]
    return found.reshape(-1, 3)


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
    spans = np.log(LONGER[: len(squares)])
    sizes = np.log(np.maximum(squares, 1e-300))
    weights = np.sqrt(0.5 * np.array(counts))
    (power, _), covariance = np.polyfit(spans, sizes, 1, w=weights, cov="unscaled")
    return RotationGrowth(float(power), float(np.sqrt(2.0 * covariance[0, 0])))


# --- warnings ---------------------------------------------------------------------------------------------------------


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
        unit = "" if each.term in TERMS[:2] else " rad/m"
        found.append(
            f"{each.term} differs between drives (sigma {each.sigma:.2g}{unit}): add a state for it to the filter; it "
            "is not in the exported covariance"
        )
    return found
