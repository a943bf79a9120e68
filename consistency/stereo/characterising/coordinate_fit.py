"""Estimates of one coordinate, u, v or d, with intervals, by a restricted likelihood.

The likelihood has a bias, an offset of each track, and noise with memory. Another question is the shape of the noise:
how heavy its tails are, and whether it is Gaussian at all.

Residual i of track t is ``X_i beta + o_t + e_i``: ``o_t`` is drawn once per track with variance tau^2, ``e_i`` in each
observation with standard deviation ``G_i a`` and correlation rho^gap with the one before. Patterson & Thompson (1971)
maximise the likelihood of what the regression leaves, so that the degrees of freedom that it costs are paid for.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np
from scipy import optimize, special, stats

from consistency.referee.diagnostics.distributions import normality
from consistency.referee.diagnostics.nees import binomial_interval
from consistency.referee.diagnostics.verdict_parts import Interval
from consistency.referee.types import Array, Indices

LAGS = 10  # of the autocorrelation that is shown
FEWEST_PAIRS = 20  # of rows, from which a lag is told
HEAVIEST = 0.49  # 1 / nu: at 1/2 the variance is infinite
ROUNDS = 500  # of expectation and maximisation at most
FEWEST = 100  # rows at rest, and moving, that are compared
STEP = 1e-3  # of a parameter, for second differences; log sigma, atanh rho and log(1 + n q) are all of order 1
MOST = 0.995  # magnitude of a correlation
IMPOSSIBLE = 1e12
UNDETERMINED = "the data do not determine the noise"
GENTLE = 1e-3  # of the rows: slope at which the first search ends
STEPS = 30
NEAR = 1e-6  # squared distance to the top, in standard deviations


@dataclass(frozen=True)
class Levels:
    """How one rate of error is shared out: equally over groups of parameters, and inside a group over its members.

    Bonferroni's inequality makes all intervals hold together with probability ``1 - rate`` at least, however their
    errors depend on each other.
    """

    rate: float  # that any interval misses
    sigma: int = 3
    growth: int = 1
    bias: int = 1
    correlation: int = 3
    offset: int = 3
    tails: int = 4

    def of(self, group: str) -> float:
        """Probability that one member of a group is missed."""
        return self.rate / (6 * max(int(getattr(self, group)), 1))


def wider(gaussian: Array, any_noise: Array, tracks: int, level: float) -> Array:
    """Half width of an interval from two standard errors: the wider of those for Gaussian and for any noise.

    The second rests on the scatter of ``tracks`` tracks, so that it has Student's distribution.
    """
    student = stats.t.isf(level / 2, max(tracks - 1, 1))
    return np.maximum(gaussian * stats.norm.isf(level / 2), any_noise * student)


def interval_on_scale(scale: Callable[[float], float], middle: float, half: float) -> Interval:
    """The interval whose value and ends are ``scale`` of ``middle`` and of ``middle`` less and plus ``half``."""
    return Interval(float(scale(middle)), float(scale(middle - half)), float(scale(middle + half)))


def half_width(gradient: Array, fit: LikelihoodFit, level: float) -> float:
    """Half of an interval of ``gradient' theta``."""
    gaussian = np.sqrt(np.maximum(gradient @ fit.cov @ gradient, 0.0))
    any_noise = np.sqrt(np.maximum(gradient @ fit.robust @ gradient, 0.0))
    return float(wider(gaussian, any_noise, fit.tracks, level))


def parameter_half_width(k: int, fit: LikelihoodFit, level: float) -> float:
    """Half of an interval of parameter ``k``."""
    return half_width(np.eye(len(fit.theta))[k], fit, level)


def noise_interval(fit: LikelihoodFit, level: float) -> Interval:
    """Standard deviation of what is drawn again, in the root mean square over the rows, px."""
    a = fit.parameters.a
    G = fit.rows.G
    sd = G @ a
    mean_square = np.mean(sd**2)
    by_a = (sd[:, None] * G).mean(axis=0) * a / mean_square
    gradient = np.append(by_a, [0.0, 0.0])
    return interval_on_scale(np.exp, 0.5 * np.log(mean_square), half_width(gradient, fit, level))


def at_nodes(fit: LikelihoodFit, level: float) -> list[Interval]:
    """Standard deviation at each node of disparity, px."""
    intervals = []
    for j in range(len(fit.parameters.a)):
        half = parameter_half_width(j, fit, level)
        intervals.append(interval_on_scale(np.exp, fit.theta[j], half))
    return intervals


def growth_p_value(fit: LikelihoodFit) -> float:
    """Chance of such differences between the nodes if the noise does not depend on disparity (Wald's test)."""
    m = len(fit.parameters.a)
    if m < 2:
        return 1.0
    contrast = np.eye(m)[1:] - np.eye(m)[:1]
    gap = contrast @ fit.theta[:m]
    values = []
    for C in (fit.cov, fit.robust):
        S = contrast @ C[:m, :m] @ contrast.T
        values.append(float(stats.chi2.sf(gap @ np.linalg.solve(S, gap), m - 1)))
    return max(values)


def correlation(fit: LikelihoodFit, level: float) -> Interval:
    """Correlation of the noise with that of the step before."""
    m = len(fit.parameters.a)
    return interval_on_scale(np.tanh, fit.theta[m], parameter_half_width(m, fit, level))


def offset_share(fit: LikelihoodFit, level: float) -> Interval:
    """Share of the offsets of tracks in the variance about the bias map; an interval ends at 0."""
    length = max(fit.rows.length, 1.0)

    def share(parameter: float) -> float:
        q = max(np.expm1(parameter) / length, 0.0)
        return q / (1.0 + q)

    return interval_on_scale(share, fit.theta[-1], parameter_half_width(-1, fit, level))


def bias_coefficients(fit: LikelihoodFit, level: float) -> tuple[Array, Array, Array]:
    """Coefficients (p,) of the bias, half widths (p,) of their intervals, and their covariance (p, p), px."""
    of = fit.regression
    scores = np.add.reduceat(of.X * of.residual[:, None], fit.rows.first, axis=0)
    K = fit.tracks
    robust = of.cov @ (scores.T @ scores) @ of.cov * K / max(K - 1, 1)
    gaussian = np.sqrt(np.diag(of.cov))
    any_noise = np.sqrt(np.maximum(np.diag(robust), 0.0))
    factor = np.maximum(any_noise / gaussian, 1.0)
    half = wider(gaussian, any_noise, K, level)
    return of.beta, half, of.cov * np.outer(factor, factor)


def autocorrelation(fit: LikelihoodFit) -> tuple[Array, Array]:
    """Correlation (lags,) along tracks about the bias map and the offsets, and its 95 % bound (lags,) if white.

    Products of neighbours are pooled over all tracks. Offsets take part of any correlation away; where a track has n
    rows that is about 1 / n, and is given back.
    """
    rows = fit.rows
    track = rows.track
    e = (rows.r - rows.X @ fit.regression.beta) / (rows.G @ fit.parameters.a)
    n = np.bincount(track)
    e -= (np.add.reduceat(e, rows.first) / n)[track]
    variance = (e**2).sum() / max(len(e) - len(n), 1)
    place = np.cumsum(rows.gap)
    values = np.full(LAGS, np.nan)
    bounds = np.full(LAGS, np.nan)
    for lag in range(1, LAGS + 1):
        same_track = track[lag:] == track[:-lag]
        in_step = place[lag:] - place[:-lag] == lag
        before = np.flatnonzero(same_track & in_step)
        if len(before) < FEWEST_PAIRS:
            break
        given_back = (1.0 / n[track[before]]).mean()
        values[lag - 1] = (e[before + lag] * e[before]).mean() / variance + given_back
        bounds[lag - 1] = 1.96 / np.sqrt(len(before))
    return values, bounds


class Mixture(NamedTuple):
    """Two normal distributions about zero."""

    share: float  # of the wide one
    core: float  # standard deviation of the narrow one, over that of both together
    wide: float  # standard deviation of the wide one, likewise


class ResidualTails(NamedTuple):
    """Shape of standardised residuals."""

    weight: Interval  # 1 / nu of Student's distribution; 0 is the normal one
    skewness: float
    excess_kurtosis: float
    p_value: float  # of normality, D'Agostino & Pearson (1973)
    mixture: Mixture | None = None  # where it describes heavy tails better than Student's distribution


def tails(w: Array, level: float) -> ResidualTails:
    """Student's degrees of freedom by the likelihood of residuals (N,), its interval by the ratio of likelihoods.

    ``level`` is the probability that the interval misses.
    """
    w = (w - w.mean()) / w.std(ddof=1)

    def deviance(weight: float) -> float:
        return 2.0 * optimize.minimize_scalar(partial(_negative, w, weight), bounds=(-1.5, 0.5), method="bounded").fun

    best = optimize.minimize_scalar(deviance, bounds=(0.0, HEAVIEST), method="bounded", options={"xatol": 1e-5})
    value = float(best.x)
    least = float(best.fun)
    if deviance(0.0) <= least:
        value = 0.0
        least = deviance(0.0)
    limit = least + stats.chi2.isf(level, 1)

    def beyond(weight: float) -> float:
        return deviance(weight) - limit

    low = 0.0
    if beyond(0.0) > 0:
        low = optimize.brentq(beyond, 0.0, value)
    high = HEAVIEST
    if beyond(HEAVIEST) > 0:
        high = optimize.brentq(beyond, value, HEAVIEST)
    shape = normality(w)
    better = None
    if low > 0:
        mixture, negative = two_normals(w)
        # one parameter more than Student's: by the information criterion of Schwarz (1978)
        if 2.0 * negative + np.log(len(w)) < least:
            better = mixture
    return ResidualTails(Interval(value, low, high), shape.skewness, shape.excess_kurtosis, shape.p_value, better)


def two_normals(w: Array) -> tuple[Mixture, float]:
    """The mixture of largest likelihood for residuals (N,), by expectation and maximisation, and its negative log."""
    share = 0.05
    core = 0.9
    wide = 2.5
    for _ in range(ROUNDS):
        narrow = (1.0 - share) * _normal(w, core)
        broad = share * _normal(w, wide)
        of_wide = broad / (narrow + broad)
        core = _weighted_sd(w, 1.0 - of_wide)
        wide = _weighted_sd(w, of_wide)
        before = share
        share = of_wide.mean()
        if abs(share - before) < 1e-7:
            break
    total = (1.0 - share) * _normal(w, core) + share * _normal(w, wide)
    return Mixture(share, core, wide), -np.log(total).sum()


def _weighted_sd(w: Array, weight: Array) -> float:
    """Standard deviation about zero."""
    return np.sqrt((weight * w**2).sum() / max(weight.sum(), 1e-9))


def _normal(w: Array, sd: float) -> Array:
    return np.exp(-0.5 * (w / sd) ** 2) / (sd * np.sqrt(2.0 * np.pi))


def _negative(w: Array, weight: float, log_scale: float) -> float:
    """Negative log-likelihood of Student's distribution with 1 / weight degrees of freedom and a scale."""
    x2 = np.exp(-2.0 * log_scale) * w**2
    if weight < 1e-4:
        return 0.5 * x2.sum() + len(w) * (log_scale + 0.5 * np.log(2.0 * np.pi))
    nu = 1.0 / weight
    constant = special.gammaln((nu + 1.0) / 2.0) - special.gammaln(nu / 2.0)
    constant -= 0.5 * np.log(nu * np.pi)
    return 0.5 * (nu + 1.0) * np.log1p(x2 / nu).sum() + len(w) * (log_scale - constant)


def rate(count: int, total: int, level: float) -> Interval:
    """A share with the interval of Clopper & Pearson (1934)."""
    low, high = binomial_interval(count, total, 1.0 - level)
    return Interval(count / total, float(low), float(high))


def moving_over_rest(
    w: Array,
    weight: Array,
    moving: Array,
    track: Array,
    level: float,
) -> tuple[Interval, ...]:
    """Noise while moving over noise at rest, of u, v, d; nothing where one of the two has too few data.

    Parameters
    ----------
    w : (N, 3), standardised residuals
    weight : (N, 3), degrees of freedom of each
    moving : (N,) of bool
    track : (N,)
    level : probability that one interval misses
    """
    if min(moving.sum(), (~moving).sum()) < FEWEST:
        return ()
    ratios = []
    for k in range(3):
        log_moving, variance_moving = _log_sd(w[moving, k], weight[moving, k], track[moving])
        log_rest, variance_rest = _log_sd(w[~moving, k], weight[~moving, k], track[~moving])
        half = np.sqrt(variance_moving + variance_rest) * stats.norm.isf(level / 2)
        ratios.append(interval_on_scale(np.exp, log_moving - log_rest, half))
    return tuple(ratios)


def _log_sd(w: Array, weight: Array, track: Array) -> tuple[float, float]:
    """Log of a standard deviation, and its variance by the scatter of the tracks, or by chi-square if that is more."""
    dof = weight.sum()
    mean = (weight * w**2).sum() / dof
    _, where = np.unique(track, return_inverse=True)
    of_tracks = np.bincount(where, weight * (w**2 / mean - 1.0))
    variance = max((of_tracks**2).sum() / dof**2, 2.0 / dof)
    return 0.5 * np.log(mean), 0.25 * variance


@dataclass(frozen=True)
class Rows:
    """N residuals of one coordinate, sorted by track and step; K tracks."""

    r: Array  # (N,), px
    X: Array  # (N, p), regressors of the bias
    G: Array  # (N, m), weights of the standard deviations at the nodes of disparity
    first: Indices  # (K,), first row of each track
    gap: Indices  # (N,), steps since the row before in the track, 0 in the first
    ridge: Array  # (p,), 1 / variance of a prior about 0 of each coefficient, mostly 0

    @cached_property
    def length(self) -> float:
        """Rows of a track that its offset is averaged over, the mean that an analysis of variance has."""
        n = np.bincount(self.track)
        return (len(self.r) - (n**2).sum() / len(self.r)) / max(len(n) - 1, 1)

    @cached_property
    def track(self) -> Indices:
        """Number of the track of each row, (N,)."""
        return np.repeat(np.arange(len(self.first)), np.diff(self.first, append=len(self.r)))


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
    decay = p.rho ** np.arange(rows.gap.max() + 1.0)  # over each gap: to look up is faster
    decay[0] = 0.0
    left = 1.0 - decay**2
    x[1:] -= decay[rows.gap[1:], None] * x[:-1]
    x /= np.sqrt(left)[rows.gap, None]
    one = x[:, -1:] * root
    size = np.add.reduceat(one[:, 0] ** 2, rows.first)
    energy = np.sign(p.ratio) * size
    if (energy <= -1.0).any():
        return None
    of_rows = 2.0 * np.log(sd) + np.log(left)[rows.gap]
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
