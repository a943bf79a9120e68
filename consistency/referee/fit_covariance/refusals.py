"""What white noise does not describe.

Some drives are refused, with reason and remedy. Others have mean errors that differ between windows or drives, or
errors that a second estimator shares. Limits are from drives of seven systems.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy import stats

from consistency.referee.errors import InputError
from consistency.referee.fit_covariance.drives import (
    ENOUGH,
    ROUNDED,
    STILL,
    Drive,
    DriveWindows,
    angles,
    mean_square,
    motion_matrices,
    motions_between,
    norms,
    root_mean_square,
    vectors_of,
    ways,
)
from consistency.referee.fit_covariance.mean_and_noise import (
    FORWARD,
    Mean,
    WhiteNoise,
    fit_mean,
    jacobian_of_mean,
    left_by,
    no_mean,
    normal_equations,
    scaled_inverse,
)
from consistency.referee.geometry import inverse, log
from consistency.referee.readers.pipeline.relative_motions import BENT
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
RARE = 0.002  # probability that white noise shows as much of a turned body
SURE = 0.01  # chance to find a difference where there is none: in all motions together, and in all terms together
TERMS = ("the scale of the way", "the scale of turns", "the drift of the heading with the way")
LEAST = 0.1  # share of the variance of an axis over the span that it makes, as a turn of the body that is refused
BINS = 3  # of windows that turn, or go, least, more and most
VARIES = 1.5  # largest over smallest mean way of a bin, from which windows are compared by their way
BLOCKS = 40  # of consecutive windows, whose errors may depend on each other
UNTOLD = 0.01  # share of the squared effect of a scale, below which a bin does not tell it
MOST = 0.5  # share of an axis' variance over the span, from which a drift decides
SHARED = 0.7  # correlation of two estimators' errors from which the truth's own are behind both
FEWEST = 8  # windows that both estimators have


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
                f"{power}, and not from one row to four either: errors are independent from row to row. Of "
                "detections or fixes 'consistency correct' with --independent finds the covariance. Of an odometry, "
                "loops are closed: record the live odometry, before a map corrects it"
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


# --- between motions --------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class MotionDependence:
    """A scale that depends on the turn of a window, or on its way."""

    scale: str  # of TERMS
    by: str  # turn | way
    values: tuple[float, ...]  # true over estimated, in each bin
    edges: tuple[float, ...]  # between bins, rad or m
    axis: str  # of which it makes the largest share
    share: float  # of the stated variance of this axis
    reach: float  # largest mean error of this axis in a bin, m or rad
    p_value: float

    @property
    def is_found(self) -> bool:
        return self.p_value <= SURE and self.share >= LEAST


def mean_by_motion(noise: WhiteNoise, windows: DriveWindows) -> MotionDependence:
    """Find the dependence with the smallest p-value, which is times the number of questions.

    Windows are divided once by the estimated and once by the true motion, and both must show it: the noise of a motion
    is itself a mean error in windows that are chosen by it.
    """
    corrected = noise.mean.applied(windows)
    questions = []
    for by, size_of in (("turn", angles), ("way", ways)):
        sizes = size_of(corrected.pieces).sum(axis=1)
        true_sizes = size_of(corrected.true_pieces).sum(axis=1)
        least, most = np.quantile(true_sizes, [0.5 / BINS, 1.0 - 0.5 / BINS])
        if by == "way" and most < VARIES * least:
            continue
        for scale in (0, 1):
            by_estimate = p_value_of(corrected, corrected.pieces, bins_of(sizes), scale)
            by_truth = p_value_of(corrected, corrected.true_pieces, bins_of(true_sizes), scale)
            questions.append((max(by_estimate, by_truth), by, scale, sizes))
    p_value, by, scale, sizes = min(questions, key=lambda question: question[0])
    bins = bins_of(sizes)
    values, error = values_by_bin(corrected, bins, scale)
    shares = mean_square(error) / noise.variances(corrected.pieces).mean(axis=0)
    axis = int(np.argmax(shares))
    there = np.unique(bins)
    scales = noise.mean.values[scale] * (1.0 + values[there])
    reaches = [np.abs(error[bins == k, axis]).mean() for k in there]
    return MotionDependence(
        scale=TERMS[scale],
        by=by,
        values=tuple(scales.tolist()),
        edges=tuple(float(sizes[bins == k].min()) for k in there[1:]),
        axis=corrected.axes[axis],
        share=float(shares[axis]),
        reach=float(max(reaches)),
        p_value=min(len(questions) * p_value, 1.0),
    )


def bins_of(sizes: Array) -> Indices:
    """Bin of each window, (W,), of which each has as many."""
    edges = np.quantile(sizes, np.arange(1, BINS) / BINS)
    return np.searchsorted(edges, sizes, side="right")


def p_value_of(
    windows: DriveWindows,
    pieces: Array,
    bins: Indices,
    scale: int,
) -> float:
    """p-value of a scale that grows from bin to bin, by a score test of errors of windows, beside motions in pieces.

    Each drive has constants of its own. The scores of blocks of windows are compared with their scatter (Student's t).
    """
    X = jacobian_of_mean(pieces)
    asked = X[:, :, scale] * bins[:, None]
    size = root_mean_square(windows.errors)[:, None]
    own = X / size
    both = np.stack([asked, windows.errors], axis=-1) / size
    drives = np.unique(windows.drive)
    scores = []
    for drive in drives:
        rows = np.flatnonzero(windows.drive == drive)
        constants = own[rows].reshape(-1, X.shape[-1])
        left = left_by(constants, both[rows].reshape(-1, 2))
        products = left.prod(axis=1).reshape(len(rows), -1)
        of_windows = products.sum(axis=1)
        blocks = min(max(round(BLOCKS / len(drives)), 1), len(rows))
        scores += [block.sum() for block in np.array_split(of_windows, blocks)]
    numbers = windows.errors.size
    free = max(numbers - X.shape[-1] * len(drives), 1)  # what the constants leave
    error = np.std(scores, ddof=1) * np.sqrt(numbers / free / len(scores))
    if not error > 0:
        return 1.0
    t = abs(np.mean(scores)) / error
    return float(2.0 * stats.t.sf(t, len(scores) - 1))


def values_by_bin(windows: DriveWindows, bins: Indices, scale: int) -> tuple[Array, Array]:
    """What a scale is more in each bin, (BINS,), and mean errors (W, n) by its differences; 0 where nothing tells."""
    X = jacobian_of_mean(windows.pieces)
    in_bin = bins[:, None] == np.arange(BINS)
    Z = X[:, :, [scale]] * in_bin[:, None, :]
    squares = (Z**2).sum(axis=(0, 1))
    Z = Z * (squares > UNTOLD * squares.sum())
    size = root_mean_square(windows.errors)[:, None]
    design = np.concatenate([Z, np.delete(X, scale, axis=-1)], axis=-1) / size
    y = (windows.errors[..., None] / size).ravel()
    values = np.linalg.lstsq(design.reshape(len(y), -1), y, rcond=None)[0]
    values = values[:BINS]
    return values, Z @ (values - squares @ values / squares.sum())


# --- between drives ---------------------------------------------------------------------------------------------------


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
    H = equations.A.sum(axis=0)
    inverted = scaled_inverse(H, 1e-6)
    known = np.diag(H) > 1e-200
    variances = np.where(known, np.diag(inverted), np.inf)
    return inverted @ equations.b.sum(axis=0), variances


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
        errors = log(inverse(motion_matrices(estimated)) @ windows.true[rows[both]])
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
