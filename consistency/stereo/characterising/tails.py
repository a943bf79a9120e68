"""The shape of a noise: how heavy its tails are, and whether it is Gaussian at all."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import optimize, special, stats

from consistency.referee.diagnostics.statistics.nees import binomial_interval
from consistency.referee.diagnostics.statistics.normality import normality
from consistency.referee.diagnostics.verdict.parts import Interval
from consistency.referee.types import Array

HEAVIEST = 0.49  # 1 / nu: at 1/2 the variance is infinite
ROUNDS = 500  # of expectation and maximisation at most
FEWEST = 100  # rows at rest, and moving, that are compared


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

    ``level`` is the chance that the interval misses.
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


def ratios(w: Array, weight: Array, moving: Array, track: Array, level: float) -> tuple[Interval, ...]:
    """Noise while moving over noise at rest, of u, v, d; nothing where one of the two has too few data.

    Parameters
    ----------
    w : (N, 3), standardised residuals
    weight : (N, 3), degrees of freedom of each
    moving : (N,) of bool
    track : (N,)
    level : chance that one interval misses
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
