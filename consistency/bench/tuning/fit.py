"""The setting of greatest score, and how well it is known. Knows no filter: scores in, factors out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from scipy.optimize import minimize

from consistency.bench.tuning.profile_intervals import AT_LIMIT, STEP, Profile
from consistency.referee.types import Array

LIMIT = float(np.log(1e4))  # factors that are tried lie within 1e-4 and 1e4
RADIUS, SETTLED = 0.7, 0.01  # of the trust region in log factors: a factor of 2 at first, 1 % at the end
MOST = 150  # settings of a search, which takes some 30 for two factors

Scoring = Callable[[Array], Array | None]  # of log factors (p,): log densities (R, T), None where a run failed


@dataclass(frozen=True)
class FactorFit:
    """Natural logarithms of p factors."""

    log_factors: Array  # (p,)
    interval: Array  # (p, 2), 95 %; infinite on a side on which the data do not bound it
    edge: tuple[int, ...]  # of each factor: -1 or 1 where it lies at the lower or upper limit of what is tried, or 0
    gain: float  # of log density over the first start
    settings: int  # that were tried


def maximise(score: Scoring, starts: Sequence[Array]) -> FactorFit | None:
    """The setting of greatest total score from the first of the ``starts`` at which no run fails; None without one.

    The search is COBYQA (Ragonneau & Zhang 2025; SciPy), a trust region on quadratic models without derivatives, and
    one Newton step at its end. The score is smooth, for all settings see the same trials.

    Intervals are those of the profile of the score, scaled by the spread of independent runs; fewer than 20 runs are
    cut into blocks of steps (:mod:`consistency.bench.tuning.profile_intervals`). They are open on a side on which all
    that may be tried is inside.
    """
    search = _Search(score)
    start = next((start for start in starts if np.isfinite(search.total(start))), None)
    if start is None:
        return None
    first, size = search.total(start), float(search(start).size)
    how: dict[str, Any] = {"method": "COBYQA", "bounds": [(-LIMIT, LIMIT)] * len(start)}
    how["options"] = {"initial_tr_radius": RADIUS, "final_tr_radius": SETTLED, "maxfev": MOST, "scale": False}

    def loss(x: Array) -> float:
        return -search.total(x) / size

    found: Any = minimize(loss, start, **how)
    best = np.clip(found.x, -LIMIT, LIMIT)
    edge = tuple(int(np.sign(x)) if abs(x) > LIMIT - AT_LIMIT else 0 for x in best)
    free = [i for i, at in enumerate(edge) if at == 0]
    slope, curvature = _derivatives(search, best, free)
    bend = -curvature[np.ix_(free, free)]
    if free and np.isfinite(bend).all() and np.linalg.eigvalsh(bend)[0] > 0.0:
        moved = best.copy()
        moved[free] += np.clip(np.linalg.solve(bend, slope[free]), -STEP, STEP)
        best = moved if search.total(moved) > search.total(best) else best
    interval = Profile(search, search.tried, best, np.nan_to_num(curvature), LIMIT).intervals()
    return FactorFit(best, interval, edge, search.total(best) - first, len(search.tried))


class _Search:
    """Scores of settings, each asked for once."""

    def __init__(self, score: Scoring) -> None:
        self.score = score
        self._known: dict[bytes, Array | None] = {}
        self._shape: tuple[int, ...] = (1, 1)

    def __call__(self, x: Array) -> Array:
        """Log densities (R, T); NaN where a run failed."""
        key = np.asarray(x, float).tobytes()
        if key not in self._known:
            self._known[key] = self.score(np.asarray(x, float))
        density = self._known[key]
        self._shape = self._shape if density is None else density.shape
        return np.full(self._shape, np.nan) if density is None else density

    def total(self, x: Array) -> float:
        total = float(self(x).sum())
        return total if np.isfinite(total) else -np.inf

    @property
    def tried(self) -> list[Array]:
        return [np.frombuffer(key) for key in self._known]


def _derivatives(search: _Search, x: Array, free: Sequence[int]) -> tuple[Array, Array]:
    """Slope (p,) and curvature (p, p) of the total by the ``free`` log factors, 0 by the others."""

    def at(*moves: tuple[int, float]) -> float:
        moved = x.copy()
        for i, by in moves:
            moved[i] += by
        return float(search(moved).sum())

    here, slope, curvature = at(), np.zeros(len(x)), np.zeros((len(x), len(x)))
    up, down = {i: at((i, STEP)) for i in free}, {i: at((i, -STEP)) for i in free}
    for i in free:
        slope[i] = (up[i] - down[i]) / (2.0 * STEP)
        curvature[i, i] = (up[i] - 2.0 * here + down[i]) / STEP**2
    for i, j in combinations(free, 2):
        both = at((i, STEP), (j, STEP)) + at((i, -STEP), (j, -STEP)) + 2.0 * here
        curvature[i, j] = curvature[j, i] = (both - up[i] - down[i] - up[j] - down[j]) / (2.0 * STEP**2)
    return slope, curvature
