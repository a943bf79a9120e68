"""What the kernels of all guards share: tracks, the list of known landmarks, and distances."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from consistency.bench.filters.compiler.jit import inner
from consistency.bench.filters.kernel.gain import INNOVATION
from consistency.bench.filters.kernel.part_functions import (
    Data,
    Slam,
    State,
    keep_some,
    observed_width,
    predict_innovation,
    withhold,
)
from consistency.bench.filters.kernel.work_arrays import Work
from consistency.referee.types import Array, Indices


class Tracks(NamedTuple):
    """Sightings from which a track is used, and rejections in a row that end it; 0 where none do."""

    min_age: int
    forget_after: int


class Watch(NamedTuple):
    """For M rows of data, up to m landmarks in a step, and s values of each."""

    rejected: Array  # (M,) which rows the filter is not given, or has forgotten
    sightings: Indices  # (n_landmarks,)
    misses: Indices  # (n_landmarks,) rejected one after the other, up to the last
    begun: Indices  # (n_landmarks,) row with which each landmark began, until another agrees with it; then -1
    anew: Array  # (M,) rows with which a landmark begins anew
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
def watch_tracks(guard: NamedTuple, s: int, m: int, rows: int, n_landmarks: int) -> Watch:
    """Nothing rejected, nothing seen."""
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


@inner
def screen_known(
    guard: Any,
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
    m = _screen_tracks(guard.tracks, state.offset, data, k, m, work, watch)
    withhold(slam.covariance, state, data, k, watch.rejected, watch.anew, local)
    if m == 0:
        return 0, 0, False
    code, _ = predict_innovation(slam.update, slam, state, data, k, m, local, work)
    if code > 0:
        return code, m, False
    s = observed_width(slam.sensor)
    if not keep_some(guard, s, m, work.A[: s * m, state.n + state.base], work.S, watch):
        return INNOVATION, m, False
    for i in range(m):
        row, label, kept = work.known[i], work.label[i], watch.kept[i]
        watch.rejected[row] = not kept
        watch.misses[label] = 0 if kept else watch.misses[label] + 1
        watch.anew[row] = not kept and watch.begun[label] >= 0
        if kept:
            watch.begun[label] = -1
    left = _without_rejected(m, work, watch)
    if left < m:
        withhold(slam.covariance, state, data, k, watch.rejected, watch.anew, local)
        _begin_anew(data, k, watch)
    return 0, left, left == m


@inner
def _screen_tracks(
    tracks: Tracks, offset: Indices, data: Data, k: int, m: int, work: Work[NamedTuple], watch: Watch
) -> int:
    """Rejects observations of tracks that are too young or given up; returns how many known landmarks are left."""
    for i in range(data.first[k], data.first[k + 1]):
        label = data.landmark[i]
        watch.sightings[label] += 1
        is_given_up = 0 < tracks.forget_after <= watch.misses[label]
        watch.rejected[i] = is_given_up or watch.sightings[label] < tracks.min_age
        if offset[label] < 0 and not watch.rejected[i]:
            watch.begun[label] = i
    return _without_rejected(m, work, watch)


@inner
def _begin_anew(data: Data, k: int, watch: Watch) -> None:
    """What a landmark began with is rejected, where it begins anew with the first that disagrees."""
    for i in range(data.first[k], data.first[k + 1]):
        if watch.anew[i]:
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


@inner
def enters_unless_rejected(guard: NamedTuple, row: int, is_known: bool, watch: Watch) -> bool:
    """A new landmark begins with an observation that was not rejected."""
    return watch.anew[row] if is_known else not watch.rejected[row]


@inner
def rejected_of(guard: NamedTuple, watch: Watch) -> Array:
    """The rows that were rejected, (M,)."""
    return watch.rejected.copy()


@inner
def added_distance(i: int, count: int, s: int, y: Array, S: Array, watch: Watch) -> float:
    """By how much observation i adds to the squared distance of the ``count`` chosen ones; NaN if S is not definite.

    That is its own squared distance after an update with those. ``root`` and ``white`` get its rows behind theirs.
    """
    root, white, added = watch.root, watch.white, 0.0
    for a in range(s):
        row, p = s * count + a, s * i + a
        for g in range(count + 1):
            first = s * (watch.chosen[g] if g < count else i)
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
def pass_gate(limit: float, s: int, m: int, y: Array, S: Array, watch: Watch) -> int:
    """``own`` (m,) <- squared distances, ``kept`` (m,) <- whether each is within ``limit``; returns how many are.

    -1 where S is not positive definite.
    """
    count = 0
    for i in range(m):
        watch.own[i] = added_distance(i, 0, s, y, S, watch)
        if not watch.own[i] >= 0.0:
            return -1
        watch.kept[i] = watch.own[i] <= limit
        if watch.kept[i]:
            watch.order[count] = i
            count += 1
    return count
