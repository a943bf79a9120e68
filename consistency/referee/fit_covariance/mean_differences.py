"""Whether the mean error differs: between windows that turn or go more or less, and between drives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

from consistency.referee.fit_covariance.motion_windows import (
    ENOUGH,
    DriveWindows,
    angles,
    mean_square,
    root_mean_square,
    ways,
)
from consistency.referee.fit_covariance.systematic_errors import (
    FORWARD,
    jacobian_of_mean,
    left_by,
    normal_equations,
    scaled_inverse,
)
from consistency.referee.fit_covariance.white_noise import WhiteNoise
from consistency.referee.types import Array, Indices

SURE = 0.01  # chance to find a difference where there is none: in all motions together, and in all terms together
TERMS = ("the scale of the way", "the scale of turns", "the drift of the heading with the way")
LEAST = 0.1  # share of the variance of an axis over the span that it makes, as a turn of the body that is refused
BINS = 3  # of windows that turn, or go, least, more and most
VARIES = 1.5  # largest over smallest mean way of a bin, from which windows are compared by their way
BLOCKS = 40  # of consecutive windows, whose errors may depend on each other
UNTOLD = 0.01  # share of the squared effect of a scale, below which a bin does not tell it
MOST = 0.5  # share of an axis' variance over the span, from which a drift decides


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
