"""Restricted likelihood of one coordinate: bias as regression, an offset of each track, noise with memory.

Residual i of track t is ``X_i beta + o_t + e_i``: ``o_t`` is drawn once per track with variance tau^2, ``e_i`` in each
observation with standard deviation ``G_i a`` and correlation rho^gap with the one before. Patterson & Thompson (1971)
maximise the likelihood of what the regression leaves, so that the degrees of freedom that it costs are paid for.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import optimize

from consistency.referee.types import Array, Indices

STEP = 1e-3  # of a parameter, for second differences; log sigma, atanh rho and log(1 + n q) are all of order 1
MOST = 0.995  # magnitude of a correlation
IMPOSSIBLE = 1e12
UNDETERMINED = "the data do not determine the noise"
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
        n = np.bincount(self.track)
        return (len(self.r) - (n**2).sum() / len(self.r)) / max(len(n) - 1, 1)

    @property
    def track(self) -> Indices:
        """Number of the track of each row, (N,)."""
        return np.searchsorted(self.first, np.arange(len(self.r)), side="right") - 1


class Parameters(NamedTuple):
    """Noise of one coordinate."""

    a: Array  # (m,), px, standard deviation of the noise at the nodes
    rho: float
    ratio: float  # q: variance of the offsets over that of the noise; may be a little below 0


class Whitened(NamedTuple):
    """Rows freed of their correlation, and what that costs in each track."""

    values: Array  # (N, columns)
    log_variance: Array  # (K,), log det of the covariance of each track


def whiten_rows(rows: Rows, columns: Array, p: Parameters) -> Whitened | None:
    """Columns (N, c) times the inverse root of the covariance; None where that is not positive definite."""
    sd = rows.G @ p.a
    if abs(p.rho) > MOST or not (sd > 0).all():
        return None
    root = np.sqrt(np.mean(sd**2) * abs(p.ratio))
    x = np.column_stack([columns, np.ones(len(sd))]) / sd[:, None]
    decay = np.where(rows.gap > 0, p.rho ** np.maximum(rows.gap, 1), 0.0)
    left = 1.0 - decay**2
    x[1:] -= decay[1:, None] * x[:-1]
    x /= np.sqrt(left)[:, None]
    one = x[:, -1:] * root
    size = np.add.reduceat(one[:, 0] ** 2, rows.first)
    energy = np.sign(p.ratio) * size
    if (energy <= -1.0).any():
        return None
    of_rows = 2.0 * np.log(sd) + np.log(left)
    log_variance = np.add.reduceat(of_rows, rows.first) + np.log1p(energy)
    x = x[:, :-1]
    if root > 0.0:  # (I - k c c')^2 is the inverse of I + s c c'
        k = (1.0 - 1.0 / np.sqrt(1.0 + energy)) / np.maximum(size, 1e-300)
        along = np.add.reduceat(one * x, rows.first, axis=0) * k[:, None]
        x -= one * along[rows.track]
    return Whitened(x, log_variance)


class Regression(NamedTuple):
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
    y = white.values[:, 0]
    X = white.values[:, 1:]
    normal = X.T @ X + np.diag(rows.ridge)
    try:
        factor = np.linalg.cholesky(normal)
    except np.linalg.LinAlgError:
        return None
    beta = np.linalg.solve(normal, X.T @ y)
    e = y - X @ beta
    log_det = white.log_variance.sum() + 2.0 * np.log(np.diag(factor)).sum()
    value = -0.5 * (log_det + e @ e + rows.ridge @ beta**2)
    return Regression(beta, np.linalg.inv(normal), e, X, value)


class LikelihoodFit(NamedTuple):
    """The largest restricted likelihood and what is known of its place."""

    rows: Rows
    theta: Array  # (m + 2,)
    cov: Array  # (m + 2, m + 2), of theta by the curvature: right for Gaussian noise
    robust: Array  # (m + 2, m + 2), of theta by the scatter of the tracks' scores: right for any noise
    regression: Regression
    parameters: Parameters
    memory: bool  # whether offset and correlation were estimated

    @property
    def tracks(self) -> int:
        return len(self.rows.first)


class Likelihood(NamedTuple):
    """Likelihood of rows over log a, atanh rho and log(1 + n q), on which estimates are nearly Gaussian."""

    rows: Rows
    memory: bool  # whether atanh rho and log(1 + n q) are parameters; if not, rho and q are 0

    def parameters(self, x: Array) -> Parameters:
        """The noise that ``x`` (k,) stands for."""
        nodes = self.rows.G.shape[1]
        if not self.memory:
            return Parameters(np.exp(x), 0.0, 0.0)
        rho = float(np.tanh(x[nodes]))
        ratio = float(np.expm1(x[nodes + 1])) / max(self.rows.length, 1.0)
        return Parameters(np.exp(x[:nodes]), rho, ratio)

    def restricted(self, x: Array) -> float:
        """Negative restricted log-likelihood."""
        found = regress(self.rows, self.parameters(x))
        if found is None:
            return IMPOSSIBLE
        return -found.value

    def with_bias_held(self, x: Array, r: Array) -> float:
        """Negative log-likelihood of residuals (N, 1) about a bias that is held, which costs much less."""
        white = whiten_rows(self.rows, r, self.parameters(x))
        if white is None:
            return IMPOSSIBLE
        return 0.5 * (white.log_variance.sum() + (white.values**2).sum())

    def of_tracks(self, x: Array, r: Array) -> Array:
        """Log-likelihood (K,) of the residuals (N, 1) of each track, likewise."""
        white = whiten_rows(self.rows, r, self.parameters(x))
        assert white is not None
        squares = np.add.reduceat(white.values[:, 0] ** 2, self.rows.first)
        return -0.5 * (white.log_variance + squares)


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
    likelihood = Likelihood(rows, memory)
    nodes = rows.G.shape[1]
    x = np.full(nodes, np.log(start))
    if memory:
        x = np.append(x, [0.0, 0.0])
    normal = rows.X.T @ rows.X + np.diag(rows.ridge + 1e-9)
    about_plain = (rows.r - rows.X @ np.linalg.solve(normal, rows.X.T @ rows.r))[:, None]
    first = optimize.minimize(
        likelihood.with_bias_held,
        x,
        args=(about_plain,),
        method="BFGS",
        options={"gtol": GENTLE * len(rows.r)},
    )
    x, H = _climb(likelihood, first.x)
    regression = regress(rows, likelihood.parameters(x))
    if regression is None:
        raise ValueError(UNDETERMINED)
    inverse = np.linalg.inv(H)
    scores = _scores(likelihood, x, regression.beta)
    K = len(scores)
    robust = inverse @ (scores.T @ scores) @ inverse * K / max(K - 1, 1)
    missing = nodes + 2 - len(x)
    return LikelihoodFit(
        rows,
        theta=np.pad(x, (0, missing)),
        cov=np.pad(inverse, (0, missing)),
        robust=np.pad(robust, (0, missing)),
        regression=regression,
        parameters=likelihood.parameters(x),
        memory=memory,
    )


def _climb(likelihood: Likelihood, x: Array) -> tuple[Array, Array]:
    """Newton's steps to the largest restricted likelihood, and the curvature there.

    The curvature is that with the bias held: its residuals have lost already the degrees of freedom that it costs.
    """
    rows = likelihood.rows
    for _ in range(STEPS):
        found = regress(rows, likelihood.parameters(x))
        if found is None:
            raise ValueError(UNDETERMINED)
        H = _curvature(likelihood, x, found.beta)
        if not np.isfinite(H).all() or np.linalg.eigvalsh(H)[0] <= 0:
            raise ValueError(UNDETERMINED)
        slope = np.empty(len(x))
        for i, d in enumerate(STEP * np.eye(len(x))):
            up = likelihood.restricted(x + d)
            down = likelihood.restricted(x - d)
            slope[i] = (up - down) / (2.0 * STEP)
        step = -np.linalg.solve(H, slope)
        if slope @ -step < NEAR:
            return x, H
        size = 1.0
        while likelihood.restricted(x + size * step) > -found.value and size > 1e-3:
            size *= 0.5
        x = x + size * step
    return x, H


def _curvature(likelihood: Likelihood, x: Array, beta: Array) -> Array:
    """Second derivatives (k, k) of the negative log-likelihood, by central differences."""
    r = (likelihood.rows.r - likelihood.rows.X @ beta)[:, None]
    e = STEP * np.eye(len(x))
    H = np.empty((len(x), len(x)))
    for i, j in zip(*np.tril_indices(len(x)), strict=True):
        both_up = likelihood.with_bias_held(x + e[i] + e[j], r)
        one_up = likelihood.with_bias_held(x + e[i] - e[j], r)
        other_up = likelihood.with_bias_held(x - e[i] + e[j], r)
        both_down = likelihood.with_bias_held(x - e[i] - e[j], r)
        H[i, j] = (both_up - one_up - other_up + both_down) / (4.0 * STEP**2)
        H[j, i] = H[i, j]
    return H


def _scores(likelihood: Likelihood, x: Array, beta: Array) -> Array:
    """Derivative of each track's log-likelihood by each parameter, (K, k), with the bias held."""
    rows = likelihood.rows
    r = (rows.r - rows.X @ beta)[:, None]
    scores = np.empty((len(rows.first), len(x)))
    for i, d in enumerate(STEP * np.eye(len(x))):
        up = likelihood.of_tracks(x + d, r)
        down = likelihood.of_tracks(x - d, r)
        scores[:, i] = (up - down) / (2.0 * STEP)
    return scores - scores.mean(axis=0)
