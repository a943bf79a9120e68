"""Estimates of one coordinate, u, v or d, each with its interval.

The shape of its noise, too: how heavy its tails are, and whether it is Gaussian at all.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import optimize, special, stats

from consistency.referee.diagnostics.statistics.nees import binomial_interval
from consistency.referee.diagnostics.statistics.normality import normality
from consistency.referee.diagnostics.verdict.parts import Interval
from consistency.referee.types import Array
from consistency.stereo.characterising.likelihood import LikelihoodFit

LAGS = 10  # of the autocorrelation that is shown
FEWEST_PAIRS = 20  # of rows, from which a lag is told
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
        def negative(log_scale: float) -> float:
            return _negative(w, weight, log_scale)

        return 2.0 * optimize.minimize_scalar(negative, bounds=(-1.5, 0.5), method="bounded").fun

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
