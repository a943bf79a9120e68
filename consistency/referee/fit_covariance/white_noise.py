"""White noise of motions: a variance a metre and a variance a radian in each axis, with a floor, and their intervals.

The variances are fitted to the errors of windows by maximum likelihood.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from consistency.referee.diagnostics.verdict_parts import Interval
from consistency.referee.errors import InputError
from consistency.referee.fit_covariance.estimation import interval_of, maximise, nees_of, score_of
from consistency.referee.fit_covariance.motion_windows import (
    DriveWindows,
    angles,
    jackknife_blocks,
    mean_square,
    norms,
    ways,
)
from consistency.referee.fit_covariance.systematic_errors import (
    NEIGHBOURS,
    Mean,
    MeanFit,
    carriers,
    choose_mean,
    fit_slip,
    no_mean,
    sum_of_neighbours,
)
from consistency.referee.types import Array, Indices

LEAST = 1e-4  # of the largest variance of positions, or of rotations, that every axis has: a hundredth of its sigma
ROUNDS = 2  # of mean and noise in turn, before the mean is told from none
SHOWN = 3.0  # standard errors from which there is jitter
SHORTER = (8.0, 4.0, 2.0, 1.0)  # parts of the span, whose errors tell jitter of both ends from noise of the way
LENGTHS = 3  # that tell it
CLOSE = 1e-7  # gain of the log likelihood of a window at which scoring ends


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
        for _ in range(ROUNDS):
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
    d = 2 if len(square) == 3 else 3
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


# --- maximum likelihood -----------------------------------------------------------------------------------------------


def terms_of(pieces: Array) -> Array:
    """F (W, 2 n, n, n): the covariance of a window's error for a variance of 1 a m, then a rad, in each axis.

    The noise of a piece stands half at each of its ends (trapezoidal rule), and is carried to the end of the window.
    """
    A = carriers(pieces)
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
    theta = np.maximum(start, 1e-12 * start.max()) if start is not None else _start(error, F)
    return maximise(
        lambda variances: score_of(error, sum_of_terms(variances, F, floor), F), theta, 0.0, CLOSE * len(error)
    )


def _start(error: Array, F: Array) -> Array:
    """The mean square of each axis, divided evenly among its terms."""
    axis = np.arange(F.shape[1]) % error.shape[1]
    own = F.mean(axis=0)[np.arange(F.shape[1]), axis, axis]
    square = mean_square(error)[axis]
    return np.asarray(square / (2 * np.where(own > 0, own, np.inf)) + 1e-30)
