"""The worst of many points, from noisy scores.

Points come in batches. The first batch, and a quarter of each later one, fills the unit cube evenly (Halton's
sequence); the rest varies the best points so far by differential mutation and crossover (Storn & Price 1997). A batch
is raced by successive halving (Jamieson & Talwalkar 2016): two trials for each point, twice as many for the better
half, and so on. Awad, Mallik & Hutter (2021) combine the two likewise. Mixed dimensions need nothing of their own: all
are places in the unit cube.

The sampler is SciPy's. Its optimisers know neither noise nor evaluations that are broken off, and Hypothesis'
``target`` has no time limit.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.stats import qmc

from consistency.bench.challenging.world_space import Point, Space
from consistency.referee.types import Array

BATCH = 16  # points raced against each other
RUNGS = (2, 4, 8, 16)  # trials of a point in all, at each of which the worse half is left behind
HOPELESS = 8 * BATCH  # points none of which is usable: there will be no other
ELITE = 8  # points that are varied
EVEN = 4  # points of a batch that fill the space
STEP, CROSSOVER, JITTER = 0.7, 0.5, 0.05  # of the variation; the first two within the usual ranges of the method
LEAST_SPREAD = 0.3  # of a trial's score, where a few agree by chance


@dataclass
class ScoredWorld:
    """A point with the scores of its trials so far."""

    point: Point
    scores: list[float] = field(default_factory=list)
    usable: bool = True  # False where there is no such world, or it takes too long

    @property
    def score(self) -> float:
        if not self.scores or not self.usable:
            return -np.inf
        return float(np.mean(self.scores)) - standard_error(self.scores)


def standard_error(scores: Sequence[float]) -> float:
    """Of the mean of scores; a few that agree by chance are not taken at their word."""
    spread = float(np.std(scores, ddof=1)) if len(scores) > 1 else 0.0
    return max(spread, LEAST_SPREAD) / float(np.sqrt(len(scores)))


# gives each candidate scores up to a number of trials, as far as the budget goes, or marks it as not usable
Evaluate = Callable[[Sequence[ScoredWorld], int], None]


class Budget:
    """Time, or a number of trials, of which shares are spent; with trials the outcome does not depend on the clock."""

    def __init__(self, seconds: float | None = None, trials: int | None = None) -> None:
        self.seconds, self.trials = seconds, trials
        self.started, self.used = time.monotonic(), 0

    @property
    def elapsed(self) -> float:
        return time.monotonic() - self.started

    def left(self, share: float) -> bool:
        """Is less than this share of the budget spent?"""
        if self.trials is not None:
            return self.used < share * self.trials
        return self.seconds is None or self.elapsed < share * self.seconds

    def until(self, share: float) -> float:
        """The time of ``time.monotonic`` at which this share is spent; infinite with a number of trials."""
        return np.inf if self.seconds is None else self.started + share * self.seconds


def search(
    space: Space,
    evaluate: Evaluate,
    left: Callable[[], bool],
    rng: np.random.Generator,
    tried: dict[Point, ScoredWorld],
) -> None:
    """Try batches of points, which are added to those ``tried`` before.

    Parameters
    ----------
    evaluate : gives candidates trials
    left : whether to continue with another batch, and another rung
    """
    even = qmc.Halton(len(space.dimensions), rng=rng)
    while left():
        batch = _batch(space, tried, even, rng)
        if not batch:
            break
        tried |= {candidate.point: candidate for candidate in batch}
        _race(batch, evaluate, left)
        if len(tried) >= HOPELESS and not any(candidate.usable for candidate in tried.values()):
            break


def ranked(candidates: Iterable[ScoredWorld]) -> list[ScoredWorld]:
    """Usable candidates, the worst first; those with the trials of the last rung before the others."""
    usable = [c for c in candidates if c.usable and c.scores]
    return sorted(usable, key=lambda c: (len(c.scores) >= RUNGS[-1], c.score), reverse=True)


def _race(batch: list[ScoredWorld], evaluate: Evaluate, left: Callable[[], bool]) -> None:
    alive = batch
    for trials in RUNGS:
        if not left():
            return
        evaluate(alive, trials)
        alive = sorted((c for c in alive if c.usable), key=lambda c: c.score, reverse=True)
        alive = alive[: max(1, len(alive) // 2)]


def _batch(
    space: Space, tried: dict[Point, ScoredWorld], even: qmc.Halton, rng: np.random.Generator
) -> list[ScoredWorld]:
    """New points; the first of all is that of the base."""
    elite = sorted((c for c in tried.values() if c.usable and c.scores), key=lambda c: c.score, reverse=True)[:ELITE]
    new_points: dict[Point, ScoredWorld] = {} if tried else {space.plain: ScoredWorld(space.plain)}
    for _ in range(20 * BATCH):  # a small space has no more to offer
        if len(new_points) == BATCH:
            break
        if len(elite) >= 4 and len(new_points) >= EVEN:
            place = _varied(np.array([space.where(each.point) for each in elite]), rng)
        else:
            place = even.random()[0]
        point = space.at(place)
        if point not in tried and point not in new_points:
            new_points[point] = ScoredWorld(point)
    return list(new_points.values())


def _varied(elite: Array, rng: np.random.Generator) -> Array:
    """A point of the elite (n, d) with some coordinates moved along the difference of two others."""
    base, plus, minus = rng.choice(len(elite), 3, replace=False)
    moved = elite[base] + STEP * (elite[plus] - elite[minus]) + JITTER * rng.standard_normal(elite.shape[1])
    is_mutated = rng.random(elite.shape[1]) < CROSSOVER
    is_mutated |= np.arange(elite.shape[1]) == rng.integers(elite.shape[1])
    u = np.where(is_mutated, moved, elite[base])
    return np.asarray(1.0 - np.abs(1.0 - np.abs(u) % 2.0))  # reflected at 0 and 1
