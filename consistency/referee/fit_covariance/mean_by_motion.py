"""Whether a scale of the mean error depends on how far a window turns, or goes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy import stats

from consistency.referee.fit_covariance.motion_windows import DriveWindows, angles, blocks_of, mean_square, ways
from consistency.referee.fit_covariance.systematic_errors import fit_mean, fit_slip, jacobian_of_mean, left_by
from consistency.referee.fit_covariance.white_noise import WhiteNoise
from consistency.referee.types import Array, Indices

SURE = 0.01  # chance to find a dependence where there is none, all questions together
LEAST = 0.1  # share of the variance of an axis over the span that it makes, as a turn of the body that is refused
BINS = 3  # of windows that turn, or go, least, more and most
VARIES = 1.5  # largest over smallest mean way of a bin, from which windows are compared by their way
BLOCKS = 40  # of consecutive windows, whose errors may depend on each other
UNTOLD = 0.01  # share of the squared effect of a scale, below which a bin does not tell it
SCALES = ("the scale of the way", "the scale of turns")


@dataclass(frozen=True)
class MotionDependence:
    """A scale that depends on the turn of a window, or on its way."""

    scale: str  # of SCALES
    by: str  # turn | way
    values: tuple[float, ...]  # true over estimated, in each bin
    edges: tuple[float, ...]  # between bins, rad or m
    axis: str  # of which it makes the largest share
    share: float  # of the stated variance of this axis
    reach: float  # largest mean error of this axis in a bin, m or rad
    p_value: float
    gain: float = 0.0  # share of squared errors of positions that a way by turn takes out where it is not fitted

    @property
    def is_found(self) -> bool:
        return self.p_value <= SURE and self.share >= LEAST


class ScaleTest(NamedTuple):
    """Whether a scale differs between bins of the windows."""

    p_value: float
    by: str  # turn | way
    scale: int  # of SCALES
    sizes: Array  # (W,), rad or m
    bins: Indices  # (W,)


def mean_by_motion(noise: WhiteNoise, windows: DriveWindows) -> MotionDependence:
    """Find the dependence with the smallest p-value, which is times the number of questions."""
    corrected = noise.mean.applied(windows)
    questions = _questions(corrected)
    found = min(questions, key=lambda each: each.p_value)
    values, error = values_by_bin(corrected, found.bins, found.scale)
    shares = mean_square(error) / noise.variances(corrected.pieces).mean(axis=0)
    axis = int(np.argmax(shares))
    starts, reaches = [], []
    there = np.unique(found.bins)
    for k in there:
        is_in = found.bins == k
        starts.append(float(found.sizes[is_in].min()))
        reaches.append(float(np.abs(error[is_in, axis]).mean()))
    scales = noise.mean.values[found.scale] * (1.0 + values[there])
    dependence = MotionDependence(
        scale=SCALES[found.scale],
        by=found.by,
        values=tuple(scales.tolist()),
        edges=tuple(starts[1:]),
        axis=corrected.axes[axis],
        share=float(shares[axis]),
        reach=max(reaches),
        p_value=min(len(questions) * found.p_value, 1.0),
    )
    is_of_slip = (found.by, found.scale) == ("turn", 0)
    if dependence.is_found and is_of_slip:
        return replace(dependence, gain=held_out_gain(windows, blocks_of(windows.drive)))
    return dependence


def _questions(corrected: DriveWindows) -> list[ScaleTest]:
    """All questions that are asked.

    Windows are divided once by the estimated and once by the true motion, and both must show it: the noise of a motion
    is itself a mean error in windows that are chosen by it.
    """
    found = []
    for by, size_of in (("turn", angles), ("way", ways)):
        sizes = size_of(corrected.pieces).sum(axis=1)
        true_sizes = size_of(corrected.true_pieces).sum(axis=1)
        least, most = np.quantile(true_sizes, [0.5 / BINS, 1.0 - 0.5 / BINS])
        if by == "way" and most < VARIES * least:
            continue
        bins = bins_of(sizes)
        true_bins = bins_of(true_sizes)
        for scale in range(len(SCALES)):
            by_estimate = p_value_of(corrected, corrected.pieces, bins, scale)
            by_truth = p_value_of(corrected, corrected.true_pieces, true_bins, scale)
            found.append(ScaleTest(max(by_estimate, by_truth), by, scale, sizes, bins))
    return found


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
    """p-value of one scale in all bins, by a score test; errors are of ``windows``, and motions ``pieces``.

    Each drive has constants of its own. The scores of blocks of windows, in all bins but the first, are compared with
    their scatter (Hotelling 1931).
    """
    X = jacobian_of_mean(pieces)
    in_bin = bins[:, None] == np.arange(1, BINS)
    size = _size_of_errors(windows)
    own = X / size
    scores = X[:, :, [scale]] * in_bin[:, None, :] / size
    both = np.concatenate([scores, windows.errors[..., None] / size], axis=-1)
    names = np.unique(windows.drive)
    sums = []
    for name in names:
        rows = np.flatnonzero(windows.drive == name)
        mean = own[rows].reshape(-1, own.shape[-1])
        left = left_by(mean, both[rows].reshape(-1, BINS))
        products = left[:, :-1] * left[:, -1:]
        by_window = products.reshape(len(rows), -1, BINS - 1).sum(axis=1)
        blocks = min(max(round(BLOCKS / len(names)), 1), len(rows))
        sums += [block.sum(axis=0) for block in np.array_split(by_window, blocks)]
    numbers = windows.errors.size
    spent = X.shape[-1] * len(names)
    return _hotelling(np.array(sums), numbers / max(numbers - spent, 1))


def _hotelling(sums: Array, inflation: float) -> float:
    """p-value of G vectors (G, q) whose mean is 0, and whose scatter is ``inflation`` times that seen."""
    G, q = sums.shape
    scatter = np.atleast_2d(np.cov(sums.T)) * inflation
    size = np.sqrt(np.diag(scatter))
    if q >= G or not (size > 0).all():
        return 1.0
    t = sums.mean(axis=0) / size
    correlation = scatter / np.outer(size, size)
    squared = G * float(t @ np.linalg.pinv(correlation, rcond=1e-9) @ t)
    ratio = squared * (G - q) / (q * (G - 1))
    return float(stats.f.sf(ratio, q, G - q))


def values_by_bin(windows: DriveWindows, bins: Indices, scale: int) -> tuple[Array, Array]:
    """What a scale is more in each bin, (BINS,), and mean errors (W, n) by its differences; 0 where nothing tells."""
    X = jacobian_of_mean(windows.pieces)
    in_bin = bins[:, None] == np.arange(BINS)
    Z = X[:, :, [scale]] * in_bin[:, None, :]
    squares = (Z**2).sum(axis=(0, 1))
    Z = Z * (squares > UNTOLD * squares.sum())
    size = _size_of_errors(windows)
    design = np.concatenate([Z, np.delete(X, scale, axis=-1)], axis=-1) / size
    y = (windows.errors[..., None] / size).ravel()
    values = np.linalg.lstsq(design.reshape(len(y), -1), y, rcond=None)[0]
    values = values[:BINS]
    return values, Z @ (values - squares @ values / squares.sum())


def _size_of_errors(windows: DriveWindows) -> Array:
    """Root mean square of each axis, (n, 1)."""
    return np.maximum(np.sqrt(mean_square(windows.errors)), 1e-150)[:, None]


def held_out_gain(windows: DriveWindows, blocks: Sequence[Indices]) -> float:
    """Share of the squared error of positions that a slip takes out of the blocks that chose nothing of it."""
    before = after = 0.0
    for block in blocks:
        judged = windows.of(block)
        rest = windows.of(np.setdiff1d(np.arange(len(windows.drive)), block))
        before += _squares_left(rest, judged, 0.0)
        after += _squares_left(rest, judged, fit_slip(rest))
    return 1.0 - after / before if before > 0 else 0.0


def _squares_left(fitted: DriveWindows, judged: DriveWindows, slip: float) -> float:
    """Sum of squared errors of positions, with a slip and the mean that is fitted to others beside it."""
    mean = fit_mean(fitted.lengthened(slip))
    error = mean.applied(judged.lengthened(slip)).errors
    return float((error[:, : judged.d] ** 2).sum())
