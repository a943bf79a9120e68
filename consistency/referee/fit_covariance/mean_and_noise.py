"""Errors of the windows of an odometry, as a mean that is systematic, and white noise about it.

The mean has a scale of the way and one of turns, a heading that drifts with the way, and a way that turns add. The
noise has a variance a metre and a variance a radian in each axis, with a floor, fitted by maximum likelihood; each is
fitted given the other. What these cannot describe is refused in ``refusals``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from consistency.referee.diagnostics.verdict_parts import Interval
from consistency.referee.errors import InputError
from consistency.referee.fit_covariance.drives import (
    BLOCKS,
    DriveWindows,
    angles,
    d_of,
    jackknife_blocks,
    mean_square,
    motion_matrices,
    norms,
    rests,
    root_mean_square,
    turn_per_way,
    ways,
)
from consistency.referee.fit_covariance.estimation import interval_of, maximise, nees_of, score_of, student
from consistency.referee.geometry import adjoint, inverse
from consistency.referee.types import Array, Indices

MEAN_ROUNDS = 2  # of Gauss and Newton from nothing; from a mean that is nearly right one is enough
WEAK = 1e-6  # of the largest singular value, below which a direction is not determined and stays 0
FORWARD, BACKWARD, NEIGHBOURS = "estimated motion", "true motion", "neighbouring windows"  # instruments
SCALES = 2  # coefficients before those of the drift
GAP = 2  # pieces of a neighbouring window that are left out
STRONG = 10.0  # first-stage F from which instruments are not weak (Staiger & Stock 1997, Econometrica 65)
OPEN = 0.02  # between scales of turns that are fitted in both directions, from which it is said that they differ
SURE = 3.0  # standard errors from which errors of neighbouring windows correlate: 0.3 % of right drives
SLIP_ROUNDS = 4  # of slip and mean in turn
APART = 1e-3  # of the squared effect of a slip that a mean must leave, so that both are told from each other
LEAST = 1e-4  # of the largest variance of positions, or of rotations, that every axis has: a hundredth of its sigma
NOISE_ROUNDS = 2  # of mean and noise in turn, before the mean is told from none
SHOWN = 3.0  # standard errors from which there is jitter
SHORTER = (8.0, 4.0, 2.0, 1.0)  # parts of the span, whose errors tell jitter of both ends from noise of the way
LENGTHS = 3  # that tell it
CLOSE = 1e-7  # gain of the log likelihood of a window at which scoring ends


@dataclass(frozen=True)
class Mean:
    """What is corrected before noise is fitted; nothing by default."""

    way: float = 1.0  # true over estimated length
    turn: float = 1.0  # true over estimated rotation
    drift: tuple[float, ...] = (0.0,)  # rad a m, about the axes of the body: (1,), or (3,) in space
    slip: float = 0.0  # m a rad, that each turn adds to the estimated way before all else

    @property
    def values(self) -> Array:
        """Coefficients: scale of the way, that of turns, and the drift, (p,)."""
        return np.array([self.way, self.turn, *self.drift])

    def corrected(self, pieces: Array) -> Array:
        """Motions (..., n) with this mean taken out; none goes backwards by a slip."""
        d = d_of(pieces)
        way = ways(pieces)[..., None]
        longer = np.maximum(1.0 + self.slip * turn_per_way(pieces)[..., None], 0.0)
        out = self.turn * pieces
        out[..., :d] = self.way * longer * pieces[..., :d]
        out[..., d:] += longer * way * np.array(self.drift)
        return out

    def applied(self, windows: DriveWindows) -> DriveWindows:
        return replace(windows, pieces=self.corrected(windows.pieces))


@dataclass(frozen=True)
class MeanFit:
    """A mean with its evidence; p coefficients are the scale of the way, that of turns, and the drift."""

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


class NormalEquations(NamedTuple):
    """Z' C^-1 X (W, p, p) and Z' C^-1 e (W, p) of instruments, derivatives and errors; Z and X (W, n, p) whitened."""

    A: Array
    b: Array
    Z: Array
    X: Array


class Estimate(NamedTuple):
    """A mean with intervals (p,) of its coefficients."""

    mean: Mean
    low: Array
    high: Array


def no_mean(windows: DriveWindows) -> Mean:
    """The mean that corrects nothing."""
    return Mean(drift=(0.0,) * (len(windows.axes) - windows.d))


def fit_mean(windows: DriveWindows, covariance: Array | None = None) -> Mean:
    """Fit a mean by generalised least squares on the estimated motion.

    Parameters
    ----------
    covariance : (W, n, n) of the errors; None weighs by their mean square
    """
    mean = no_mean(windows)
    for _ in range(MEAN_ROUNDS):
        equations = normal_equations(windows, mean, covariance, [FORWARD])
        mean = estimate(windows, mean, equations[FORWARD]).mean
    return mean


def choose_mean(
    windows: DriveWindows,
    covariance: Array | None = None,
    start: Mean | None = None,
) -> MeanFit:
    """Fit the mean that holds whether the odometry's noise is in the estimated motion or in the true one.

    Errors in variables (Fuller 1987, "Measurement Error Models"): least squares on the estimated motion is right where
    that is what the vehicle was told to do, and too small where it was measured with noise; with the true motion as
    instruments it is the other way round. The coefficient is between both (Frisch 1934). The motion of neighbouring
    windows as instruments (Reiersol 1941) holds for either, if it predicts the motion, and errors of different windows
    are independent; it is used where its intervals are the narrower ones.

    Parameters
    ----------
    start : a mean that is nearly right
    """
    near = start or fit_mean(windows, covariance)
    equations = normal_equations(windows, near, covariance, [FORWARD, BACKWARD, NEIGHBOURS])
    forward, backward, neighbours = (estimate(windows, near, each) for each in equations.values())
    strength = _strength(equations[NEIGHBOURS])
    lasts = _lasts(neighbours.mean.applied(windows))
    range_of_both = np.maximum(forward.high, backward.high) - np.minimum(forward.low, backward.low)
    with np.errstate(divide="ignore", invalid="ignore"):  # of motions without an error
        gain = np.log(range_of_both / (neighbours.high - neighbours.low))[:SCALES].sum()
    are_instruments = strength >= STRONG and not lasts and gain > 0
    used, whole = [FORWARD, BACKWARD], forward.mean
    if are_instruments:
        used, whole = [NEIGHBOURS], neighbours.mean
    mean, low, high, free = _select(windows, near, [equations[each] for each in used])
    turns = forward.mean.turn, backward.mean.turn
    return MeanFit(mean, whole, low, high, free, used[0], turns, strength, lasts)


def _select(
    windows: DriveWindows, near: Mean, equations: Sequence[NormalEquations]
) -> tuple[Mean, Array, Array, Array]:
    """Mean of the coefficients whose range, over all equations, excludes none; ranges, and which coefficients, (p,)."""
    none = no_mean(windows).values
    free = np.ones(len(none), bool)
    low = high = none
    while True:
        found = [estimate(windows, near, each, free) for each in equations]
        low = np.where(free, np.min([each.low for each in found], axis=0), low)
        high = np.where(free, np.max([each.high for each in found], axis=0), high)
        depth = np.minimum(high - none, none - low) / (high - low)  # of none in its range
        depth[~free] = -1.0
        if not depth.max() >= 0:
            return found[0].mean, low, high, free
        free = free & (np.arange(len(free)) != np.argmax(depth))  # one at a time, as the others change with it


def normal_equations(
    windows: DriveWindows,
    mean: Mean,
    covariance: Array | None,
    instruments: Sequence[str],
) -> dict[str, NormalEquations]:
    """Equations of each kind of instruments, at a mean."""
    corrected = mean.applied(windows)
    error = corrected.errors
    if covariance is None:
        square = mean_square(error)
        covariance = np.diag(np.maximum(square, 1e-12 * square.max() + 1e-100))[None]
    whiten = np.linalg.inv(np.linalg.cholesky(covariance))
    X = whiten @ jacobian_of_mean(corrected.pieces)
    y = whiten @ error[..., None]
    found = {}
    for kind in instruments:
        Z = X
        if kind == BACKWARD:
            Z = whiten @ jacobian_of_mean(windows.true_pieces)
        elif kind == NEIGHBOURS:
            Z = whiten @ _of_neighbours(corrected)
        back = np.swapaxes(Z, -1, -2)
        found[kind] = NormalEquations(back @ X, (back @ y)[..., 0], Z, X)
    return found


def estimate(
    windows: DriveWindows,
    near: Mean,
    equations: NormalEquations,
    free: Array | None = None,
) -> Estimate:
    """The mean after a step of Gauss and Newton, with intervals from the scatter between blocks of what it leaves.

    Parameters
    ----------
    free : (p,) bool, coefficients that are fitted; the others are those of no mean
    """
    none = no_mean(windows).values
    start = near.values
    if free is None:
        free = np.ones(len(none), bool)
    # a step is relative for scales, and of a drift in the corrected way; here those that lead to no mean
    step = np.append(none[:SCALES] / start[:SCALES] - 1.0, -start[SCALES:] / near.way)
    step[free] = 0.0
    A = equations.A[:, free][:, :, free]
    left = equations.b[:, free] - equations.A[:, free] @ step
    inverse_of_sum = scaled_inverse(A.sum(axis=0), WEAK**2)
    step[free] = inverse_of_sum @ left.sum(axis=0)
    left = left - A @ step[free]
    blocks = jackknife_blocks(windows.drive, BLOCKS)
    k = max(len(blocks), 2)
    sums = np.stack([left[block].sum(axis=0) for block in blocks], axis=1)
    squares = np.zeros(len(step))
    squares[free] = ((inverse_of_sum @ sums) ** 2).sum(axis=1)
    reach = np.maximum(student(k) * np.sqrt(squares * k / (k - 1)), 1e-12)
    scales = start[:SCALES] * (1 + step[:SCALES])
    drift = start[SCALES:] * (1 + step[1]) + step[SCALES:] * near.way
    value = np.where(free, np.append(scales, drift), none)
    way, turn, *drifts = value.tolist()
    mean = Mean(way, turn, tuple(drifts))
    return Estimate(mean, value - reach, value + reach)


def scaled_inverse(A: Array, weak: float) -> Array:
    """Inverse of A (p, p), of coefficients of unlike sizes; 0 in directions that are weaker and not determined."""
    size = np.sqrt(np.maximum(np.abs(np.diag(A)), 1e-300))
    scale = np.outer(size, size)
    return np.asarray(np.linalg.pinv(A / scale, rcond=weak) / scale)


def _of_neighbours(windows: DriveWindows) -> Array:
    """Derivatives of the windows before and after, (W, n, p), less what is next to this one: its ends may be shared."""
    early = np.array(windows.pieces)
    late = np.array(windows.pieces)
    early[:, -GAP:] = late[:, :GAP] = 0.0
    return sum_of_neighbours(windows, jacobian_of_mean(early), jacobian_of_mean(late))


def sum_of_neighbours(windows: DriveWindows, before: Array, after: Array) -> Array:
    """Sum of a value of the window before and another of the one after, each (W, ...); 0 where there is none."""
    second = np.flatnonzero(windows.follows) + 1
    out = np.zeros_like(before)
    out[second] += before[second - 1]
    out[second - 1] += after[second]
    return out


def _strength(equations: NormalEquations) -> float:
    """First-stage F, the smallest of all coefficients: how well an instrument, beside the others, predicts the motion.

    Robust to unequal variances of windows (White 1980).
    """
    W, _, p = equations.X.shape
    smallest = 1e100
    for j in range(p):
        others = np.delete(equations.Z, j, axis=-1).reshape(-1, p - 1)
        x = left_by(others, equations.X[..., j].ravel(), WEAK)
        z = left_by(others, equations.Z[..., j].ravel(), WEAK)
        slope = float(z @ x) / max(float(z @ z), 1e-300)
        scores = (z * (x - slope * z)).reshape(W, -1).sum(axis=1)
        spread = max(float(np.linalg.norm(scores)), 1e-300)
        smallest = min(smallest, abs(float(z @ x)) / spread)
    return smallest**2


def left_by(X: Array, y: Array, weak: float | None = None) -> Array:
    """What least squares on X (N, p) leaves of y, (N,) or (N, k)."""
    return np.asarray(y - X @ np.linalg.lstsq(X, y, rcond=weak)[0])


def _lasts(corrected: DriveWindows) -> bool:
    """Whether rotation errors of windows one or two apart correlate positively; jitter of their ends does not."""
    error = corrected.errors[:, corrected.d :]
    error = error / root_mean_square(error)
    for lag in (1, 2):
        same_drive = corrected.drive[lag:] == corrected.drive[:-lag]
        products = (error[lag:] * error[:-lag]).sum(axis=1)[same_drive]
        if products.sum() > SURE * np.linalg.norm(products):
            return True
    return False


# --- a way by turn, where wheels slip ---------------------------------------------------------------------------------


def fit_slip(windows: DriveWindows) -> float:
    """Fit the way that a turn adds, m a rad, by least squares beside the mean.

    It is 0 where it cannot be told from a scale of the way, or of turns.
    """
    slip = 0.0
    for _ in range(SLIP_ROUNDS):
        longer = Mean(slip=slip).applied(windows)
        mean = fit_mean(longer)
        corrected = mean.applied(longer)
        error = corrected.errors
        size = root_mean_square(error)
        derivatives = (jacobian(corrected.pieces) / size[:, None]).reshape(error.size, -1)
        X, effect = derivatives[:, :-1], derivatives[:, -1]
        y = (error / size).ravel()
        left = left_by(X, effect)
        if not left @ left > APART * effect @ effect:
            return 0.0
        slip += float(left @ y / (left @ left)) / mean.way
    return slip


# --- white noise ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class WhiteNoise:
    """Cov e = sum over pieces of A diag(per_m |way| + per_rad |turn|) A', and the floor; n axes."""

    axes: tuple[str, ...]
    mean: Mean
    per_m: Array  # (n,), m^2/m and rad^2/m
    per_rad: Array  # (n,), m^2/rad and rad^2/rad
    floor: Array  # (n,), m^2 and rad^2: what both ends of a motion add
    factor: float = 1.0  # on all covariances, where caution asks for more than the fit
    mean_fit: MeanFit | None = None  # None where nothing is corrected

    @property
    def theta(self) -> Array:
        """Variances a metre and a radian, (2 n,)."""
        return np.concatenate([self.per_m, self.per_rad])

    def covariance(self, pieces: Array) -> Array:
        """Covariances (W, n, n) of Log(D^-1 M), of corrected motions in pieces (W, P, n)."""
        return self.factor * sum_of_terms(self.theta, terms_of(pieces), self.floor)

    def variances(self, pieces: Array) -> Array:
        """Diagonals of the covariances, (W, n)."""
        return np.diagonal(self.covariance(pieces), axis1=1, axis2=2)

    def nees(self, windows: DriveWindows) -> tuple[Array, Array]:
        """NEES over dof (W,), and of each axis alone (W, n), of windows whose motions are not corrected yet."""
        corrected = self.mean.applied(windows)
        error = corrected.errors
        C = self.covariance(corrected.pieces)
        own = np.diagonal(C, axis1=1, axis2=2)
        return nees_of(error, C) / error.shape[1], error**2 / own


def fit_noise(
    windows: DriveWindows,
    correct: bool = True,
    by_turn: bool = False,
    jitter: Array | float = 0.0,
) -> WhiteNoise:
    """Fit mean and noise of windows, each given the other in turn.

    Parameters
    ----------
    correct : take the mean out first
    by_turn : take out a way that each turn adds, too
    jitter : (n,), variance that both ends of a motion add, of :func:`jitter_of`

    Raises
    ------
    InputError
        Estimate and truth are the same, or there are fewer windows than parameters.
    """
    n = len(windows.axes)
    if len(windows.drive) < 2 * n:
        raise InputError(
            f"--span {windows.span.option}: {len(windows.drive)} windows are too few to fit {2 * n} variances; take a "
            "shorter span or longer drives: 50 windows in 5 drives make a verdict possible"
        )
    if by_turn:
        slip = fit_slip(windows)
        noise = fit_noise(Mean(slip=slip).applied(windows), jitter=jitter)
        return replace(noise, mean=replace(noise.mean, slip=slip))
    fit, mean, theta = None, no_mean(windows), None
    if correct:
        fit = choose_mean(windows)
        for _ in range(NOISE_ROUNDS):
            theta, floor, C = _fit_about(windows, fit.whole, fit, jitter, theta)
            fit = choose_mean(windows, C, fit.whole)
        mean = fit.mean
    theta, floor, _ = _fit_about(windows, mean, fit, jitter, theta)
    return WhiteNoise(windows.axes, mean, theta[:n], theta[n:], floor, mean_fit=fit)


def _fit_about(
    windows: DriveWindows,
    mean: Mean,
    fit: MeanFit | None,
    jitter: Array | float,
    start: Array | None,
) -> tuple[Array, Array, Array]:
    """Variances (2 n,), floor (n,) and covariances (W, n, n) of the errors about a mean."""
    corrected = mean.applied(windows)
    error = corrected.errors
    F = fitted_terms(corrected, fit)
    floor = np.maximum(least_of(error), jitter)
    theta = fit_terms(error, F, floor, start)
    return theta, floor, sum_of_terms(theta, F, floor)


def fitted_terms(windows: DriveWindows, fit: MeanFit | None) -> Array:
    """Terms (W, 2 n, n, n) that variances are fitted to, of windows whose motions are corrected.

    Where turns are measured with noise, an error is large where its own noise makes |turn| large, so that the turns of
    neighbouring windows stand for them.
    """
    F = terms_of(windows.pieces)
    n = len(windows.axes)
    if fit is None or fit.instruments != NEIGHBOURS:
        return F
    one = np.ones(len(F))
    number = sum_of_neighbours(windows, one, one)
    known = number > 0
    others = sum_of_neighbours(windows, F[:, n:], F[:, n:])[known]
    others = others / number[known, None, None, None]
    F[:, n:] = others.mean(axis=0)
    F[known, n:] = others
    return F


def least_of(error: Array) -> Array:
    """A share of the largest mean square among positions, and among rotations, for each axis: (W, n) -> (n,).

    Raises
    ------
    InputError
        All errors of one kind are nothing but rounding.
    """
    square = mean_square(error)
    d = d_of(square)
    least = np.empty(len(square))
    for what, part in (("positions", slice(d)), ("rotations", slice(d, None))):
        largest = square[part].max()
        if not largest > 1e-20:
            raise InputError(
                f"estimate and truth have the same {what}; there is no error to fit: give those that the odometry "
                "estimates itself"
            )
        least[part] = LEAST * largest
    return least


def jitter_of(noise: WhiteNoise, windows: DriveWindows) -> Array:
    """Variance that both ends of a motion add to its error, (n,), where shorter windows show it; 0 otherwise.

    The mean square error of windows of several lengths is what the noise says, times a factor, and a constant.
    """
    sizes = windows.span.size / np.array(SHORTER)
    if windows.span.unit == "step":
        sizes = np.round(sizes[sizes >= 1])
    cut = [windows.over(size) for size in sizes.tolist()]
    corrected = [noise.mean.applied(each) for each in cut if each is not None]
    if len(corrected) < LENGTHS:
        return np.zeros(len(noise.axes))
    squares = np.array([mean_square(each.errors) for each in corrected])
    stated = np.array([noise.variances(each.pieces).mean(axis=0) for each in corrected])
    counts = np.array([len(each.drive) for each in corrected])
    axes = zip(squares.T, stated.T, strict=True)
    return np.array([constant_of(*axis, counts) for axis in axes])


def constant_of(squares: Array, stated: Array, counts: Array) -> float:
    """J >= 0 of squares (k,) = factor * stated + J, by weighted least squares; 0 where none is shown.

    A mean square of W windows has a relative variance of 2 / W.
    """
    weight = np.sqrt(counts / 2.0)
    relative = weight / np.maximum(squares, 1e-100)
    X = np.column_stack([stated * relative, relative])
    size = np.maximum(norms(X.T), 1e-300)
    X = X / size
    slope, constant = np.linalg.lstsq(X, weight, rcond=None)[0] / size
    error = np.sqrt(np.linalg.pinv(X.T @ X)[1, 1]) / size[1]
    is_shown = slope > 0 and constant > SHOWN * error
    return float(constant) if is_shown else 0.0


def variance_intervals(noise: WhiteNoise, windows: DriveWindows) -> tuple[Interval, ...]:
    """Intervals of the variances a metre and a radian, (2 n,), from the jackknife over drives or blocks of windows."""
    corrected = noise.mean.applied(windows)
    error = corrected.errors
    F = fitted_terms(corrected, noise.mean_fit)
    whole: Indices = np.arange(len(error))
    rests = [np.setdiff1d(whole, block) for block in jackknife_blocks(windows.drive)]
    left = [fit_terms(error[rest], F[rest], noise.floor, noise.theta) for rest in rests]
    terms = zip(noise.theta.tolist(), np.transpose(left), strict=True)
    return tuple(interval_of(*term) for term in terms)


# --- derivatives of errors --------------------------------------------------------------------------------------------


def jacobian(pieces: Array) -> Array:
    """Derivative (W, n, p + 1) of the errors by the p coefficients of a mean, and by a slip."""
    d = d_of(pieces)
    axes = pieces.shape[-1] - d
    way = ways(pieces)
    T = motion_matrices(pieces)
    along = -inverse(T)[..., :-1, -1]  # R' t: at its end a longer way is an error along it
    local = np.zeros((*pieces.shape, SCALES + axes + 1))
    local[..., :d, 0] = along
    local[..., d:, 1] = pieces[..., d:]
    local[..., d:, SCALES:-1] = way[..., None, None] * np.eye(axes)
    local[..., :d, -1] = along * turn_per_way(pieces)[..., None]
    W, P, n, p = local.shape
    A = np.moveaxis(carriers(T)[:, 1:], 1, 2)
    return np.asarray(A.reshape(W, n, P * n) @ local.reshape(W, P * n, p))


def jacobian_of_mean(pieces: Array) -> Array:
    """Derivative (W, n, p) of the errors by scale of the way, scale of turns, and drift."""
    return jacobian(pieces)[..., :-1]


def carriers(T: Array) -> Array:
    """A_k (W, P + 1, n, n) that carry an error at each end of a piece to the end of the window: Ad(rest)^-1.

    T (W, P, d + 1, d + 1) are the pieces.
    """
    return adjoint(inverse(rests(T)))


# --- maximum likelihood -----------------------------------------------------------------------------------------------


def terms_of(pieces: Array) -> Array:
    """F (W, 2 n, n, n): the covariance of a window's error for a variance of 1 a m, then a rad, in each axis.

    The noise of a piece stands half at each of its ends (trapezoidal rule), and is carried to the end of the window.
    """
    A = carriers(motion_matrices(pieces))
    sizes = np.stack([ways(pieces), angles(pieces)], axis=1)  # (W, 2, P)
    share = np.zeros((*sizes.shape[:2], sizes.shape[2] + 1))
    share[..., :-1] += 0.5 * sizes
    share[..., 1:] += 0.5 * sizes
    F = np.einsum("wsk,wkia,wkja->wsaij", share, A, A, optimize=True)
    return np.asarray(F.reshape(len(F), -1, *F.shape[-2:]))


def sum_of_terms(theta: Array, F: Array, floor: Array) -> Array:
    """Covariances (W, n, n) of terms F (W, p, n, n) with variances theta (p,), and the floor (n,)."""
    return np.asarray(np.diag(floor) + np.tensordot(theta, F, (0, 1)))


def fit_terms(
    error: Array,
    F: Array,
    floor: Array,
    start: Array | None = None,
) -> Array:
    """Fit variances theta >= 0 (p,) with Cov e_w = diag(floor) + sum theta_p F_wp, by maximum likelihood.

    Scoring for covariances that are linear in their parameters (Anderson 1973, "Asymptotically efficient estimation of
    covariance matrices with linear structure", Ann. Statist. 1): each step is a least squares fit of e e', weighted by
    the inverse of the present covariance, with theta >= 0 (Lawson & Hanson 1974), halved until the likelihood grows.
    Windows are taken as independent: where they are not, it is a composite likelihood (Varin, Reid & Firth 2011).

    Parameters
    ----------
    error : (W, n)
    F : (W, p, n, n)
    floor : (n,), variances that are there in any case
    """
    if start is not None:
        theta = np.maximum(start, 1e-12 * start.max())
    else:  # the mean square of each axis, divided evenly among its terms
        term = np.arange(F.shape[1])
        axis = term % error.shape[1]
        own = F.mean(axis=0)[term, axis, axis]
        theta = mean_square(error)[axis] / (2 * np.where(own > 0, own, np.inf)) + 1e-30
    return maximise(
        lambda variances: score_of(error, sum_of_terms(variances, F, floor), F), theta, 0.0, CLOSE * len(error)
    )
