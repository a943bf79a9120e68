"""Intervals of log factors from the profile of a score that need not be a true likelihood. Knows no filter.

Let d_r be the fall of unit r from the best setting to another one, W = 2 sum d_r, and V the variance of sum d_r by the
scatter of its n terms. To first order W is lambda times a chi-square number of one degree of freedom, with lambda =
(H^-1 J H^-1)_ii / (H^-1)_ii, H the curvature of the score and J the spread of its slopes (Kent 1982, Biometrika 69(1)),
and V / W tends to lambda, for both grow as the square of the distance. A setting is outside if W exceeds the quantile
of chi-square, which would do if the likelihood were true, and W / (V / W) the square of Student's. An interval reaches
as far as any setting that is not outside.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from scipy import stats
from scipy.optimize import NonlinearConstraint, minimize

from consistency.referee.defaults import CONFIDENCE
from consistency.referee.types import Array

UNITS = 20  # independent parts that an interval needs at least; fewer runs are cut into blocks of steps
WEAK = 1.0  # least curvature: a log factor is then known to a standard deviation of a factor of e
LARGEST_STEP = 1.0  # of a log factor, in which a quadratic model of the score is believed
FIRST_RADIUS, LAST_RADIUS = 0.3, 0.02  # of the trust region, in half widths of the intervals
MOST_SETTINGS = 60  # for one end of an interval; some 15 do
AT_LIMIT = 0.05  # in log factors from a limit

NORMAL = float(stats.norm.ppf(0.5 + CONFIDENCE / 2.0))


def profile_intervals(score: Callable[[Array], Array], best: Array, curvature: Array, limit: float) -> Array:
    """Return the interval of each log factor (p, 2), infinite on a side on which the data do not bound it.

    Parameters
    ----------
    score : log densities (R, T) at log factors (p,), NaN where a run failed
    best : the setting of greatest score (p,)
    curvature : second derivatives of the total score there (p, p); 0 where they are not known
    limit : log factors lie within it on both sides
    """
    value, vector = np.linalg.eigh(-curvature)
    covariance = (vector / np.maximum(value, WEAK)) @ vector.T
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


def _farthest(i: int, side: float, depth: Callable[[Any], Any], guess: Array, low: Array, high: Array) -> float:
    """Return the largest (``side`` 1) or smallest (-1) coordinate ``i`` of the points at a depth of 1 at most."""
    how: dict[str, Any] = {"method": "COBYQA", "bounds": list(zip(low, high, strict=True))}
    how["constraints"] = NonlinearConstraint(depth, -np.inf, 1.0)
    how["options"] = {
        "initial_tr_radius": FIRST_RADIUS,
        "final_tr_radius": LAST_RADIUS,
        "maxfev": MOST_SETTINGS,
        "scale": False,
    }

    def nearness(u: Array) -> float:
        return float(-side * u[i])

    found: Any = minimize(nearness, guess, **how)
    return float(found.x[i])


def independent_sums(density: Array) -> Array:
    """Sum (R, T) over what is taken to be independent: runs, or blocks of steps of few runs."""
    blocks = -(-UNITS // len(density))
    parts = [part.sum(axis=1) for part in np.array_split(density, blocks, axis=1)]
    return np.concatenate(parts)


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
