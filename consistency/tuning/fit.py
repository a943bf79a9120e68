"""The setting of greatest score, and how well it is known. Knows no filter: scores in, factors out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np
from scipy import stats
from scipy.optimize import brentq, minimize

from consistency.types import Array

LIMIT = float(np.log(1e4))  # factors that are tried lie within 1e-4 and 1e4
RADIUS, SETTLED = 0.7, 0.01  # of the trust region in log factors: a factor of 2 at first, 1 % at the end
MOST = 150  # settings of a search, which takes some 30 for two factors
STEP = 0.05  # in log factors, for differences; the last Newton step is taken from these, too
AT_EDGE = 0.05  # in log factors from a limit
UNITS = 20  # independent parts that an interval needs at least; fewer runs are cut into blocks of steps
CONFIDENCE = 0.95

Scoring = Callable[[Array], Array | None]  # of log factors (p,): log densities (R, T), None where a run failed


@dataclass(frozen=True)
class Fit:
    """Natural logarithms of p factors."""

    log_factors: Array  # (p,)
    interval: Array  # (p, 2), 95 %; infinite on a side on which the data do not bound it
    edge: tuple[int, ...]  # of each factor: -1 or 1 where it lies at the lower or upper limit of what is tried, or 0
    gain: float  # of log density over the first start
    settings: int  # that were tried


def maximise(score: Scoring, starts: Sequence[Array]) -> Fit | None:
    """The setting of greatest total score from the first of the ``starts`` at which no run fails; None without one.

    The search is COBYQA (Ragonneau & Zhang 2025; SciPy), a trust region on quadratic models without derivatives, and
    one Newton step at its end. The score is smooth, for all settings see the same trials.

    Intervals are those of misspecified likelihoods, H^-1 J H^-1 (White 1982, Econometrica 50(1), th. 3.2): H is the
    curvature of the total, J the spread of the slopes of runs, which are independent whatever ties steps to each
    other. Fewer than 20 runs are cut into blocks of steps. The quantile is Student's.
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
    edge = tuple(int(np.sign(x)) if abs(x) > LIMIT - AT_EDGE else 0 for x in best)
    free = [i for i, at in enumerate(edge) if at == 0]
    interval = np.array([_beyond(search, best, i) if at else (-np.inf, np.inf) for i, at in enumerate(edge)])
    slopes, curvature = _derivatives(search, best, free) if free else (np.zeros((0, 0)), np.zeros((0, 0)))
    if free and np.isfinite(curvature).all() and np.linalg.eigvalsh(curvature)[-1] < 0.0:
        moved = best.copy()
        moved[free] -= np.clip(np.linalg.solve(curvature, slopes.sum(axis=0)), -STEP, STEP)
        best = moved if search.total(moved) > search.total(best) else best
        interval[free] = best[free, None] + _half_widths(slopes, curvature)[:, None] * [-1.0, 1.0]
    return Fit(best, interval, edge, search.total(best) - first, search.settings)


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
    def settings(self) -> int:
        return len(self._known)


def _derivatives(search: _Search, x: Array, free: Sequence[int]) -> tuple[Array, Array]:
    """Slopes of independent units (units, p) and curvature of the total (p, p), by the ``free`` log factors."""

    def at(*moves: tuple[int, float]) -> Array:
        moved = x.copy()
        for i, by in moves:
            moved[i] += by
        return search(moved)

    up, down, here = [at((i, STEP)) for i in free], [at((i, -STEP)) for i in free], search(x)
    slopes = np.array([_units(u - d) / (2.0 * STEP) for u, d in zip(up, down, strict=True)]).T
    curvature = np.diag([(u.sum() - 2.0 * here.sum() + d.sum()) / STEP**2 for u, d in zip(up, down, strict=True)])
    for a, b in combinations(range(len(free)), 2):
        i, j = free[a], free[b]
        both = at((i, STEP), (j, STEP)).sum() + at((i, -STEP), (j, -STEP)).sum() + 2.0 * here.sum()
        single = up[a].sum() + down[a].sum() + up[b].sum() + down[b].sum()
        curvature[a, b] = curvature[b, a] = (both - single) / (2.0 * STEP**2)
    return slopes, curvature


def _units(density: Array) -> Array:
    """Sums (units,) of (R, T) over what is taken to be independent: runs, or blocks of steps of few runs."""
    blocks = -(-UNITS // len(density))
    parts = [part.sum(axis=1) for part in np.array_split(density, blocks, axis=1)]
    return np.concatenate(parts)


def _half_widths(slopes: Array, curvature: Array) -> Array:
    """Of 95 % intervals, (p,)."""
    units, p = slopes.shape
    inverse, about = np.linalg.inv(curvature), slopes - slopes.mean(axis=0)
    spread = units / (units - p) * about.T @ about
    return np.asarray(stats.t.ppf(0.5 + CONFIDENCE / 2.0, units - p) * np.sqrt(np.diag(inverse @ spread @ inverse)))


def _beyond(search: _Search, best: Array, i: int) -> tuple[float, float]:
    """One-sided interval of a factor at a limit: as far as the total falls by half the quantile of chi-square."""
    side, fall = float(np.sign(best[i])), stats.chi2.ppf(CONFIDENCE, 1) / 2.0

    def excess(value: float) -> float:
        moved = best.copy()
        moved[i] = value
        return search.total(best) - search.total(moved) - float(fall)

    inner, step = best[i] - side, 1.0
    while abs(inner) < LIMIT and not excess(inner) > 0.0:
        inner, step = inner - side * step, 2.0 * step
    end = -side * np.inf
    if abs(inner) < LIMIT and np.isfinite(excess(inner)):
        end = brentq(excess, inner, best[i], xtol=STEP)
    elif abs(inner) < LIMIT:
        end = inner
    return (-np.inf, end) if side < 0 else (end, np.inf)
