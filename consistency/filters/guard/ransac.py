"""One-point RANSAC, Civera, Grasa, Davison & Montiel (2010), with a hypothesis from each observation: the kernel."""

from __future__ import annotations

from typing import NamedTuple

from consistency.filters.guard.screening import (
    Tracks,
    Watch,
    added_distance,
    pass_gate,
    share_screening,
)
from consistency.filters.kernel.dispatch import implement, part
from consistency.filters.kernel.jit import inner
from consistency.filters.kernel.slam import keep_some
from consistency.types import Array


@part()
class OnePoint(NamedTuple):
    """Squared distances up to which 0, 1, ... observations are accepted, and one supports a hypothesis."""

    tracks: Tracks
    joint: Array  # (m + 1,)
    support: float


share_screening(OnePoint)


@implement(keep_some, OnePoint)
def keep_supported(guard: OnePoint, s: int, m: int, y: Array, S: Array, watch: Watch) -> bool:
    count = pass_gate(guard.joint[1], s, m, y, S, watch)
    if count < 0:
        return False
    best = _best_hypothesis(guard.support, count, s, y, S, watch)
    for i in range(m):
        watch.kept[i] = False
    if best < 0:
        return True
    low = _list_support(best, guard.support, count, s, y, S, watch)
    for i in range(low):
        watch.chosen[i] = watch.best[i]
        watch.kept[watch.best[i]] = True
        if not added_distance(watch.best[i], i, s, y, S, watch) >= 0.0:
            return False
    for c in range(count):
        i = watch.order[c]
        watch.kept[i] = watch.kept[i] or added_distance(i, low, s, y, S, watch) <= guard.joint[1]  # rescued
    return True


@inner
def _best_hypothesis(support: float, count: int, s: int, y: Array, S: Array, watch: Watch) -> int:
    """The observation with most support, the nearest of several; -1 if there is none."""
    best, most = -1, 0
    for c in range(count):
        i = watch.order[c]
        supporters = _list_support(i, support, count, s, y, S, watch)
        if supporters > most or (supporters == most and watch.own[i] < watch.own[best]):
            best, most = i, supporters
    return best


@inner
def _list_support(hypothesis: int, support: float, count: int, s: int, y: Array, S: Array, watch: Watch) -> int:
    """``best`` <- the hypothesis and what it leaves within ``support``, in order; returns how many."""
    found = 0
    added_distance(hypothesis, 0, s, y, S, watch)
    watch.chosen[0] = hypothesis
    for c in range(count):
        i = watch.order[c]
        if i == hypothesis or added_distance(i, 1, s, y, S, watch) <= support:
            watch.best[found] = i
            found += 1
    return found
