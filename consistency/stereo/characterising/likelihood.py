"""Restricted likelihood of one coordinate: bias as regression, an offset of each track, noise with memory.

Residual i of track t is ``X_i beta + o_t + e_i``: ``o_t`` is drawn once per track with variance tau^2, ``e_i`` in each
observation with standard deviation ``G_i a`` and correlation rho^gap with the one before. Patterson & Thompson (1971)
maximise the likelihood of what the regression leaves, so that the degrees of freedom that it costs are paid for.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy import optimize

from consistency.referee.types import Array, Indices

STEP = 1e-3  # of a parameter, for second differences; log sigma, atanh rho and log(1 + n q) are all of order 1
MOST = 0.995  # magnitude of a correlation
IMPOSSIBLE = 1e12
GENTLE = 1e-3  # of the rows: slope at which the first search ends
STEPS = 30
NEAR = 1e-6  # squared distance to the top, in standard deviations


@dataclass(frozen=True)
class Rows:
    """N residuals of one coordinate, sorted by track and step; K tracks."""

    r: Array  # (N,), px
    X: Array  # (N, p), regressors of the bias
    G: Array  # (N, m), weights of the standard deviations at the nodes of disparity
    first: Indices  # (K,), first row of each track
    gap: Array  # (N,), steps since the row before in the track, 0 in the first
    ridge: Array  # (p,), 1 / variance of a prior about 0 of each coefficient, mostly 0

    @property
    def length(self) -> float:
        """Rows of a track that its offset is averaged over, the mean that an analysis of variance has."""
        n = np.diff(np.append(self.first, len(self.r)))
        return float((n.sum() - (n**2).sum() / n.sum()) / max(len(n) - 1, 1))

    @property
    def track(self) -> Indices:
        """Number of the track of each row, (N,)."""
        n = np.diff(np.append(self.first, len(self.r)))
        return np.repeat(np.arange(len(n)), n)


@dataclass(frozen=True)
class Parameters:
    """What a vector of unconstrained parameters stands for."""

    a: Array  # (m,), px, standard deviation of the noise at the nodes
    rho: float
    ratio: float  # q: variance of the offsets over that of the noise; may be a little below 0

    @classmethod
    def of(cls, theta: Array, length: float) -> Parameters:
        """From log a, atanh rho, log(1 + length q): scales on which estimates are nearly Gaussian."""
        return cls(np.exp(theta[:-2]), float(np.tanh(theta[-2])), float(np.expm1(theta[-1]) / length))


@dataclass(frozen=True)
class Whitened:
    """Rows freed of their correlation, and what that costs in each track."""

    values: Array  # (N, columns)
    log_variance: Array  # (K,), log det of the covariance of each track


def whiten_rows(rows: Rows, columns: Array, p: Parameters) -> Whitened | None:
    """Columns (N, c) times the inverse root of the covariance; None where that is not positive definite."""
    sd = rows.G @ p.a
    if abs(p.rho) > MOST or not (sd > 0).all():
        return None
    root = np.sqrt(np.mean(sd**2) * abs(p.ratio)) * np.sign(p.ratio)
    x = np.column_stack([columns, np.ones(len(sd))]) / sd[:, None]
    decay = np.where(rows.gap > 0, p.rho ** np.maximum(rows.gap, 1), 0.0)
    left = 1.0 - decay**2
    x[1:] -= decay[1:, None] * x[:-1]
    x /= np.sqrt(left)[:, None]
    one = x[:, -1:] * abs(root)
    energy = np.sign(root) * np.add.reduceat(one[:, 0] ** 2, rows.first)
    if (energy <= -1.0).any():
        return None
    log_variance = np.add.reduceat(2.0 * np.log(sd) + np.log(left), rows.first) + np.log1p(energy)
    x = x[:, :-1]
    if root != 0.0:  # (I - k c c')^2 is the inverse of I + s c c'
        size = np.add.reduceat(one[:, 0] ** 2, rows.first)
        k = (1.0 - 1.0 / np.sqrt(1.0 + energy)) / np.maximum(size, 1e-300)
        along = np.add.reduceat(one * x, rows.first, axis=0) * k[:, None]
        x -= one * along[rows.track]
    return Whitened(x, log_variance)


@dataclass(frozen=True)
class Regression:
    """Generalised least squares at some parameters."""

    beta: Array  # (p,)
    cov: Array  # (p, p)
    residual: Array  # (N,), whitened
    X: Array  # (N, p), whitened
    value: float  # restricted log-likelihood, but for a constant


def regress(rows: Rows, p: Parameters) -> Regression | None:
    """The coefficients and the restricted likelihood; None where the parameters are not possible."""
    white = whiten_rows(rows, np.column_stack([rows.r, rows.X]), p)
    if white is None:
        return None
    y, X = white.values[:, 0], white.values[:, 1:]
    normal = X.T @ X + np.diag(rows.ridge)
    try:
        factor = np.linalg.cholesky(normal)
    except np.linalg.LinAlgError:
        return None
    beta = np.linalg.solve(normal, X.T @ y)
    e = y - X @ beta
    value = -0.5 * (white.log_variance.sum() + 2.0 * np.log(np.diag(factor)).sum() + e @ e + rows.ridge @ beta**2)
    return Regression(beta, np.linalg.inv(normal), e, X, float(value))


@dataclass(frozen=True)
class LikelihoodFit:
    """The largest restricted likelihood and what is known of its place."""

    rows: Rows
    theta: Array  # (m + 2,)
    cov: Array  # (m + 2, m + 2), of theta by the curvature: right for Gaussian noise
    robust: Array  # (m + 2, m + 2), of theta by the scatter of the tracks' scores: right for any noise
    regression: Regression
    parameters: Parameters

    @property
    def tracks(self) -> int:
        return len(self.rows.first)


def fit(rows: Rows, start: float, memory: bool = True) -> LikelihoodFit:
    """The parameters of largest restricted likelihood.

    Parameters
    ----------
    start : px, about the standard deviation
    memory : whether offset and correlation are estimated; False where tracks are too short, both are then 0

    Raises
    ------
    ValueError
        The rows do not determine the parameters.
    """
    m, length = rows.G.shape[1], max(rows.length, 1.0)
    free = np.arange(m + 2 if memory else m)
    theta = np.concatenate([np.full(m, np.log(start)), [0.0, 0.0]])

    def full(values: Array) -> Array:
        out = theta.copy()
        out[free] = values
        return out

    def restricted(values: Array) -> float:
        found = regress(rows, Parameters.of(full(values), length))
        return IMPOSSIBLE if found is None else -found.value

    x = np.asarray(theta[free])
    plain = rows.X @ np.linalg.solve(rows.X.T @ rows.X + np.diag(rows.ridge + 1e-9), rows.X.T @ rows.r)
    x = optimize.minimize(_held(rows, plain, full, length), x, method="BFGS", options={"gtol": GENTLE * len(rows.r)}).x
    x, H = _climb(restricted, x, rows, full, length)
    theta = full(x)
    parameters = Parameters.of(theta, length)
    regression = regress(rows, parameters)
    if regression is None:
        raise ValueError("the data do not determine the noise")
    inverse = np.linalg.inv(H)
    scores = _scores(rows, full, x, regression.beta, length)
    K = len(scores)
    robust = inverse @ (scores.T @ scores) @ inverse * K / max(K - 1, 1)
    cov, scatter = np.zeros((m + 2, m + 2)), np.zeros((m + 2, m + 2))
    cov[np.ix_(free, free)], scatter[np.ix_(free, free)] = inverse, robust
    return LikelihoodFit(rows, theta, cov, scatter, regression, parameters)


def _held(rows: Rows, bias: Array, full: Callable[[Array], Array], length: float) -> Callable[[Array], float]:
    """Negative log-likelihood of the free parameters with the bias (N,) held, much cheaper than the restricted one."""
    y = (rows.r - bias)[:, None]

    def negative(values: Array) -> float:
        white = whiten_rows(rows, y, Parameters.of(full(values), length))
        return IMPOSSIBLE if white is None else 0.5 * float(white.log_variance.sum() + (white.values**2).sum())

    return negative


def _climb(
    restricted: Callable[[Array], float], x: Array, rows: Rows, full: Callable[[Array], Array], length: float
) -> tuple[Array, Array]:
    """Newton's steps to the least ``restricted``, and the curvature there.

    The curvature is that with the bias held: its residuals have lost already the degrees of freedom that it costs.
    """
    e = STEP * np.eye(len(x))
    for _ in range(STEPS):
        found = regress(rows, Parameters.of(full(x), length))
        if found is None:
            raise ValueError("the data do not determine the noise")
        H = numerical_hessian(_held(rows, rows.X @ found.beta, full, length), x)
        if not np.isfinite(H).all() or np.linalg.eigvalsh(H)[0] <= 0:
            raise ValueError("the data do not determine the noise")
        slope = np.array([(restricted(x + d) - restricted(x - d)) / (2.0 * STEP) for d in e])
        step, size = -np.linalg.solve(H, slope), 1.0
        if slope @ -step < NEAR:
            return x, H
        while restricted(x + size * step) > -found.value and size > 1e-3:
            size *= 0.5
        x = x + size * step
    return x, H


def numerical_hessian(objective: Callable[[Array], float], x: Array) -> Array:
    """Second derivatives (k, k) by central differences."""
    k, e = len(x), STEP * np.eye(len(x))
    H = np.empty((k, k))
    for i in range(k):
        for j in range(i + 1):
            values = [objective(x + s * e[i] + t * e[j]) for s, t in ((1, 1), (1, -1), (-1, 1), (-1, -1))]
            H[i, j] = H[j, i] = (values[0] - values[1] - values[2] + values[3]) / (4.0 * STEP**2)
    return H


def _scores(rows: Rows, full: Callable[[Array], Array], x: Array, beta: Array, length: float) -> Array:
    """Derivative of each track's log-likelihood by each parameter, (K, k), with the bias held."""
    y = (rows.r - rows.X @ beta)[:, None]

    def by_track(values: Array) -> Array:
        white = whiten_rows(rows, y, Parameters.of(full(values), length))
        assert white is not None
        return -0.5 * (white.log_variance + np.add.reduceat(white.values[:, 0] ** 2, rows.first))

    columns = [(by_track(x + d) - by_track(x - d)) / (2.0 * STEP) for d in STEP * np.eye(len(x))]
    scores = np.column_stack(columns)
    return np.asarray(scores - scores.mean(axis=0))
