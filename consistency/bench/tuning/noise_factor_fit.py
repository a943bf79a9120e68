"""The setting of greatest score, and how well it is known. Knows no filter: scores in, factors out.

Intervals of log factors are those of the profile of a score that need not be a true likelihood.

Let d_r be the fall of unit r from the best setting to another one, W = 2 sum d_r, and V the variance of sum d_r by the
scatter of its n terms. To first order W is lambda times a chi-square number of one degree of freedom, with lambda =
(H^-1 J H^-1)_ii / (H^-1)_ii, H the curvature of the score and J the spread of its slopes (Kent 1982, Biometrika 69(1)),
and V / W tends to lambda, for both grow as the square of the distance. A setting is outside if W exceeds the quantile
of chi-square, which would do if the likelihood were true, and W / (V / W) the square of Student's. An interval reaches
as far as any setting that is not outside.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from scipy import stats
from scipy.optimize import NonlinearConstraint, minimize

from consistency.referee.defaults import CONFIDENCE
from consistency.referee.types import Array

LIMIT = float(np.log(1e4))  # factors that are tried lie within 1e-4 and 1e4
RADII = 0.7, 0.01  # of the trust region in log factors: a factor of 2 at first, 1 % at the end
MOST_SETTINGS = 150  # of a search, which takes some 30 for two factors
STEP = 0.05  # in log factors, for differences
UNITS = 20  # independent parts that an interval needs at least; fewer runs are cut into blocks of steps
WEAK = 1.0  # least curvature: a log factor is then known to a standard deviation of a factor of e
LARGEST_STEP = 1.0  # of a log factor, in which a quadratic model of the score is believed
END_RADII = 0.3, 0.02  # of the trust region, first and last, in half widths of the intervals
END_SETTINGS = 60  # at most for one end of an interval; some 15 do
AT_LIMIT = 0.05  # in log factors from a limit

NORMAL = float(stats.norm.ppf(0.5 + CONFIDENCE / 2.0))

Scoring = Callable[[Array], Array | None]  # of log factors (p,): log densities (R, T), None where a run failed


@dataclass(frozen=True)
class FactorFit:
    """Natural logarithms of p factors."""

    log_factors: Array  # (p,)
    interval: Array  # (p, 2), 95 %; infinite on a side on which the data do not bound it
    edge: tuple[int, ...]  # of each factor: -1 or 1 where it lies at the lower or upper limit of what is tried, or 0
    settings: int  # that were tried


def fit_log_factors(score: Scoring, starts: Sequence[Array]) -> FactorFit | None:
    """Return the setting of greatest total score, searched from the first start at which no run fails; None without.

    The search is COBYQA (Ragonneau & Zhang 2025; SciPy), a trust region on quadratic models without derivatives, and
    one Newton step at its end. The score is smooth, for all settings see the same trials. Intervals are those of the
    profile (:mod:`consistency.bench.tuning.noise_factor_fit`).
    """
    scores = KnownScores(score)
    start = next((start for start in starts if np.isfinite(scores.total(start))), None)
    if start is None:
        return None
    densities = scores(start).size
    search_options: dict[str, Any] = {"method": "COBYQA", "bounds": [(-LIMIT, LIMIT)] * len(start)}
    search_options["options"] = _search_options(RADII, MOST_SETTINGS)

    def loss(x: Array) -> float:
        return -scores.total(x) / densities

    search_result: Any = minimize(loss, start, **search_options)
    best = np.clip(search_result.x, -LIMIT, LIMIT)
    edge = np.where(np.abs(best) > LIMIT - AT_LIMIT, np.sign(best), 0.0).astype(int)
    free = np.flatnonzero(edge == 0)
    slope, curvature = score_derivatives(scores, best, free)
    best = _after_newton_step(scores, best, free, slope, curvature)
    interval = profile_intervals(scores, best, np.nan_to_num(curvature), LIMIT)
    return FactorFit(best, interval, tuple(edge.tolist()), scores.settings)


class KnownScores:
    """Scores of settings, each computed once."""

    def __init__(self, score: Scoring) -> None:
        self.score = score
        self._known: dict[bytes, Array | None] = {}
        self._shape: tuple[int, ...] = (1, 1)

    def __call__(self, x: Array) -> Array:
        """Return log densities (R, T); NaN where a run failed."""
        key = np.asarray(x, float).tobytes()
        if key not in self._known:
            self._known[key] = self.score(np.asarray(x, float))
        density = self._known[key]
        if density is None:
            return np.full(self._shape, np.nan)
        self._shape = density.shape
        return density

    def total(self, x: Array) -> float:
        """Return the total log density; minus infinity where a run failed."""
        total_log_density = float(self(x).sum())
        return total_log_density if np.isfinite(total_log_density) else -np.inf

    @property
    def settings(self) -> int:
        """Number of settings that were tried."""
        return len(self._known)


def score_derivatives(scores: KnownScores, x: Array, free: Sequence[int] | Array) -> tuple[Array, Array]:
    """Return slope (p,) and curvature (p, p) of the total by the ``free`` log factors, 0 by the others."""
    step = STEP * np.eye(len(x))

    def total(at: Array) -> float:
        return float(scores(at).sum())

    at_point, slope, curvature = total(x), np.zeros(len(x)), np.zeros((len(x), len(x)))
    for i in free:
        ahead, behind = total(x + step[i]), total(x - step[i])
        slope[i] = (ahead - behind) / (2.0 * STEP)
        curvature[i, i] = (ahead - 2.0 * at_point + behind) / STEP**2
    for i, j in combinations(free, 2):
        ahead, behind = total(x + step[i] + step[j]), total(x - step[i] - step[j])
        along_both = (ahead - 2.0 * at_point + behind) / STEP**2
        curvature[i, j] = (along_both - curvature[i, i] - curvature[j, j]) / 2.0
        curvature[j, i] = curvature[i, j]
    return slope, curvature


def _after_newton_step(scores: KnownScores, x: Array, free: Array, slope: Array, curvature: Array) -> Array:
    """Return the top of the parabola through ``x``, where there is one and the score is greater there."""
    bend = -curvature[np.ix_(free, free)]
    if not len(free) or not np.isfinite(bend).all() or np.linalg.eigvalsh(bend)[0] <= 0.0:
        return x
    moved = x.copy()
    moved[free] += np.clip(np.linalg.solve(bend, slope[free]), -STEP, STEP)
    return moved if scores.total(moved) > scores.total(x) else x


# --- intervals --------------------------------------------------------------------------------------


def profile_intervals(score: Callable[[Array], Array], best: Array, curvature: Array, limit: float) -> Array:
    """Return the interval of each log factor (p, 2), infinite on a side on which the data do not bound it.

    Parameters
    ----------
    score : log densities (R, T) at log factors (p,), NaN where a run failed
    best : the setting of greatest score (p,)
    curvature : second derivatives of the total score there (p, p); 0 where they are not known
    limit : log factors lie within it on both sides
    """
    eigenvalues, eigenvectors = np.linalg.eigh(-curvature)
    covariance = (eigenvectors / np.maximum(eigenvalues, WEAK)) @ eigenvectors.T
    half_widths = NORMAL * np.sqrt(np.diag(covariance))
    unit = np.minimum(half_widths, LARGEST_STEP)
    at_best = independent_sums(score(best))

    def depth(u: Array) -> float:
        here = independent_sums(score(np.clip(best + unit * u, -limit, limit)))
        if not np.isfinite(here).all():
            return 1.0 + float(np.linalg.norm(u))  # outside, and the more so the further away
        return depth_of(at_best, here, len(best))

    low, high = (-limit - best) / unit, (limit - best) / unit
    intervals = np.empty((len(best), 2))
    for i in range(len(best)):
        towards_end = covariance[:, i] / covariance[i, i] * unit[i] / unit
        for column, side in enumerate((-1.0, 1.0)):
            guess = np.clip(side * towards_end, low, high)
            end = best[i] + unit[i] * _farthest(i, side, depth, guess, low, high)
            is_open = side * end > limit - AT_LIMIT
            intervals[i, column] = side * np.inf if is_open else end
    return intervals


def _search_options(radii: tuple[float, float], settings: int) -> dict[str, Any]:
    """Options of COBYQA for a trust region between two radii and so many settings at most."""
    return {"initial_tr_radius": radii[0], "final_tr_radius": radii[1], "maxfev": settings, "scale": False}


def _farthest(i: int, side: float, depth: Callable[[Any], Any], guess: Array, low: Array, high: Array) -> float:
    """Return the largest (``side`` 1) or smallest (-1) coordinate ``i`` of the points at a depth of 1 at most."""
    search_options: dict[str, Any] = {"method": "COBYQA", "bounds": list(zip(low, high, strict=True))}
    search_options["constraints"] = NonlinearConstraint(depth, -np.inf, 1.0)
    search_options["options"] = _search_options(END_RADII, END_SETTINGS)

    def nearness(u: Array) -> float:
        return float(-side * u[i])

    search_result: Any = minimize(nearness, guess, **search_options)
    return float(search_result.x[i])


def independent_sums(density: Array) -> Array:
    """Sum (R, T) over what is taken to be independent: runs, or blocks of steps of few runs."""
    blocks = -(-UNITS // len(density))
    block_sums = [part.sum(axis=1) for part in np.array_split(density, blocks, axis=1)]
    return np.concatenate(block_sums)


def depth_of(at_best: Array, here: Array, factors: int) -> float:
    """Return how far a setting is from the best one: 0 there, 1 at the end of an interval.

    The depth is linear in the distance where the score is quadratic.

    Parameters
    ----------
    at_best, here : sums of log densities of independent units (n,) at the best setting and at this one
    factors : number of factors that were fitted
    """
    fall = at_best - here
    n, W = len(fall), 2.0 * float(fall.sum())
    if W <= 0.0:
        return 0.0
    V = n / (n - factors) * float(((fall - fall.mean()) ** 2).sum())
    student = float(stats.t.ppf(0.5 + CONFIDENCE / 2.0, n - factors))
    return float(W / max(NORMAL * np.sqrt(W), student * np.sqrt(V)))
