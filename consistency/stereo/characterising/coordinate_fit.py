"""Estimates of one coordinate, u, v or d, each with its interval."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

from consistency.referee.diagnostics.verdict.parts import Interval
from consistency.referee.types import Array
from consistency.stereo.characterising.likelihood import LikelihoodFit

LAGS = 10  # of the autocorrelation that is shown


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
        """Chance that one member of a group is missed."""
        return self.rate / (6 * max(int(getattr(self, group)), 1))


def half_width(gradient: Array, fit: LikelihoodFit, level: float) -> float:
    """Half of an interval of ``gradient' theta``: the wider of the one for Gaussian noise and the one for any noise."""
    model, robust = (np.sqrt(max(float(gradient @ C @ gradient), 0.0)) for C in (fit.cov, fit.robust))
    dof = max(fit.tracks - 1, 1)
    return float(max(model * stats.norm.isf(level / 2), robust * stats.t.isf(level / 2, dof)))


def noise(fit: LikelihoodFit, level: float) -> Interval:
    """Standard deviation of what is drawn anew, in the root mean square over the rows, px."""
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


def bias(fit: LikelihoodFit, level: float) -> tuple[Array, Array, Array]:
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
