"""Estimates of one coordinate, u, v or d, each with its interval.

The shape of its noise, too: how heavy its tails are, and whether it is Gaussian at all.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import optimize, special, stats

from consistency.referee.diagnostics.statistics.nees import binomial_interval
from consistency.referee.diagnostics.statistics.normality import normality
from consistency.referee.diagnostics.verdict.parts import Interval
from consistency.referee.types import Array
from consistency.stereo.characterising.likelihood import LikelihoodFit

LAGS = 10  # of the autocorrelation that is shown
HEAVIEST = 0.49  # 1 / nu: at 1/2 the variance is infinite
ROUNDS = 500  # of expectation and maximisation at most
FEWEST = 100  # rows at rest, and moving, that are compared


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


def half_width(gradient: Array, fit: LikelihoodFit, level: float) -> float:
    """Half of an interval of ``gradient' theta``: the wider of the one for Gaussian noise and the one for any noise."""
    model, robust = (np.sqrt(max(float(gradient @ C @ gradient), 0.0)) for C in (fit.cov, fit.robust))
    dof = max(fit.tracks - 1, 1)
    return float(max(model * stats.norm.isf(level / 2), robust * stats.t.isf(level / 2, dof)))


def noise_interval(fit: LikelihoodFit, level: float) -> Interval:
    """Standard deviation of what is drawn again, in the root mean square over the rows, px."""
    log_sigma, gradient = log_level(fit)
    return _exponential(log_sigma, half_width(gradient, fit, level))


def log_level(fit: LikelihoodFit) -> tuple[float, Array]:
    """Log of the root mean square of the standard deviations, and its gradient by theta (m + 2,)."""
    a, G = fit.parameters.a, fit.rows.G
    sd = G @ a
    gradient = np.append((sd[:, None] * G).mean(axis=0) * a / np.mean(sd**2), [0.0, 0.0])
    return float(0.5 * np.log(np.mean(sd**2))), gradient


def at_nodes(fit: LikelihoodFit, level: float) -> list[Interval]:
    """Standard deviation at each node of disparity, px."""
    m = len(fit.theta) - 2
    return [_exponential(float(fit.theta[j]), half_width(np.eye(m + 2)[j], fit, level)) for j in range(m)]


def growth_p_value(fit: LikelihoodFit) -> float:
    """Chance of such differences between the nodes if the noise does not depend on disparity (Wald's test)."""
    m = len(fit.theta) - 2
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
    m = len(fit.theta) - 2
    middle, half = float(fit.theta[m]), half_width(np.eye(m + 2)[m], fit, level)
    return Interval(float(np.tanh(middle)), float(np.tanh(middle - half)), float(np.tanh(middle + half)))


def offset_share(fit: LikelihoodFit, level: float) -> Interval:
    """Share of the offsets of tracks in the variance about the bias map; an interval ends at 0."""
    m, n = len(fit.theta) - 2, max(fit.rows.length, 1.0)
    middle, half = float(fit.theta[-1]), half_width(np.eye(m + 2)[-1], fit, level)
    q = np.maximum(np.expm1(np.array([middle, middle - half, middle + half])) / n, 0.0)
    value, low, high = q / (1.0 + q)
    return Interval(float(value), float(low), float(high))


def bias_coefficients(fit: LikelihoodFit, level: float) -> tuple[Array, Array, Array]:
    """Coefficients (p,) of the bias, half widths (p,) of their intervals, and their covariance (p, p), px."""
    of = fit.regression
    scores = np.add.reduceat(of.X * of.residual[:, None], fit.rows.first, axis=0)
    K = fit.tracks
    robust = of.cov @ (scores.T @ scores) @ of.cov * K / max(K - 1, 1)
    model, any_noise = np.sqrt(np.diag(of.cov)), np.sqrt(np.maximum(np.diag(robust), 0.0))
    half = np.maximum(model * stats.norm.isf(level / 2), any_noise * stats.t.isf(level / 2, max(K - 1, 1)))
    wider = np.maximum(any_noise / model, 1.0)
    return of.beta, half, of.cov * wider[:, None] * wider[None, :]


def autocorrelation(fit: LikelihoodFit) -> tuple[Array, Array]:
    """Correlation (lags,) along tracks about the bias map and the offsets, and its 95 % bound (lags,) if white.

    Products of neighbours are pooled over all tracks. Offsets take part of any correlation away; where a track has n
    rows that is about 1 / n, and is given back.
    """
    rows, beta = fit.rows, fit.regression.beta
    e = (rows.r - rows.X @ beta) / (rows.G @ fit.parameters.a)
    n = np.diff(np.append(rows.first, len(e)))
    e = e - (np.add.reduceat(e, rows.first) / n)[rows.track]
    place, track = np.cumsum(np.where(rows.gap > 0, rows.gap, 0.0)), rows.track
    variance = float((e**2).sum() / max(len(e) - len(n), 1))
    values, bounds = np.full(LAGS, np.nan), np.full(LAGS, np.nan)
    for lag in range(1, LAGS + 1):
        later = np.arange(lag, len(e))
        pair = later[(track[lag:] == track[:-lag]) & (place[lag:] - place[:-lag] == lag)]
        if len(pair) < 20:
            break
        given_back = float((1.0 / n[track[pair]]).mean())
        values[lag - 1] = float((e[pair] * e[pair - lag]).mean()) / variance + given_back
        bounds[lag - 1] = 1.96 / np.sqrt(len(pair))
    return values, bounds


def _exponential(middle: float, half: float) -> Interval:
    return Interval(float(np.exp(middle)), float(np.exp(middle - half)), float(np.exp(middle + half)))


@dataclass(frozen=True)
class ResidualTails:
    """Shape of standardised residuals."""

    weight: Interval  # 1 / nu of Student's distribution; 0 is the normal one
    skewness: float
    excess_kurtosis: float
    p_value: float  # of normality, D'Agostino & Pearson (1973)
    mixture: Mixture | None = None  # where it describes heavy tails better than Student's distribution


@dataclass(frozen=True)
class Mixture:
    """Two normal distributions about zero."""

    share: float  # of the wide one
    core: float  # standard deviation of the narrow one, over that of both together
    wide: float  # standard deviation of the wide one, likewise


def tails(w: Array, level: float) -> ResidualTails:
    """Student's degrees of freedom by the likelihood of residuals (N,), its interval by the ratio of likelihoods.

    ``level`` is the probability that the interval misses.
    """
    w = (w - w.mean()) / w.std(ddof=1)

    def deviance(weight: float) -> float:
        return (
            2.0
            * optimize.minimize_scalar(
                lambda log_scale: _negative(w, weight, float(log_scale)), bounds=(-1.5, 0.5), method="bounded"
            ).fun
        )

    best = optimize.minimize_scalar(deviance, bounds=(0.0, HEAVIEST), method="bounded", options={"xatol": 1e-5})
    value, least = (0.0, deviance(0.0)) if deviance(0.0) <= best.fun else (float(best.x), float(best.fun))
    limit = least + float(stats.chi2.isf(level, 1))

    def beyond(weight: float) -> float:
        return deviance(weight) - limit

    low = 0.0 if beyond(0.0) <= 0 else float(optimize.brentq(beyond, 0.0, value))
    high = HEAVIEST if beyond(HEAVIEST) <= 0 else float(optimize.brentq(beyond, value, HEAVIEST))
    shape = normality(w)
    mixture, fitted = two_normals(w) if low > 0 else (None, np.inf)
    # one parameter more than Student's: by the information criterion of Schwarz (1978)
    better = mixture if 2.0 * fitted + np.log(len(w)) < least else None
    return ResidualTails(Interval(value, low, high), shape.skewness, shape.excess_kurtosis, shape.p_value, better)


def two_normals(w: Array) -> tuple[Mixture, float]:
    """The mixture of largest likelihood for residuals (N,), by expectation and maximisation, and its negative log."""
    share, core, wide = 0.05, 0.9, 2.5
    for _ in range(ROUNDS):
        narrow, broad = (1.0 - share) * _normal(w, core), share * _normal(w, wide)
        of_wide = broad / (narrow + broad)
        before, share = share, float(of_wide.mean())
        core, wide = (float(np.sqrt((p * w**2).sum() / max(p.sum(), 1e-9))) for p in (1.0 - of_wide, of_wide))
        if abs(share - before) < 1e-7:
            break
    total = (1.0 - share) * _normal(w, core) + share * _normal(w, wide)
    return Mixture(share, core, wide), float(-np.log(total).sum())


def _normal(w: Array, sd: float) -> Array:
    return np.asarray(np.exp(-0.5 * (w / sd) ** 2) / (sd * np.sqrt(2.0 * np.pi)))


def _negative(w: Array, weight: float, log_scale: float) -> float:
    """Negative log-likelihood of Student's distribution with 1 / weight degrees of freedom and a scale."""
    x2 = np.exp(-2.0 * log_scale) * w**2
    if weight < 1e-4:
        return float(0.5 * x2.sum() + len(w) * (log_scale + 0.5 * np.log(2.0 * np.pi)))
    nu = 1.0 / weight
    constant = special.gammaln((nu + 1.0) / 2.0) - special.gammaln(nu / 2.0) - 0.5 * np.log(nu * np.pi)
    return float(0.5 * (nu + 1.0) * np.log1p(x2 / nu).sum() + len(w) * (log_scale - constant))


def rate(count: int, total: int, level: float) -> Interval:
    """A share with the interval of Clopper & Pearson (1934)."""
    low, high = binomial_interval(count, total, 1.0 - level)
    return Interval(count / total, float(low), float(high))


def moving_over_rest(w: Array, weight: Array, moving: Array, track: Array, level: float) -> tuple[Interval, ...]:
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
    out = []
    for k in range(3):
        logs, variance = [], 0.0
        for part in (moving, ~moving):
            x, dof = w[part, k] ** 2, weight[part, k]
            mean = float((dof * x).sum() / dof.sum())
            _, where = np.unique(track[part], return_inverse=True)
            spread = np.bincount(where, dof * (x / mean - 1.0))
            logs.append(0.5 * np.log(mean))
            variance += 0.25 * max(float((spread**2).sum()) / dof.sum() ** 2, 2.0 / dof.sum())
        half = float(np.sqrt(variance) * stats.norm.isf(level / 2))
        value = logs[0] - logs[1]
        out.append(Interval(float(np.exp(value)), float(np.exp(value - half)), float(np.exp(value + half))))
    return tuple(out)
