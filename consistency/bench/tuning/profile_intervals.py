"""Intervals from the profile of a score that need not be a true likelihood. Knows no filter."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import stats

from consistency.referee.defaults import CONFIDENCE
from consistency.referee.types import Array

UNITS = 20  # independent parts that an interval needs at least; fewer runs are cut into blocks of steps
WEAK = 1.0  # curvature below which a log factor is hardly told: its standard deviation is then above a factor of e
TRUSTED = 16.0  # curvature above which it holds as far as the ends: a standard deviation of a factor of 1.3
FARTHEST = 1.5  # step of a log factor in which a quadratic model is still believed
TINY = 1e-6  # curvature of nothing
LOOKS = 8  # places at which an end is looked for; one or two do where the score is nearly quadratic
STEP = 0.05  # in log factors, for differences
AT_LIMIT = 0.05  # in log factors from a limit
NEAR = 0.1  # of the distance to an end: what is left to interpolation
SETTLED = 0.1  # of the fall of the score: what the other factors may still win back

NORMAL = float(stats.norm.ppf(0.5 + CONFIDENCE / 2.0))


def units(density: Array) -> Array:
    """Sums (units,) of (R, T) over what is taken to be independent: runs, or blocks of steps of few runs."""
    blocks = -(-UNITS // len(density))
    parts = [part.sum(axis=1) for part in np.array_split(density, blocks, axis=1)]
    return np.concatenate(parts)


class ProfilePoint(NamedTuple):
    """A setting on the way to an end, and where the other factors should be instead."""

    depth: float  # of the profile there: 0 at the best setting, 1 at the end of the interval
    step: Array  # (p,), of the other factors
    settled: bool  # is the step not worth taking?


@dataclass
class Profile:
    """The fall of a score from its best setting along each log factor, with the others at their best.

    Let d_r be the fall of unit r from the best setting to another one, W = 2 sum d_r, and V the variance of sum d_r by
    the scatter of its n terms. To first order W is lambda times a chi-square number of one degree of freedom, with
    lambda = (H^-1 J H^-1)_ii / (H^-1)_ii, H the curvature of the score and J the spread of its slopes (Kent 1982,
    Biometrika 69(1)), and V / W tends to lambda, for both grow as the square of the distance. A setting is outside if
    W exceeds the quantile of chi-square, which would do if the likelihood were true, and W / (V / W) the square of
    Student's. The others follow by Newton's steps (Venzon & Moolgavkar 1988, Applied Statistics 37(1)).
    """

    score: Callable[[Array], Array]  # log densities (R, T) of log factors (p,), NaN where a run failed
    known: Sequence[Array]  # settings (p,) that were tried
    best: Array  # (p,)
    curvature: Array  # (p, p) of the total; 0 where it is not known
    limit: float  # of log factors, on both sides

    def __post_init__(self) -> None:
        self._top = units(self.score(self.best))
        self._student = float(stats.t.ppf(0.5 + CONFIDENCE / 2.0, len(self._top) - len(self.best)))
        value, vector = np.linalg.eigh(-self.curvature)
        self._doubtful = bool(value[0] < TRUSTED)
        self._ends: list[Array] = []  # settings near ends
        self._bend = vector * np.maximum(value, WEAK) @ vector.T
        self._inverse = np.linalg.inv(self._bend)
        self._reach = NORMAL * np.sqrt(np.diag(self._inverse))

    def intervals(self) -> Array:
        """Of each log factor, (p, 2); infinite on a side on which the data do not bound it."""
        ends = np.empty((len(self.best), 2))
        for i in np.argsort(-self._reach):  # what is hardly told first: from its ends those of others are found
            ends[i] = self._end(int(i), -1.0), self._end(int(i), 1.0)
        return ends

    def depth(self, x: Array, back: float = 0.0) -> float:
        """How far a setting is from the best: 1 at the end of an interval, linear in the distance where W is quadratic.

        ``back`` is what the other factors would win back of the fall.
        """
        fall = self._top - units(self.score(x))
        if not np.isfinite(fall).all():
            return np.inf
        n, W = len(fall), 2.0 * max(float(fall.sum()) - back, 0.0)
        V = n / (n - len(x)) * float(((fall - fall.mean()) ** 2).sum())
        return float(W / max(NORMAL * np.sqrt(W), self._student * np.sqrt(V))) if W > 0.0 else 0.0

    def _end(self, i: int, side: float) -> float:
        """End of the interval of log factor ``i`` on one side."""
        room = self.limit - side * self.best[i]
        if room <= AT_LIMIT:
            return side * np.inf
        x, seen, careful = self._start(i, side), [(0.0, 0.0)], self._doubtful
        inside = 0.0
        for _ in range(LOOKS):
            distance, look = side * (x[i] - self.best[i]), self._look(x, i, careful)
            now = [*seen, (distance, look.depth)]
            further = min(_guess(now), distance + FARTHEST if side > 0.0 else room, room)
            if look.settled:
                if further >= room and (distance >= room or abs(look.depth - 1.0) < NEAR):
                    break
                if abs(look.depth - 1.0) < NEAR:
                    self._ends.append(x)
                    return float(self.best[i] + side * further)
                seen = now
            inside = max(inside, distance if look.depth < 1.0 else 0.0)  # the others can only bring it nearer
            if further <= inside:
                further = min((inside + min((a for a, _ in now if a > inside), default=inside + FARTHEST)) / 2.0, room)
            moved = x + look.step
            turn = (moved - self.best) * (further / distance - 1.0)
            x = np.clip(moved + np.clip(turn, -FARTHEST, FARTHEST), -self.limit, self.limit)
            x[i], careful = self.best[i] + side * further, self._doubtful or not look.settled
        outside = [distance for distance, depth in seen if depth >= 1.0]
        return float(self.best[i] + side * min(outside, default=np.inf))

    def _start(self, i: int, side: float) -> Array:
        """Where the end would be if the score were quadratic, or further if a known setting is inside there.

        Where the curvature is not to be trusted, the others start where the ends found before tell them to go.
        """
        x, guess = self.best + self._inverse[:, i] / self._inverse[i, i] * side * self._reach[i], self._reach[i]
        if self._doubtful:
            for end in self._ends:
                shift = side * (end[i] - self.best[i]) / self._reach[i]
                if shift > 0.0:
                    x = np.logaddexp(self.best, np.log(min(shift, 1.0)) + end)
        for other in self.known:
            distance, depth = side * (other[i] - self.best[i]), self.depth(other)
            further = min(distance / max(depth, 0.1), distance + FARTHEST)
            if depth < 1.0 + NEAR and further > (1.0 + NEAR) * guess:
                x, guess = other, further
        x = np.clip(x, -self.limit, self.limit)
        x[i] = np.clip(self.best[i] + side * guess, -self.limit, self.limit)
        return np.asarray(x)

    def _look(self, x: Array, i: int, careful: bool) -> ProfilePoint:
        """Differences tell how the other factors should move; if ``careful``, also how the score bends there.

        The score is taken to be quadratic in factors, not in their logarithms: it levels off as a noise goes to 0.
        """
        p, here = len(x), float(self.score(x).sum())
        others = np.flatnonzero(np.arange(p) != i)
        slope, bend = np.zeros(p), self._bend.copy()
        if not np.isfinite(here):
            return ProfilePoint(np.inf, slope, True)
        for j in others:
            h = -STEP if x[j] > 0.0 else STEP
            ahead = float(self.score(x + h * np.eye(p)[j]).sum())
            slope[j] = (ahead - here) / h + h / 2.0 * bend[j, j]
            if careful:
                behind = float(self.score(x - h * np.eye(p)[j]).sum())
                slope[j], known = (ahead - behind) / (2.0 * h), bend[j, j]
                bend[j, j] = max((2.0 * here - ahead - behind) / STEP**2 + slope[j], TINY)
                shrunk = np.sqrt(min(bend[j, j] / known, 1.0))
                bend[j, others[others != j]] *= shrunk
                bend[others[others != j], j] *= shrunk
        slope = np.nan_to_num(slope)
        grown = np.zeros(p)
        grown[others] = np.linalg.solve(bend[np.ix_(others, others)], slope[others])
        grown = np.clip(np.nan_to_num(grown), -1.0, np.expm1(FARTHEST))
        back = max(float(slope @ grown - grown @ bend @ grown / 2.0), 0.0)
        fall = float(self._top.sum()) - here
        step = np.log(np.maximum(1.0 + grown, np.exp(-FARTHEST)))
        return ProfilePoint(self.depth(x, back), step, back <= SETTLED * max(fall, NORMAL**2 / 2.0))


def _guess(seen: Sequence[tuple[float, float]]) -> float:
    """Distance at which the depth is 1, of pairs (distance, depth)."""
    inside = [s for s in seen if s[1] < 1.0]
    a, at_a = max(inside)
    if outside := [s for s in seen if s[0] > a]:
        b, at_b = min(outside)
        part = (1.0 - at_a) / (at_b - at_a) if np.isfinite(at_b) else 0.5
        part = part if min(1.0 - at_a, at_b - 1.0) < NEAR else float(np.clip(part, 0.1, 0.9))
        return a + part * (b - a)
    before, at_before = max(s for s in inside if s[0] < a)
    slope = (at_a - at_before) / (a - before)
    return min(a + (1.0 - at_a) / slope, 3.0 * a) if slope > 0.0 else 3.0 * a
