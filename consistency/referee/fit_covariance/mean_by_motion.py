"""Whether a scale of the mean error depends on how far a window turns, or goes."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from consistency.referee.fit_covariance.motion_windows import DriveWindows, blocks_of, rotation_vectors, ways
from consistency.referee.fit_covariance.slip import held_out_gain
from consistency.referee.fit_covariance.systematic_errors import error_derivatives
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
class ByMotion:
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


def mean_by_motion(noise: WhiteNoise, windows: DriveWindows) -> ByMotion:
    """The dependence with the smallest p-value, which is times the number of questions.

    Windows are divided once by the estimated and once by the true motion, and both must show it: the noise of a motion
    is itself a mean error in windows that are chosen by it.
    """
    now = noise.mean.applied(windows)
    both, found = (now.pieces, windows.true_pieces), []
    for by in ("turn", "way"):
        sizes = [_size(pieces, by) for pieces in both]
        bins = [np.searchsorted(np.quantile(size, np.arange(1, BINS) / BINS), size, side="right") for size in sizes]
        least, most = (np.quantile(sizes[1], at) for at in (0.5 / BINS, 1.0 - 0.5 / BINS))
        if by == "turn" or most >= VARIES * least:
            for scale in range(len(SCALES)):
                p = max(p_value_of(now, pieces, of, scale) for pieces, of in zip(both, bins, strict=True))
                found.append((p, by, scale, sizes[0], bins[0]))
    p, by, scale, size, of = min(found, key=lambda each: each[0])
    values, error = _by_bin(now, of, scale)
    shares = (error**2).mean(axis=0) / np.diagonal(noise.covariance(now.pieces), axis1=1, axis2=2).mean(axis=0)
    axis, there = int(np.argmax(shares)), np.unique(of)
    dependence = ByMotion(
        SCALES[scale], by, tuple((noise.mean.values[scale] * (1.0 + values[there])).tolist()),
        tuple(float(size[of == k].min()) for k in there[1:]), now.axes[axis], float(shares[axis]),
        max(float(np.abs(error[of == k, axis]).mean()) for k in there), min(len(found) * p, 1.0),
    )  # fmt: skip
    if dependence.is_found and (by, scale) == ("turn", 0):
        return replace(dependence, gain=held_out_gain(windows, blocks_of(windows.drive)))
    return dependence


def p_value_of(windows: DriveWindows, pieces: Array, bins: Indices, scale: int) -> float:
    """p-value of one scale in all bins, by a score test; errors are of ``windows``, and motions ``pieces``.

    Each drive has constants of its own. The scores of blocks of windows, in all bins but the first, are compared with
    their scatter (Hotelling 1931).
    """
    X, names = error_derivatives(pieces), np.unique(windows.drive)
    y, own, Z = _weighted(windows, X, X[:, :, [scale]] * (bins[:, None] == np.arange(1, BINS))[:, None, :])
    scores = []
    for name in names:
        rows = np.flatnonzero(windows.drive == name)
        both, mean = np.concatenate([Z[rows], y[rows]], axis=-1).reshape(-1, BINS), own[rows].reshape(-1, X.shape[-1])
        both = both - mean @ np.linalg.lstsq(mean, both, rcond=None)[0]
        products = (both[:, :-1] * both[:, -1:]).reshape(len(rows), -1, BINS - 1).sum(axis=1)
        parts = min(max(round(BLOCKS / len(names)), 1), len(rows))
        scores += [part.sum(axis=0) for part in np.array_split(products, parts)]
    S, lost = np.array(scores), X.shape[-1] * len(names)
    G, q = S.shape
    scatter = np.atleast_2d(np.cov(S.T)) * y.size / max(y.size - lost, 1)
    size = np.sqrt(np.diag(scatter))
    if q >= G or not (size > 0).all():
        return 1.0
    t = S.mean(axis=0) / size
    T2 = G * float(t @ np.linalg.pinv(scatter / np.outer(size, size), rcond=1e-9) @ t)
    return float(stats.f.sf(T2 * (G - q) / (q * (G - 1)), q, G - q))


def _by_bin(windows: DriveWindows, bins: Indices, scale: int) -> tuple[Array, Array]:
    """What a scale is more in each bin, (BINS,), and mean errors (W, n) by its differences; 0 where nothing tells."""
    X = error_derivatives(windows.pieces)
    Z = X[:, :, [scale]] * (bins[:, None] == np.arange(BINS))[:, None, :]
    squares = (Z**2).sum(axis=(0, 1))
    Z = Z * (squares > UNTOLD * squares.sum())
    y, design = _weighted(windows, np.concatenate([Z, np.delete(X, scale, axis=-1)], axis=-1))
    values = np.linalg.lstsq(design.reshape(y.size, -1), y.ravel(), rcond=None)[0][:BINS]
    return values, Z @ (values - squares @ values / squares.sum())


def _weighted(windows: DriveWindows, *designs: Array) -> list[Array]:
    """Errors (W, n, 1) and their derivatives (W, n, p), in units of the root mean square of each axis."""
    error = windows.errors[..., None]
    return [each / np.maximum(np.sqrt((error**2).mean(axis=0)), 1e-150) for each in (error, *designs)]


def _size(pieces: Array, by: str) -> Array:
    """Sum of the angles of the pieces of each window, rad, or of their ways, m: (W,)."""
    each = np.linalg.norm(rotation_vectors(pieces), axis=-1) if by == "turn" else ways(pieces)
    return np.asarray(each.sum(axis=1))
