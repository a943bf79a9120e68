"""The part of a kernel that is a guard: one for all kinds, so that a filter behind any of them has one kernel."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from consistency.bench.filters.compiler.dispatch import implement, part
from consistency.bench.filters.compiler.jit import inner
from consistency.bench.filters.guard.kernel_rules import Watch, keep_compatible, keep_supported, pass_gate
from consistency.bench.filters.guard.plain_rules import KINDS, limits_of
from consistency.bench.filters.kernel.part_functions import (
    Data,
    Slam,
    State,
    make_watch,
    may_enter,
    observed_width,
    predict_innovation,
    rejected_rows,
    screen,
    withhold,
)
from consistency.bench.filters.kernel.update_steps import INNOVATION
from consistency.bench.filters.kernel.work_arrays import Work
from consistency.bench.scenario import GuardSettings
from consistency.referee.types import Array, Indices

JOINT, RANSAC = list(KINDS).index("joint"), list(KINDS).index("ransac")


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
    return Guard(list(KINDS).index(kind), settings.min_age, settings.forget_after or 0, limits.joint, limits.support)


@implement(make_watch, Guard)
def watch_tracks(guard: Guard, s: int, m: int, rows: int, n_landmarks: int) -> Watch:
    return Watch(
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
    local: NamedTuple,
    work: Work[NamedTuple],
    watch: Watch,
) -> tuple[int, int, bool]:
    """First by the track, then by what the filter expects of the landmarks that it knows."""
    m = _screen_tracks(guard, state.offset, data, k, m, work, watch)
    withhold(slam.covariance, state, data, k, watch.rejected, watch.again, local)
    if m == 0:
        return 0, 0, False
    code, _ = predict_innovation(slam.update, slam, state, data, k, m, local, work)
    if code > 0:
        return code, m, False
    s = observed_width(slam.sensor)
    if not keep_agreeing(guard, s, m, work.A[: s * m, state.n + state.base], work.S, watch):
        return INNOVATION, m, False
    for i in range(m):
        row, label, kept = work.known[i], work.label[i], watch.kept[i]
        watch.rejected[row] = not kept
        watch.misses[label] = 0 if kept else watch.misses[label] + 1
        watch.again[row] = not kept and watch.begun[label] >= 0
        if kept:
            watch.begun[label] = -1
    left = _without_rejected(m, work, watch)
    if left < m:
        withhold(slam.covariance, state, data, k, watch.rejected, watch.again, local)
        _begin_anew(data, k, watch)
    return 0, left, left == m


@inner
def keep_agreeing(guard: Guard, s: int, m: int, y: Array, S: Array, watch: Watch) -> bool:
    """``watch.kept`` (m,) <- which of ``m`` observations to keep, by innovation (s m,) and the upper half of S.

    False where S is not positive definite.
    """
    count = pass_gate(guard.joint[1], s, m, y, S, watch)
    if count >= 0 and guard.kind == JOINT:
        return keep_compatible(guard.joint, count, s, m, y, S, watch)
    if count >= 0 and guard.kind == RANSAC:
        return keep_supported(guard.joint[1], guard.support, count, s, m, y, S, watch)
    return count >= 0


@inner
def _screen_tracks(
    guard: Guard, offset: Indices, data: Data, k: int, m: int, work: Work[NamedTuple], watch: Watch
) -> int:
    """Rejects observations of tracks that are too young or given up; returns how many known landmarks are left."""
    for i in range(data.first[k], data.first[k + 1]):
        label = data.landmark[i]
        watch.sightings[label] += 1
        is_given_up = 0 < guard.forget_after <= watch.misses[label]
        watch.rejected[i] = is_given_up or watch.sightings[label] < guard.min_age
        if offset[label] < 0 and not watch.rejected[i]:
            watch.begun[label] = i
    return _without_rejected(m, work, watch)


@inner
def _begin_anew(data: Data, k: int, watch: Watch) -> None:
    """What a landmark began with is rejected, where it restarts with the first that disagrees."""
    for i in range(data.first[k], data.first[k + 1]):
        if watch.again[i]:
            label = data.landmark[i]
            watch.rejected[watch.begun[label]], watch.rejected[i] = True, False
            watch.begun[label] = i


@inner
def _without_rejected(m: int, work: Work[NamedTuple], watch: Watch) -> int:
    left = 0
    for i in range(m):
        if not watch.rejected[work.known[i]]:
            work.known[left], work.label[left], work.at[left] = work.known[i], work.label[i], work.at[i]
            left += 1
    return left


@implement(may_enter, Guard)
def enters_unless_rejected(guard: Guard, row: int, is_known: bool, watch: Watch) -> bool:
    return watch.again[row] if is_known else not watch.rejected[row]


@implement(rejected_rows, Guard)
def rejected_of(guard: Guard, watch: Watch) -> Array:
    return watch.rejected.copy()
