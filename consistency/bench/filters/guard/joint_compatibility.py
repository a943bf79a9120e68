"""Joint compatibility, Neira & Tardos (2001), with the association known from tracking: the kernel."""

from __future__ import annotations

import numpy as np

from consistency.bench.filters.compiler.jit import inner
from consistency.bench.filters.guard.plain_rules import MOST_NODES
from consistency.bench.filters.guard.screening import (
    Watch,
    added_distance,
)
from consistency.referee.types import Array


@inner
def keep_compatible(joint: Array, count: int, s: int, m: int, y: Array, S: Array, watch: Watch) -> bool:
    """``kept`` (m,) <- the largest jointly compatible set of the ``count`` that passed the gate."""
    _sort_by_distance(count, watch)
    best = _search(joint, count, s, y, S, watch)
    for i in range(m):
        watch.kept[i] = False
    for i in range(best):
        watch.kept[watch.best[i]] = True
    return best >= 0


@inner
def _sort_by_distance(count: int, watch: Watch) -> None:
    """``order`` (count,) <- nearest first; a stable insertion sort, for there are few."""
    order, own = watch.order, watch.own
    for last in range(1, count):
        i, place = order[last], last
        while place > 0 and own[order[place - 1]] > own[i]:
            order[place] = order[place - 1]
            place -= 1
        order[place] = i


@inner
def _search(joint: Array, count: int, s: int, y: Array, S: Array, watch: Watch) -> int:
    """``best`` <- the largest jointly compatible set of ``order`` (count,), by branch and bound; returns its size.

    At each level an observation is first taken, then left out. -1 where S is not positive definite.
    """
    size, total, branch, chosen = watch.size, watch.total, watch.branch, watch.chosen
    best, nearest, nodes, level = 0, 0.0, 0, 0
    size[0], total[0], branch[0] = 0, 0.0, 0
    while level >= 0:
        n, far = size[level], total[level]
        if level == count:
            if far <= joint[n] and (n > best or (n == best and far < nearest)):
                best, nearest = n, far
                for i in range(n):
                    watch.best[i] = chosen[i]
            level -= 1
            continue
        if branch[level] == 2:
            level -= 1
            continue
        nodes += 1
        if nodes > MOST_NODES:
            break
        branch[level] += 1
        if branch[level] == 1:
            far += added_distance(watch.order[level], n, s, y, S, watch)
            if np.isnan(far):
                return -1
            chosen[n] = watch.order[level]
            n += 1
        most = n + count - level - 1
        if (most > best or (most == best and far < nearest)) and far <= joint[most]:
            level += 1
            size[level], total[level], branch[level] = n, far, 0
    return best
