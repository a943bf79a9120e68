"""The setting of greatest score, and how well it is known. Knows no filter: scores in, factors out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from scipy.optimize import minimize

from consistency.bench.tuning.profile_intervals import AT_LIMIT, profile_intervals
from consistency.referee.types import Array

LIMIT = float(np.log(1e4))  # factors that are tried lie within 1e-4 and 1e4
FIRST_RADIUS, LAST_RADIUS = 0.7, 0.01  # of the trust region in log factors: a factor of 2 at first, 1 % at the end
MOST_SETTINGS = 150  # of a search, which takes some 30 for two factors
STEP = 0.05  # in log factors, for differences

Scoring = Callable[[Array], Array | None]  # of log factors (p,): log densities (R, T), None where a run failed


@dataclass(frozen=True)
class FactorFit:
    """Natural logarithms of p factors."""

    log_factors: Array  # (p,)
    interval: Array  # (p, 2), 95 %; infinite on a side on which the data do not bound it
    edge: tuple[int, ...]  # of each factor: -1 or 1 where it lies at the lower or upper limit of what is tried, or 0
    settings: int  # that were tried


def maximise(score: Scoring, starts: Sequence[Array]) -> FactorFit | None:
    """Return the setting of greatest total score, searched from the first start at which no run fails; None without.

    The search is COBYQA (Ragonneau & Zhang 2025; SciPy), a trust region on quadratic models without derivatives, and
    one Newton step at its end. The score is smooth, for all settings see the same trials. Intervals are those of the
    profile (:mod:`consistency.bench.tuning.profile_intervals`).
    """
    scores = KnownScores(score)
    start = next((start for start in starts if np.isfinite(scores.total(start))), None)
    if start is None:
        return None
    size = scores(start).size
    how: dict[str, Any] = {"method": "COBYQA", "bounds": [(-LIMIT, LIMIT)] * len(start)}
    how["options"] = {
        "initial_tr_radius": FIRST_RADIUS,
        "final_tr_radius": LAST_RADIUS,
        "maxfev": MOST_SETTINGS,
        "scale": False,
    }

    def loss(x: Array) -> float:
        return -scores.total(x) / size

    found: Any = minimize(loss, start, **how)
    best = np.clip(found.x, -LIMIT, LIMIT)
    edge = np.where(np.abs(best) > LIMIT - AT_LIMIT, np.sign(best), 0.0).astype(int)
    free = np.flatnonzero(edge == 0)
    slope, curvature = derivatives(scores, best, free)
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
        total = float(self(x).sum())
        return total if np.isfinite(total) else -np.inf

    @property
    def settings(self) -> int:
        """Number of settings that were tried."""
        return len(self._known)


def derivatives(scores: KnownScores, x: Array, free: Sequence[int] | Array) -> tuple[Array, Array]:
    """Return slope (p,) and curvature (p, p) of the total by the ``free`` log factors, 0 by the others."""
    step = STEP * np.eye(len(x))

    def total(at: Array) -> float:
        return float(scores(at).sum())

    here, slope, curvature = total(x), np.zeros(len(x)), np.zeros((len(x), len(x)))
    for i in free:
        ahead, behind = total(x + step[i]), total(x - step[i])
        slope[i] = (ahead - behind) / (2.0 * STEP)
        curvature[i, i] = (ahead - 2.0 * here + behind) / STEP**2
    for i, j in combinations(free, 2):
        ahead, behind = total(x + step[i] + step[j]), total(x - step[i] - step[j])
        along_both = (ahead - 2.0 * here + behind) / STEP**2
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
