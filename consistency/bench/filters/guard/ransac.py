"""One-point RANSAC, Civera, Grasa, Davison & Montiel (2010), with a hypothesis from each observation: the kernel."""

from __future__ import annotations

from consistency.bench.filters.compiler.jit import inner
from consistency.bench.filters.guard.screening import (
    Watch,
    added_distance,
)
from consistency.referee.types import Array


@inner
def keep_supported(own: float, support: float, count: int, s: int, m: int, y: Array, S: Array, watch: Watch) -> bool:
    """``kept`` (m,) <- what supports the best hypothesis and what is rescued, of the ``count`` that passed the gate.

    ``own`` and ``support`` are the squared distances up to which an observation passes the gate and supports.
    """
    best = _best_hypothesis(support, count, s, y, S, watch)
    for i in range(m):
        watch.kept[i] = False
    if best < 0:
        return True
    low = _list_support(best, support, count, s, y, S, watch)
    for i in range(low):
        watch.chosen[i] = watch.best[i]
        watch.kept[watch.best[i]] = True
        if not added_distance(watch.best[i], i, s, y, S, watch) >= 0.0:
            return False
    for c in range(count):
        i = watch.order[c]
        watch.kept[i] = watch.kept[i] or added_distance(i, low, s, y, S, watch) <= own  # rescued
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
