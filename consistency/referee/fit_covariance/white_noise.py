"""White noise of motions: a variance a metre and a variance a radian in each axis, with a floor, and their intervals.

The variances are fitted to the errors of windows by maximum likelihood.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import optimize, stats

from consistency.referee.defaults import CONFIDENCE
from consistency.referee.diagnostics.verdict.parts import Interval
from consistency.referee.errors import InputError
from consistency.referee.fit_covariance.drives import Drive
from consistency.referee.fit_covariance.motion_windows import (
    DriveWindows,
    blocks_of,
    lengthened,
    rotation_vectors,
    ways,
    windows_at,
)
from consistency.referee.fit_covariance.slip import BY_TURN, fit_slip
from consistency.referee.fit_covariance.systematic_errors import (
    NEIGHBOURS,
    Mean,
    MeanFit,
    carriers,
    choose_mean,
    none_of,
    sum_of_neighbours,
)
from consistency.referee.types import Array, Indices

LEAST = 1e-4  # of the largest variance of positions, or of rotations, that every axis has: a hundredth of its sigma
ROUNDS = 3  # of mean and noise in turn
SHOWN = 3.0  # standard errors from which there is jitter
SHORTER = (8.0, 4.0, 2.0, 1.0)  # parts of the span, whose errors tell jitter of both ends from noise of the way


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

    def covariance(self, pieces: Array) -> Array:
        """Covariances (W, n, n) of Log(D^-1 M), of corrected motions in pieces (W, P, d + 1, d + 1)."""
        theta = np.concatenate([self.per_m, self.per_rad])
        return np.asarray(self.factor * (np.tensordot(theta, terms_of(pieces), (0, 1)) + np.diag(self.floor)))

    def nees(self, windows: DriveWindows) -> tuple[Array, Array]:
        """NEES over dof (W,), and of each axis alone (W, n), of windows whose motions are not corrected yet."""
        corrected = self.mean.applied(windows)
        error, C = corrected.errors, self.covariance(corrected.pieces)
        return nees_of(error, C) / error.shape[1], error**2 / np.diagonal(C, axis1=1, axis2=2)


def fit_noise(windows: DriveWindows, correct: bool | str = True, jitter: Array | float = 0.0) -> WhiteNoise:
    """Mean and noise of windows, each given the other in turn; the mean is of BY_TURN, too, if this is ``correct``.

    Parameters
    ----------
    jitter : (n,), variance that both ends of a motion add, of :func:`jitter_of`

    Raises
    ------
    InputError
        Estimate and truth are the same, or there are fewer windows than parameters.
    """
    least = 2 * len(windows.axes)
    if len(windows.drive) < least:
        raise InputError(
            f"--span {windows.span.option}: {len(windows.drive)} windows are too few to fit {least} variances; take a "
            "shorter span or longer drives: 50 windows in 5 drives make a verdict possible"
        )
    if correct == BY_TURN:
        slip = fit_slip(windows)
        noise = fit_noise(replace(windows, pieces=lengthened(windows.pieces, slip)), True, jitter)
        return replace(noise, mean=replace(noise.mean, slip=slip))
    found, theta = choose_mean(windows) if correct else None, None
    mean = none_of(windows) if found is None else found.whole
    for left in reversed(range(ROUNDS if correct else 1)):
        now = mean.applied(windows)
        error, F = now.errors, fitted_terms(now, found)
        floor = np.maximum(least_of(error), jitter)
        theta = fit_terms(error, F, floor, theta)
        if left and found:
            C = np.diag(floor) + np.tensordot(theta, F, (0, 1))
            found = choose_mean(windows, C, mean)
            mean = found.whole if left > 1 else found.mean
    assert theta is not None
    n = len(windows.axes)
    return WhiteNoise(windows.axes, mean, theta[:n], theta[n:], floor, mean_fit=found)


def fitted_terms(windows: DriveWindows, mean: MeanFit | None) -> Array:
    """Terms (W, 2 n, n, n) that variances are fitted to, of windows whose motions are corrected.

    Where turns are measured with noise, an error is large where its own noise makes |turn| large, so that the turns of
    neighbouring windows stand for them.
    """
    F, n = terms_of(windows.pieces), len(windows.axes)
    if mean is None or mean.instruments != NEIGHBOURS:
        return F
    number = sum_of_neighbours(windows, *2 * [np.ones(len(F))])
    other = sum_of_neighbours(windows, F[:, n:], F[:, n:])[number > 0] / number[number > 0, None, None, None]
    F[:, n:] = other.mean(axis=0)
    F[number > 0, n:] = other
    return F


def least_of(error: Array) -> Array:
    """A share of the largest mean square among positions, and among rotations, for each axis: (W, n) -> (n,).

    Raises
    ------
    InputError
        All errors of one kind are nothing but rounding.
    """
    d, square = (2 if error.shape[1] == 3 else 3), (error**2).mean(axis=0)
    kinds = ((slice(0, d), "positions"), (slice(d, None), "rotations"))
    out = np.empty(error.shape[1])
    for part, what in kinds:
        if not square[part].max() > 1e-20:
            raise InputError(
                f"estimate and truth have the same {what}; there is no error to fit: give those that the odometry "
                "estimates itself"
            )
        out[part] = LEAST * square[part].max()
    return out


def jitter_of(noise: WhiteNoise, drives: Sequence[Drive], windows: DriveWindows, planar: bool) -> Array:
    """Variance that both ends of a motion add to its error, (n,), where shorter windows show it; 0 otherwise.

    The mean square error of windows of several lengths is what the noise says, times a factor, and a constant.
    """
    squares, stated, counts = [], [], []
    for part in SHORTER:
        size = windows.span.size / part
        if windows.span.unit == "step":
            size = round(size) if size >= 1 else 0
        some = windows_at(drives, windows, size, planar) if size else None
        if some is None:
            continue
        now = noise.mean.applied(some)
        squares.append((now.errors**2).mean(axis=0))
        stated.append(np.diagonal(noise.covariance(now.pieces), axis1=1, axis2=2).mean(axis=0))
        counts.append(len(some.drive))
    if len(squares) < 3:
        return np.zeros(len(noise.axes))
    return _constants(np.array(squares), np.array(stated), np.array(counts))


def _constants(squares: Array, stated: Array, counts: Array) -> Array:
    """J >= 0 (n,) of squares (k, n) = factor stated + J, by weighted least squares; 0 where none is shown.

    A mean square of W windows has a relative variance of 2 / W.
    """
    out = np.zeros(squares.shape[1])
    for axis, (q, c) in enumerate(zip(squares.T, stated.T, strict=True)):
        weight = np.sqrt(counts / 2.0)
        X = np.column_stack([c, np.ones(len(c))]) * (weight / np.maximum(q, 1e-100))[:, None]
        size = np.maximum(np.linalg.norm(X, axis=0), 1e-300)
        slope, constant = np.linalg.lstsq(X / size, weight, rcond=None)[0] / size
        error = np.sqrt(np.linalg.pinv((X / size).T @ (X / size))[1, 1]) / size[1]
        out[axis] = constant if slope > 0 and constant > SHOWN * error else 0.0
    return out


def intervals(noise: WhiteNoise, windows: DriveWindows) -> tuple[tuple[Interval, ...], tuple[Interval, ...]]:
    """Intervals of the variances a metre and a radian, from the jackknife over drives or blocks of windows."""
    now = noise.mean.applied(windows)
    error, F, floor = now.errors, fitted_terms(now, noise.mean_fit), noise.floor
    theta = np.concatenate([noise.per_m, noise.per_rad])
    whole: Indices = np.arange(len(error))
    left = []
    for block in blocks_of(windows.drive):
        rest = np.setdiff1d(whole, block)
        left.append(fit_terms(error[rest], F[rest], floor, theta))
    values = [interval_of(float(value), column) for value, column in zip(theta, np.array(left).T, strict=True)]
    n = len(noise.axes)
    return tuple(values[:n]), tuple(values[n:])


STEPS, CLOSE = 100, 1e-7  # of scoring; gain of the log likelihood of a window at which it ends


def terms_of(pieces: Array) -> Array:
    """F (W, 2 n, n, n): the covariance of a window's error for a variance of 1 a m, then a rad, in each axis.

    The noise of a piece stands half at each of its ends (trapezoidal rule), and is carried to the end of the window.
    """
    A = carriers(pieces)
    sizes = np.stack([ways(pieces), np.linalg.norm(rotation_vectors(pieces), axis=-1)], axis=1)  # (W, 2, P)
    share = np.zeros((*sizes.shape[:2], sizes.shape[2] + 1))
    share[..., :-1] += 0.5 * sizes
    share[..., 1:] += 0.5 * sizes
    F = np.einsum("wsk,wkia,wkja->wsaij", share, A, A, optimize=True)
    return np.asarray(F.reshape(len(F), -1, *F.shape[-2:]))


def fit_terms(error: Array, F: Array, floor: Array, start: Array | None = None) -> Array:
    """Variances theta >= 0 (p,) with Cov e_w = diag(floor) + sum theta_p F_wp, by maximum likelihood.

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
    base = np.diag(floor)
    theta = _start(error, F) if start is None else np.maximum(start, 1e-12 * start.max())
    value = _likelihood(error, base + np.tensordot(theta, F, (0, 1)))
    for _ in range(STEPS):
        C = base + np.tensordot(theta, F, (0, 1))
        inverse = np.linalg.inv(C)
        G = inverse[:, None] @ F  # (W, p, n, n)
        flat = G.reshape(*G.shape[:2], -1)
        turned = np.swapaxes(G, -1, -2).reshape(flat.shape)
        H = np.tensordot(flat, turned, ((0, 2), (0, 2)))
        u = inverse @ error[..., None]
        g = np.einsum("wi,wpij,wj->p", u[..., 0], F, u[..., 0], optimize=True)
        g = g - np.einsum("wpij,wji->p", G, inverse * floor[:, None], optimize=True)
        target, step = _nonnegative(H, g), 1.0
        while True:
            trial = theta + step * (target - theta)
            better = _likelihood(error, base + np.tensordot(trial, F, (0, 1)))
            if better >= value or step < 1e-3:
                break
            step *= 0.5
        gain = better - value
        if gain > 0:
            theta, value = trial, better
        if gain < CLOSE * len(error):
            break
    return np.asarray(theta)


def _start(error: Array, F: Array) -> Array:
    """The mean square of each axis, divided evenly among its terms."""
    n = error.shape[1]
    own = np.stack([np.diagonal(F, axis1=2, axis2=3)[:, p, p % n].mean() for p in range(F.shape[1])])
    return np.asarray((error**2).mean(axis=0)[np.arange(F.shape[1]) % n] / (2 * np.where(own > 0, own, np.inf)) + 1e-30)


def _likelihood(error: Array, C: Array) -> float:
    """Log density of the errors but for its constant; -inf where a covariance is not positive definite."""
    sign, logdet = np.linalg.slogdet(C)
    if not (sign > 0).all():
        return -np.inf
    return float(-0.5 * (logdet.sum() + nees_of(error, C).sum()))


def nees_of(error: Array, C: Array) -> Array:
    """e' C^-1 e, (W,)."""
    return np.asarray((error * np.linalg.solve(C, error[..., None])[..., 0]).sum(axis=1))


def _nonnegative(H: Array, g: Array) -> Array:
    """The minimum of x'Hx / 2 - g'x with x >= 0."""
    scale = np.sqrt(np.maximum(np.diag(H), 1e-300))
    scaled = H / np.outer(scale, scale)
    values, vectors = np.linalg.eigh(scaled)
    root = np.sqrt(np.maximum(values, 1e-9))
    return np.asarray(optimize.nnls(root[:, None] * vectors.T, (vectors.T @ (g / scale)) / root)[0] / scale)


def interval_of(value: float, left_out: Sequence[float]) -> Interval:
    """Interval of a variance from its values with each block left out, in cube roots (Wilson & Hilferty 1931)."""
    roots, k = np.cbrt(np.asarray(left_out)), len(left_out)
    error = float(np.sqrt((k - 1) / k * ((roots - roots.mean()) ** 2).sum()))
    reach = float(stats.t.isf(0.5 * (1.0 - CONFIDENCE), k - 1)) * error if k > 1 else np.inf
    if not error > 0:  # 0 with any block left out: its upper end is not known
        return Interval(value, 0.0, float("nan"))
    low, high = float(np.cbrt(value)) - reach, float(np.cbrt(value)) + reach
    return Interval(value, max(low, 0.0) ** 3, high**3)
