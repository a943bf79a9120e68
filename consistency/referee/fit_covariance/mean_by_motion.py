"""Whether a scale of the mean error depends on how far a window turns, or goes, and the way that a turn adds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats

from consistency.referee.fit_covariance.drives import Drive
from consistency.referee.fit_covariance.slip import held_out_gain
from consistency.referee.fit_covariance.systematic_errors import design_of
from consistency.referee.fit_covariance.white_noise import Noise, blocks_of
from consistency.referee.fit_covariance.windows import Windows, true_pieces, turns, ways
from consistency.referee.types import Array, Indices

SURE = 0.01  # chance to find a dependence where there is none, all questions together
LEAST = 0.1  # share of the variance of an axis over the span, as with a turn of the body that is refused
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
    gain: float  # share of squared errors of positions that a way by turn takes out where it is not fitted; 0 if none may

    @property
    def is_found(self) -> bool:
        return self.p_value <= SURE and self.share >= LEAST


def mean_by_motion(noise: Noise, windows: Windows, drives: Sequence[Drive], planar: bool) -> ByMotion:
    """The dependence with the smallest p-value, which is times the number of questions.

    Windows are divided once by the estimated and once by the true motion, and both must show it: the noise of a motion
    is itself a mean error in windows that are chosen by it.
    """
    now = noise.mean.applied(windows)
    both = now.pieces, true_pieces(drives, windows, planar)
    found = []
    for by, size_of in (("turn", _turned), ("way", _gone)):
        sizes = [size_of(pieces) for pieces in both]
        bins = [_bins(size) for size in sizes]
        least, *_, most = (sizes[1][bins[1] == k].mean() if (bins[1] == k).any() else 0.0 for k in range(BINS))
        if by == "way" and most < VARIES * least:
            continue
        for scale in range(len(SCALES)):
            p = max(p_value_of(now, pieces, of, scale) for pieces, of in zip(both, bins, strict=True))
            found.append((p, by, scale, sizes[0], bins[0]))
    p, by, scale, size, of = min(found, key=lambda each: each[0])
    values, error = _by_bin(now, of, scale)
    shares = (error**2).mean(axis=0) / np.diagonal(noise.covariance(now.pieces), axis1=1, axis2=2).mean(axis=0)
    axis = int(np.argmax(shares))
    reach = max(float(np.abs(error[of == k, axis]).mean()) for k in np.unique(of))
    of_all = noise.mean.turn if scale else noise.mean.way
    edges = tuple(float(size[of == k].min()) for k in range(1, BINS) if (of == k).any())
    dependence = ByMotion(
        SCALES[scale], by, tuple((of_all * (1.0 + values)).tolist()), edges, now.axes[axis], float(shares[axis]), reach,
        min(len(found) * p, 1.0), 0.0,
    )  # fmt: skip
    if dependence.is_found and (by, scale) == ("turn", 0):
        return replace(dependence, gain=held_out_gain(windows, blocks_of(windows.drive)))
    return dependence


def p_value_of(windows: Windows, pieces: Array, bins: Indices, scale: int) -> float:
    """p-value of one scale in all bins, by a score test; errors are of ``windows``, and motions ``pieces``.

    Each drive has constants of its own. The scores of blocks of windows, in all bins but the first, are compared with
    their scatter (Hotelling 1931).
    """
    error, X = windows.errors, design_of(pieces)
    Z = X[:, :, [scale]] * (bins[:, None] == np.arange(1, BINS))[:, None, :]
    weight = 1.0 / np.sqrt(np.maximum((error**2).mean(axis=0), 1e-300))[:, None]
    scores, lost = [], 0
    blocks = max(round(BLOCKS / len(np.unique(windows.drive))), 1)
    for drive in np.unique(windows.drive):
        rows = windows.drive == drive
        n = int(rows.sum())
        own, rest = (each[rows] * weight for each in (X, np.concatenate([Z, error[..., None]], axis=-1)))
        own, rest = own.reshape(-1, own.shape[-1]), rest.reshape(-1, rest.shape[-1])
        rest = rest - own @ np.linalg.lstsq(own, rest, rcond=None)[0]
        products = (rest[:, :-1] * rest[:, -1:]).reshape(n, -1, BINS - 1).sum(axis=1)
        scores += [part.sum(axis=0) for part in np.array_split(products, min(blocks, n))]
        lost += own.shape[-1]
    S = np.array(scores)
    G, q = S.shape
    scatter = np.atleast_2d(np.cov(S.T)) * error.size / max(error.size - lost, 1)
    size = np.sqrt(np.diag(scatter))
    if G <= q or not (size > 0).all():
        return 1.0
    t = S.mean(axis=0) / size
    T2 = G * float(t @ np.linalg.pinv(scatter / np.outer(size, size), rcond=1e-9) @ t)
    return float(stats.f.sf(T2 * (G - q) / (q * (G - 1)), q, G - q))


def _by_bin(windows: Windows, bins: Indices, scale: int) -> tuple[Array, Array]:
    """What a scale is more in each bin, (BINS,), and the mean errors that this makes, (W, n); 0 where nothing tells."""
    error, X = windows.errors, design_of(windows.pieces)
    Z = X[:, :, [scale]] * (bins[:, None] == np.arange(BINS))[:, None, :]
    squares = (Z**2).sum(axis=(0, 1))
    Z = Z * (squares > UNTOLD * squares.sum())
    weight = 1.0 / np.sqrt(np.maximum((error**2).mean(axis=0), 1e-300))[:, None]
    design = (np.concatenate([Z, np.delete(X, scale, axis=-1)], axis=-1) * weight).reshape(error.size, -1)
    values = np.linalg.lstsq(design, (error * weight[:, 0]).ravel(), rcond=None)[0][:BINS]
    return values, Z @ values


def _bins(size: Array) -> Indices:
    """Bins of equal numbers of windows, (W,)."""
    return np.asarray(np.searchsorted(np.quantile(size, np.arange(1, BINS) / BINS), size, side="right"))


def _turned(pieces: Array) -> Array:
    """Sum of the angles of the pieces of each window, (W,), rad."""
    return np.asarray(np.linalg.norm(turns(pieces), axis=-1).sum(axis=1))


def _gone(pieces: Array) -> Array:
    """Way of each window, (W,), m."""
    return np.asarray(ways(pieces).sum(axis=1))
