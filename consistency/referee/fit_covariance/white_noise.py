"""White noise of motions: a variance a metre and a variance a radian in each axis, with a floor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from consistency.referee.diagnostics.verdict.parts import Interval
from consistency.referee.errors import InputError
from consistency.referee.fit_covariance.drives import Drive
from consistency.referee.fit_covariance.systematic_errors import Mean, fit_mean, none_of
from consistency.referee.fit_covariance.variances import blocks_of, fit_terms, interval_of, nees_of, terms_of
from consistency.referee.fit_covariance.windows import Windows, windows_at
from consistency.referee.types import Array, Indices

LEAST = 1e-4  # of the largest variance of positions, or of rotations, that every axis has: a hundredth of its sigma
ROUNDS = 3  # of mean and noise in turn
SHORTER = (8.0, 4.0, 2.0, 1.0)  # parts of the span, whose errors tell jitter of both ends from noise of the way


@dataclass(frozen=True)
class Noise:
    """Cov e = sum over pieces of A diag(per_m |way| + per_rad |turn|) A', raised to the floor; n axes."""

    axes: tuple[str, ...]
    mean: Mean
    per_m: Array  # (n,), m^2/m and rad^2/m
    per_rad: Array  # (n,), m^2/rad and rad^2/rad
    floor: Array  # (n,), m^2 and rad^2: no motion has a smaller variance
    factor: float = 1.0  # on all covariances, where caution asks for more than the fit

    def covariance(self, pieces: Array) -> Array:
        """Covariances (W, n, n) of Log(D^-1 M), of corrected motions in pieces (W, P, d + 1, d + 1)."""
        theta = np.concatenate([self.per_m, self.per_rad])
        C = np.tensordot(theta, terms_of(pieces), (0, 1))
        own = np.diagonal(C, axis1=1, axis2=2)
        return np.asarray(self.factor * (C + np.maximum(self.floor - own, 0.0)[:, :, None] * np.eye(len(self.axes))))

    def nees(self, windows: Windows) -> tuple[Array, Array]:
        """NEES over dof (W,), and of each axis alone (W, n), of windows whose motions are not corrected yet."""
        corrected = self.mean.applied(windows)
        error, C = corrected.errors, self.covariance(corrected.pieces)
        return nees_of(error, C) / error.shape[1], error**2 / np.diagonal(C, axis1=1, axis2=2)


def fit_noise(windows: Windows, correct: bool = True) -> Noise:
    """Mean and noise of windows, each given the other in turn.

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
    mean = fit_mean(windows) if correct else none_of(windows)
    theta = None
    for left in reversed(range(ROUNDS if correct else 1)):
        now = mean.applied(windows)
        error, F = now.errors, terms_of(now.pieces)
        floor = least_of(error)
        theta = fit_terms(error, F, floor, theta)
        if left:
            mean = fit_mean(windows, np.diag(floor) + np.tensordot(theta, F, (0, 1)), mean)
    assert theta is not None
    n = len(windows.axes)
    return Noise(windows.axes, mean, theta[:n], theta[n:], floor)


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
            raise InputError(f"estimate and truth have the same {what}; there is no error to fit")
        out[part] = LEAST * square[part].max()
    return out


def with_jitter(noise: Noise, drives: Sequence[Drive], windows: Windows, planar: bool) -> Noise:
    """The noise with a floor at what both ends of a motion add to its error, where shorter windows show it.

    The mean square error of windows of several lengths is what the noise says, times a factor, and a constant.
    """
    squares, stated = [], []
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
    if len(squares) < 3:
        return noise
    return replace(noise, floor=np.maximum(noise.floor, _constants(np.array(squares), np.array(stated))))


def _constants(squares: Array, stated: Array) -> Array:
    """J >= 0 (n,) of squares (k, n) = factor stated + J, with the weight that squares deserve; 0 where it is none."""
    out = np.zeros(squares.shape[1])
    for axis, (q, c) in enumerate(zip(squares.T, stated.T, strict=True)):
        X = np.column_stack([c, np.ones(len(c))]) / np.maximum(q, 1e-300)[:, None]
        slope, constant = np.linalg.lstsq(X, np.ones(len(q)), rcond=None)[0]
        out[axis] = max(constant, 0.0) if slope > 0 else 0.0
    return out


def intervals(noise: Noise, windows: Windows) -> tuple[tuple[Interval, ...], tuple[Interval, ...]]:
    """Intervals of the variances a metre and a radian, from the jackknife over drives or blocks of windows."""
    now = noise.mean.applied(windows)
    error, F, floor = now.errors, terms_of(now.pieces), least_of(now.errors)
    theta = np.concatenate([noise.per_m, noise.per_rad])
    whole: Indices = np.arange(len(error))
    left = []
    for block in blocks_of(windows.drive):
        rest = np.setdiff1d(whole, block)
        left.append(fit_terms(error[rest], F[rest], floor, theta))
    values = [interval_of(float(value), column) for value, column in zip(theta, np.array(left).T, strict=True)]
    n = len(noise.axes)
    return tuple(values[:n]), tuple(values[n:])
