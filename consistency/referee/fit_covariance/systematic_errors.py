"""The mean error of a window: a scale of the way, a scale of the turn, and a heading that drifts with the way."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy import stats
from scipy.spatial.transform import Rotation

from consistency.referee.defaults import CONFIDENCE
from consistency.referee.fit_covariance.motion_windows import (
    BLOCKS,
    DriveWindows,
    blocks_of,
    lengthened,
    rests,
    rotation_vectors,
    ways,
)
from consistency.referee.geometry.groups import adjoint, inverse
from consistency.referee.types import Array

ROUNDS = 2  # of Gauss and Newton from nothing; from a mean that is nearly right one is enough
WEAK = 1e-6  # of the largest singular value, below which a direction is not determined and stays 0
FORWARD, BACKWARD, NEIGHBOURS = "estimated motion", "true motion", "neighbouring windows"  # instruments
SCALES = 2  # coefficients before those of the drift
GAP = 2  # pieces of a neighbouring window that are left out
STRONG = 10.0  # first-stage F from which instruments are not weak (Staiger & Stock 1997, Econometrica 65)
OPEN = 0.02  # between scales of turns that are fitted in both directions, from which it is said that they differ
SURE = 3.0  # standard errors from which errors of neighbouring windows correlate: 0.3 % of right drives


@dataclass(frozen=True)
class Mean:
    """What is corrected before noise is fitted; nothing by default."""

    way: float = 1.0  # true over estimated length
    turn: float = 1.0  # true over estimated rotation
    drift: tuple[float, ...] = (0.0,)  # rad a m, about the axes of the body: (1,), or (3,) in space
    slip: float = 0.0  # m a rad, that each turn adds to the estimated way before all else

    @property
    def values(self) -> Array:
        """Scale of the way, that of turns, and the drift, (p,)."""
        return np.array([self.way, self.turn, *self.drift])

    def corrected(self, pieces: Array) -> Array:
        """Motions (W, P, d + 1, d + 1) with this mean taken out."""
        d, pieces = pieces.shape[-1] - 1, lengthened(pieces, self.slip)
        way, out = ways(pieces), np.array(pieces)
        angle = self.turn * rotation_vectors(pieces) + way[..., None] * np.asarray(self.drift)
        out[..., :d, d] *= self.way
        if d == 2:
            c, s = np.cos(angle[..., 0]), np.sin(angle[..., 0])
            out[..., :2, :2] = np.moveaxis(np.array([[c, -s], [s, c]]), (0, 1), (-2, -1))
        else:
            out[..., :3, :3] = Rotation.from_rotvec(angle.reshape(-1, 3)).as_matrix().reshape(*out.shape[:2], 3, 3)
        return out

    def applied(self, windows: DriveWindows) -> DriveWindows:
        return replace(windows, pieces=self.corrected(windows.pieces))


@dataclass(frozen=True)
class MeanFit:
    """A mean with its evidence: coefficients are the scale of the way, that of turns, and the drift, (p,)."""

    mean: Mean  # of the coefficients whose interval does not hold none
    whole: Mean  # of all coefficients
    low: Array  # (p,), of the coefficients
    high: Array
    free: Array  # (p,) bool, which are corrected
    instruments: str  # what the coefficients rest on, of FORWARD and NEIGHBOURS
    turns: tuple[float, float]  # scale by least squares on the estimated motion, and on the true one
    strength: float  # first-stage F of the weakest coefficient by neighbours
    lasts: bool  # errors of different windows depend on each other

    @property
    def is_open(self) -> bool:
        """Whether the scale of turns depends on whose noise it is, and nothing tells."""
        return self.instruments == FORWARD and bool(abs(self.turns[1] - self.turns[0]) > OPEN)


def fit_mean(windows: DriveWindows, covariance: Array | None = None, start: Mean | None = None) -> Mean:
    """Mean by generalised least squares.

    Parameters
    ----------
    covariance : (W, n, n) of the errors; None weighs by their mean square
    start : a mean that is nearly right
    """
    mean = none_of(windows) if start is None else start
    for _ in range(ROUNDS if start is None else 1):
        mean = _estimate(windows, mean, moments_of(windows, mean, covariance, FORWARD)[0])[0]
    return mean


def choose_mean(windows: DriveWindows, covariance: Array | None = None, start: Mean | None = None) -> MeanFit:
    """The mean that holds whether the odometry's noise is in the estimated motion or in the true one.

    Errors in variables (Fuller 1987, "Measurement Error Models"): least squares on the estimated motion is right where
    that is what the vehicle was told to do, and too small where it was measured with noise; with the true motion as
    instruments it is the other way round. The coefficient is between both (Frisch 1934). The motion of neighbouring
    windows as instruments (Reiersol 1941) holds for either, if it predicts the motion, and errors of different windows
    are independent; it is used where its intervals are the narrower ones.
    """
    near = fit_mean(windows, covariance) if start is None else start
    kinds = (FORWARD, BACKWARD, NEIGHBOURS)
    moments = dict(zip(kinds, moments_of(windows, near, covariance, *kinds), strict=True))
    none = none_of(windows).values
    free = np.ones(len(none), bool)
    found = {each: _estimate(windows, near, moments[each], free) for each in kinds}
    lows, highs = (np.array([found[each][k] for each in kinds]) for k in (1, 2))
    strength, lasts = _strength(moments[NEIGHBOURS]), _lasts(found[NEIGHBOURS][0].applied(windows))
    gain = np.log((highs[:2].max(axis=0) - lows[:2].min(axis=0)) / (highs[2] - lows[2]))[:SCALES].sum()
    used = kinds[2:] if strength >= STRONG and not lasts and gain > 0 else kinds[:2]
    whole, turns = found[used[0]][0], (found[FORWARD][0].turn, found[BACKWARD][0].turn)
    low, high = none, none
    while True:
        means, least, most = zip(*(_estimate(windows, near, moments[each], free) for each in used), strict=True)
        low, high = np.where(free, np.min(least, axis=0), low), np.where(free, np.max(most, axis=0), high)
        inside = np.where(free, np.minimum(high - none, none - low), -1.0) / (high - low)
        if not inside.max() >= 0:
            break
        free[np.argmax(inside)] = False  # one at a time, as the others change with it
    return MeanFit(means[0], whole, low, high, free, used[0], turns, strength, lasts)


class InstrumentMoments(NamedTuple):
    """Z' C^-1 X (W, p, p) and Z' C^-1 e (W, p) of instruments, derivatives and errors; Z and X (W, n, p) whitened."""

    A: Array
    b: Array
    Z: Array
    X: Array


def moments_of(
    windows: DriveWindows, mean: Mean, covariance: Array | None, *instruments: str
) -> list[InstrumentMoments]:
    """Moments with each kind of instruments, at a mean."""
    now = mean.applied(windows)
    error, design = now.errors, error_derivatives(now.pieces)
    square = (error**2).mean(axis=0)
    P = np.diag(np.maximum(square, 1e-12 * square.max() + 1e-100))[None] if covariance is None else covariance
    whiten = np.linalg.inv(np.linalg.cholesky(P))
    X, y, found = whiten @ design, whiten @ error[..., None], []
    for each in instruments:
        Z = X
        if each == BACKWARD:
            Z = whiten @ error_derivatives(windows.true_pieces)
        elif each == NEIGHBOURS:
            Z = whiten @ _of_neighbours(now)
        back = np.swapaxes(Z, -1, -2)
        found.append(InstrumentMoments(back @ X, (back @ y)[..., 0], Z, X))
    return found


def _estimate(
    windows: DriveWindows, near: Mean, moments: InstrumentMoments, free: Array | None = None
) -> tuple[Mean, Array, Array]:
    """The mean after a step of Gauss and Newton, and intervals (p,) from the scatter between blocks of what it leaves.

    Parameters
    ----------
    free : (p,) bool, coefficients that are fitted; the others are those of no mean
    """
    free = np.ones(moments.b.shape[1], bool) if free is None else free
    none, start, blocks = none_of(windows).values, near.values, blocks_of(windows.drive, BLOCKS)
    step = np.append(none[:SCALES] / start[:SCALES] - 1.0, -start[SCALES:] / near.way)
    step[free] = 0.0
    A, left = moments.A[:, free][:, :, free], moments.b[:, free] - moments.A[:, free] @ step
    step[free] = _solved(A.sum(axis=0), left.sum(axis=0))
    left = left - A @ step[free]
    scatter = np.zeros((len(step), len(blocks)))
    scatter[free] = _solved(A.sum(axis=0), np.stack([left[block].sum(axis=0) for block in blocks], axis=1))
    k = max(len(blocks), 2)
    error = np.sqrt((scatter**2).sum(axis=1) * k / (k - 1))
    reach = np.maximum(float(stats.t.isf(0.5 * (1.0 - CONFIDENCE), k - 1)) * error, 1e-12)
    drift = start[SCALES:] * (1 + step[1]) + step[SCALES:] * near.way
    value = np.where(free, np.append(start[:SCALES] * (1 + step[:SCALES]), drift), none)
    mean = Mean(float(value[0]), float(value[1]), tuple(value[SCALES:].tolist()))
    return mean, value - reach, value + reach


def _of_neighbours(windows: DriveWindows) -> Array:
    """Derivatives of the windows before and after, (W, n, p), less what is next to this one: its ends may be shared."""
    early, late = np.array(windows.pieces), np.array(windows.pieces)
    early[:, -GAP:] = late[:, :GAP] = np.eye(windows.d + 1)
    return sum_of_neighbours(windows, error_derivatives(early), error_derivatives(late))


def sum_of_neighbours(windows: DriveWindows, before: Array, after: Array) -> Array:
    """Sum of a value of the window before and another of the one after, each (W, ...); 0 where there is none."""
    second = np.flatnonzero((windows.first[1:] == windows.last[:-1]) & (np.diff(windows.drive) == 0)) + 1
    out = np.zeros_like(before)
    out[second] += before[second - 1]
    out[second - 1] += after[second]
    return out


def _solved(A: Array, b: Array) -> Array:
    """x of A x = b, (p, p) and (p,) or (p, k); 0 in directions that are not determined."""
    size: Array = np.sqrt(np.maximum(np.abs(np.diag(A)), 1e-300))
    return np.asarray((np.linalg.lstsq(A / np.outer(size, size), (b.T / size).T, rcond=WEAK**2)[0].T / size).T)


def _strength(moments: InstrumentMoments) -> float:
    """First-stage F, the smallest of all coefficients: how well an instrument, beside the others, predicts the motion.

    Robust to unequal variances of windows (White 1980).
    """
    found, (_, _, Z, X) = [], moments
    for j in range(X.shape[-1]):
        others = np.delete(Z, j, axis=-1).reshape(-1, Z.shape[-1] - 1)
        x, z = (each[..., j].ravel() for each in (X, Z))
        x, z = (each - others @ np.linalg.lstsq(others, each, rcond=WEAK)[0] for each in (x, z))
        slope = float(z @ x) / max(float(z @ z), 1e-300)
        scatter = (z * (x - slope * z)).reshape(len(X), -1).sum(axis=1)
        found.append(abs(z @ x) / max(np.sqrt((scatter**2).sum()), 1e-300))
    return float(min(min(found), 1e100) ** 2)


def _lasts(corrected: DriveWindows) -> bool:
    """Whether rotation errors of windows one or two apart correlate positively; jitter of their ends does not."""
    error = corrected.errors[:, corrected.d :]
    error = error / np.maximum(np.sqrt((error**2).mean(axis=0)), 1e-300)
    found = []
    for lag in (1, 2):
        pairs = corrected.drive[lag:] == corrected.drive[:-lag]
        product = (error[lag:] * error[:-lag]).sum(axis=1)[pairs]
        found.append(product.sum() > SURE * np.sqrt((product**2).sum()))
    return any(found)


def none_of(windows: DriveWindows) -> Mean:
    """The mean that corrects nothing."""
    return Mean(drift=(0.0,) * (1 if windows.d == 2 else 3))


def error_derivatives(pieces: Array) -> Array:
    """Derivative (W, n, 2 + 1) or (W, n, 2 + 3) of the errors by scale of the way, scale of the turn, and drift."""
    W, P, m, _ = pieces.shape
    d, n = m - 1, 3 if m == 3 else 6
    A = carriers(pieces)[:, 1:]
    way, turn = ways(pieces), rotation_vectors(pieces)
    local = np.zeros((W, P, n, n - d + 2))
    # at the end of its piece, a longer way is an error along R' t
    R = pieces[..., :d, :d]
    local[..., :d, 0] = (np.swapaxes(R, -1, -2) @ pieces[..., :d, d, None])[..., 0]
    local[..., d:, 1] = turn
    local[..., d:, 2:] = way[..., None, None] * np.eye(n - d)
    return np.asarray(np.moveaxis(A, 1, 2).reshape(W, n, -1) @ local.reshape(W, P * n, -1))


def carriers(pieces: Array) -> Array:
    """A_k (W, P + 1, n, n) that carry an error at each end of a piece to the end of the window: Ad(rest)^-1."""
    return adjoint(inverse(rests(pieces)))
