"""The guard of compiled filters: the rules of ``filters.guard`` in kernels, and the part that applies them.

It is one part for all kinds of guards, so that a filter behind any of them has one kernel.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from consistency.bench.filters.compiler.dispatch import implement, part
from consistency.bench.filters.compiler.jit import inner
from consistency.bench.filters.guard import MOST_NODES, limits_of
from consistency.bench.filters.kernel.part_functions import (
    Data,
    Slam,
    State,
    make_guard_arrays,
    may_enter,
    observed_width,
    predict_innovation,
    rejected_rows,
    screen,
    withhold,
)
from consistency.bench.filters.kernel.update_steps import INNOVATION, Scratch
from consistency.bench.scenario import GuardSettings
from consistency.bench.types import GUARDS
from consistency.referee.types import Array, Indices


class GuardArrays(NamedTuple):
    """For M rows of data, up to m landmarks in a step, and s values of each."""

    rejected: Array  # (M,) which rows the filter is not given, or has forgotten
    sightings: Indices  # (n_landmarks,)
    misses: Indices  # (n_landmarks,) rejected one after the other, up to the last
    begun: Indices  # (n_landmarks,) row with which each landmark began, until another agrees with it; then -1
    again: Array  # (M,) rows with which a landmark restarts
    kept: Array  # (m,) of the known landmarks in a step
    own: Array  # (m,) squared distance of each alone
    order: Indices  # (m,) those that pass the gate
    root: Array  # (s m, s m) lower root of S of the chosen ones
    white: Array  # (s m,) their innovation divided by it
    chosen: Indices  # (m,)
    best: Indices  # (m,)
    size: Indices  # (m + 1,) of a search: how many are chosen at each level
    total: Array  # (m + 1,) their squared distance
    branch: Indices  # (m + 1,) how many branches have been followed


@inner
def added_distance(i: int, count: int, s: int, y: Array, S: Array, of_guard: GuardArrays) -> float:
    """By how much observation i adds to the squared distance of the ``count`` chosen ones; NaN if S is not definite.

    That is its own squared distance after an update with those. ``root`` and ``white`` get its rows behind theirs.
    """
    root, white, added = of_guard.root, of_guard.white, 0.0
    for a in range(s):
        row, p = s * count + a, s * i + a
        for g in range(count + 1):
            first = s * (of_guard.chosen[g] if g < count else i)
            for e in range(s if g < count else a + 1):
                c, q = s * g + e, first + e
                rest = S[p, q] if p < q else S[q, p]
                for b in range(c):
                    rest -= root[row, b] * root[c, b]
                if c < row:
                    root[row, c] = rest / root[c, c]
                elif rest > 0.0:
                    root[row, row] = np.sqrt(rest)
                else:
                    return np.nan
        rest = y[p]
        for b in range(row):
            rest -= root[row, b] * white[b]
        white[row] = rest / root[row, row]
        added += white[row] * white[row]
    return added


@inner
def pass_gate(limit: float, s: int, m: int, y: Array, S: Array, of_guard: GuardArrays) -> int:
    """``own`` (m,) <- squared distances, ``kept`` (m,) <- whether each is within ``limit``; returns how many are.

    -1 where S is not positive definite.
    """
    count = 0
    for i in range(m):
        of_guard.own[i] = added_distance(i, 0, s, y, S, of_guard)
        if not of_guard.own[i] >= 0.0:
            return -1
        of_guard.kept[i] = of_guard.own[i] <= limit
        if of_guard.kept[i]:
            of_guard.order[count] = i
            count += 1
    return count


@inner
def keep_compatible(joint: Array, count: int, s: int, m: int, y: Array, S: Array, of_guard: GuardArrays) -> bool:
    """``kept`` (m,) <- the largest jointly compatible set of the ``count`` that passed the gate."""
    _sort_by_distance(count, of_guard)
    best = _search(joint, count, s, y, S, of_guard)
    for i in range(m):
        of_guard.kept[i] = False
    for i in range(best):
        of_guard.kept[of_guard.best[i]] = True
    return best >= 0


@inner
def _sort_by_distance(count: int, of_guard: GuardArrays) -> None:
    """``order`` (count,) <- nearest first; a stable insertion sort, for there are few."""
    order, own = of_guard.order, of_guard.own
    for last in range(1, count):
        i, place = order[last], last
        while place > 0 and own[order[place - 1]] > own[i]:
            order[place] = order[place - 1]
            place -= 1
        order[place] = i


@inner
def _search(joint: Array, count: int, s: int, y: Array, S: Array, of_guard: GuardArrays) -> int:
    """``best`` <- the largest jointly compatible set of ``order`` (count,), by branch and bound; returns its size.

    At each level an observation is first taken, then left out. -1 where S is not positive definite.
    """
    size, total, branch, chosen = of_guard.size, of_guard.total, of_guard.branch, of_guard.chosen
    best, nearest, nodes, level = 0, 0.0, 0, 0
    size[0], total[0], branch[0] = 0, 0.0, 0
    while level >= 0:
        n, far = size[level], total[level]
        if level == count:
            if far <= joint[n] and (n > best or (n == best and far < nearest)):
                best, nearest = n, far
                for i in range(n):
                    of_guard.best[i] = chosen[i]
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
            far += added_distance(of_guard.order[level], n, s, y, S, of_guard)
            if np.isnan(far):
                return -1
            chosen[n] = of_guard.order[level]
            n += 1
        most = n + count - level - 1
        if (most > best or (most == best and far < nearest)) and far <= joint[most]:
            level += 1
            size[level], total[level], branch[level] = n, far, 0
    return best


@inner
def keep_supported(
    own: float, support: float, count: int, s: int, m: int, y: Array, S: Array, of_guard: GuardArrays
) -> bool:
    """``kept`` (m,) <- what supports the best hypothesis and what is rescued, of the ``count`` that passed the gate.

    ``own`` and ``support`` are the squared distances up to which an observation passes the gate and supports.
    """
    best = _best_hypothesis(support, count, s, y, S, of_guard)
    for i in range(m):
        of_guard.kept[i] = False
    if best < 0:
        return True
    low = _list_support(best, support, count, s, y, S, of_guard)
    for i in range(low):
        of_guard.chosen[i] = of_guard.best[i]
        of_guard.kept[of_guard.best[i]] = True
        if not added_distance(of_guard.best[i], i, s, y, S, of_guard) >= 0.0:
            return False
    for c in range(count):
        i = of_guard.order[c]
        of_guard.kept[i] = of_guard.kept[i] or added_distance(i, low, s, y, S, of_guard) <= own  # rescued
    return True


@inner
def _best_hypothesis(support: float, count: int, s: int, y: Array, S: Array, of_guard: GuardArrays) -> int:
    """The observation with most support, the nearest of several; -1 if there is none."""
    best, most = -1, 0
    for c in range(count):
        i = of_guard.order[c]
        supporters = _list_support(i, support, count, s, y, S, of_guard)
        if supporters > most or (supporters == most and of_guard.own[i] < of_guard.own[best]):
            best, most = i, supporters
    return best


@inner
def _list_support(
    hypothesis: int, support: float, count: int, s: int, y: Array, S: Array, of_guard: GuardArrays
) -> int:
    """``best`` <- the hypothesis and what it leaves within ``support``, in order; returns how many."""
    found = 0
    added_distance(hypothesis, 0, s, y, S, of_guard)
    of_guard.chosen[0] = hypothesis
    for c in range(count):
        i = of_guard.order[c]
        if i == hypothesis or added_distance(i, 1, s, y, S, of_guard) <= support:
            of_guard.best[found] = i
            found += 1
    return found


JOINT, RANSAC = list(GUARDS).index("joint"), list(GUARDS).index("ransac")


@part()
class Guard(NamedTuple):
    """Squared distances up to which 0, 1, ... observations are accepted together, and one supports a hypothesis.

    A track is used from ``min_age`` sightings on, and ended by ``forget_after`` rejections in a row, none if it is 0.
    """

    kind: int  # JOINT, RANSAC, or a gate of each observation alone (Cox 1993)
    min_age: int
    forget_after: int
    joint: Array  # (m + 1,)
    support: float


def guard_part(kind: str, settings: GuardSettings, s: int, m: int) -> Guard:
    """A guard of up to ``m`` landmarks in a step, each with ``s`` values."""
    limits = limits_of(settings, s, m)
    return Guard(list(GUARDS).index(kind), settings.min_age, settings.forget_after or 0, limits.joint, limits.support)


@implement(make_guard_arrays, Guard)
def guard_arrays(guard: Guard, s: int, m: int, rows: int, n_landmarks: int) -> GuardArrays:
    return GuardArrays(
        np.zeros(rows, np.bool_),
        np.zeros(n_landmarks, np.int64),
        np.zeros(n_landmarks, np.int64),
        np.full(n_landmarks, -1),
        np.zeros(rows, np.bool_),
        np.zeros(m, np.bool_),
        np.zeros(m),
        np.zeros(m, np.int64),
        np.zeros((s * m, s * m)),
        np.zeros(s * m),
        np.zeros(m, np.int64),
        np.zeros(m, np.int64),
        np.zeros(m + 1, np.int64),
        np.zeros(m + 1),
        np.zeros(m + 1, np.int64),
    )


@implement(screen, Guard)
def screen_known(
    guard: Guard,
    slam: Slam,
    state: State,
    data: Data,
    k: int,
    m: int,
    of_covariance: NamedTuple,
    scratch: Scratch[NamedTuple],
    of_guard: GuardArrays,
) -> tuple[int, int, bool]:
    """First by the track, then by what the filter expects of the landmarks that it knows."""
    m = _screen_tracks(guard, state.offset, data, k, m, scratch, of_guard)
    withhold(slam.covariance, state, data, k, of_guard.rejected, of_guard.again, of_covariance)
    if m == 0:
        return 0, 0, False
    code, _ = predict_innovation(slam.update, slam, state, data, k, m, of_covariance, scratch)
    if code > 0:
        return code, m, False
    s = observed_width(slam.sensor)
    if not keep_agreeing(guard, s, m, scratch.A[: s * m, state.n + state.base], scratch.S, of_guard):
        return INNOVATION, m, False
    for i in range(m):
        row, label, kept = scratch.known[i], scratch.label[i], of_guard.kept[i]
        of_guard.rejected[row] = not kept
        of_guard.misses[label] = 0 if kept else of_guard.misses[label] + 1
        of_guard.again[row] = not kept and of_guard.begun[label] >= 0
        if kept:
            of_guard.begun[label] = -1
    left = _without_rejected(m, scratch, of_guard)
    if left < m:
        withhold(slam.covariance, state, data, k, of_guard.rejected, of_guard.again, of_covariance)
        _restart(data, k, of_guard)
    return 0, left, left == m


@inner
def keep_agreeing(guard: Guard, s: int, m: int, y: Array, S: Array, of_guard: GuardArrays) -> bool:
    """``of_guard.kept`` (m,) <- which of ``m`` observations to keep, by innovation (s m,) and the upper half of S.

    False where S is not positive definite.
    """
    count = pass_gate(guard.joint[1], s, m, y, S, of_guard)
    if count >= 0 and guard.kind == JOINT:
        return keep_compatible(guard.joint, count, s, m, y, S, of_guard)
    if count >= 0 and guard.kind == RANSAC:
        return keep_supported(guard.joint[1], guard.support, count, s, m, y, S, of_guard)
    return count >= 0


@inner
def _screen_tracks(
    guard: Guard, offset: Indices, data: Data, k: int, m: int, scratch: Scratch[NamedTuple], of_guard: GuardArrays
) -> int:
    """Rejects observations of tracks that are too young or given up; returns how many known landmarks are left."""
    for i in range(data.first[k], data.first[k + 1]):
        label = data.landmark[i]
        of_guard.sightings[label] += 1
        is_given_up = 0 < guard.forget_after <= of_guard.misses[label]
        of_guard.rejected[i] = is_given_up or of_guard.sightings[label] < guard.min_age
        if offset[label] < 0 and not of_guard.rejected[i]:
            of_guard.begun[label] = i
    return _without_rejected(m, scratch, of_guard)


@inner
def _restart(data: Data, k: int, of_guard: GuardArrays) -> None:
    """What a landmark began with is rejected, where it restarts with the first that disagrees."""
    for i in range(data.first[k], data.first[k + 1]):
        if of_guard.again[i]:
            label = data.landmark[i]
            of_guard.rejected[of_guard.begun[label]], of_guard.rejected[i] = True, False
            of_guard.begun[label] = i


@inner
def _without_rejected(m: int, scratch: Scratch[NamedTuple], of_guard: GuardArrays) -> int:
    left = 0
    for i in range(m):
        if not of_guard.rejected[scratch.known[i]]:
            scratch.known[left], scratch.label[left], scratch.at[left] = (
                scratch.known[i],
                scratch.label[i],
                scratch.at[i],
            )
            left += 1
    return left


@implement(may_enter, Guard)
def enters_unless_rejected(guard: Guard, row: int, is_known: bool, of_guard: GuardArrays) -> bool:
    return of_guard.again[row] if is_known else not of_guard.rejected[row]


@implement(rejected_rows, Guard)
def rejected_of(guard: Guard, of_guard: GuardArrays) -> Array:
    return of_guard.rejected.copy()
