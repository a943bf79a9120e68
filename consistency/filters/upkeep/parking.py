"""Landmarks that have not been seen for a while stay in the frame of a clone of the pose."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from consistency.filters.kernel.arrays import copy, fill_matrix
from consistency.filters.kernel.covariance import replace_rows
from consistency.filters.kernel.dispatch import implement, part
from consistency.filters.kernel.jit import inner
from consistency.filters.kernel.slam import Slam, State, append, held_at, make_local, prepare, settle, spare_width
from consistency.filters.kernel.work import Work
from consistency.types import Array, Indices


@part(landmark="InverseRange", error="InvariantPose", update="Converting")
class Parking(NamedTuple):
    """Steps between two rounds of parking, 0 for none, and without a sight before a landmark is parked."""

    every: int
    unseen: int


class Clones(NamedTuple):
    """Which landmarks are parked where."""

    of: Indices  # (n_landmarks,) number of the clone at which each is parked, or -1
    seen: Indices  # (n_landmarks,) step at which each was seen last
    at: Indices  # (clones,) offset of each clone in the state, 0 where it has none yet
    uses: Indices  # (clones,) landmarks parked at each
    step: Indices  # (1,) steps so far
    rows: Array  # (3, n)


@inner
def _most_clones(covariance: Parking, steps: int, n_landmarks: int) -> int:
    return min(steps // covariance.every, n_landmarks) if covariance.every > 0 else 0


@implement(spare_width, Parking)
def clones_width(covariance: Parking, steps: int, n_landmarks: int) -> int:
    return 3 * _most_clones(covariance, steps, n_landmarks)


@implement(make_local, Parking)
def make_clones(covariance: Parking, r: int, w: int, n: int, steps: int, n_landmarks: int) -> Clones:
    most = _most_clones(covariance, steps, n_landmarks)
    return Clones(
        np.full(n_landmarks, -1),
        np.zeros(n_landmarks, np.int64),
        np.zeros(most, np.int64),
        np.zeros(most, np.int64),
        np.zeros(1, np.int64),
        np.zeros((3, n)),
    )


@implement(prepare, Parking)
def prepare_parked(
    covariance: Parking, slam: Slam, whole: State, state: State, labels: Indices, local: Clones
) -> State:
    step = local.step[0]
    local.step[0] = step + 1
    due = covariance.every > 0 and step > 0 and step % covariance.every == 0
    if due and _is_any_idle(covariance, state, step, local):
        state = _park(covariance, state, step, local)
    for label in labels:
        local.seen[label] = step + 1
    return state


@inner
def _is_idle(covariance: Parking, state: State, label: int, step: int, local: Clones) -> bool:
    return state.offset[label] >= 0 and local.of[label] < 0 and step - local.seen[label] >= covariance.unseen


@inner
def _is_any_idle(covariance: Parking, state: State, step: int, local: Clones) -> bool:
    idle = False
    for label in range(len(local.of)):
        idle = idle or _is_idle(covariance, state, label, step, local)
    return idle


@inner
def _park(covariance: Parking, state: State, step: int, local: Clones) -> State:
    """Idle landmarks at a clone of the pose that has none; the state grows where there is no old place for it."""
    x, P, n = state.x, state.P, state.n
    number = 0
    while local.uses[number] > 0:
        number += 1
    o = local.at[number]
    if o == 0:
        o = local.at[number] = n
        n += 3
    for label in range(len(local.of)):
        if _is_idle(covariance, state, label, step, local):
            local.of[label] = number
            local.uses[number] += 1
    copy(x[:3], x[o : o + 3])
    for a in range(3):
        copy(P[a, :n], local.rows[a, :n])
    replace_rows(P, n, o, local.rows, P[:3, :3])
    return State(x, P, n, state.base, state.offset)


@inner
def unpark(label: int, state: State, local: Clones) -> None:
    """A landmark is active again; a clone that no landmark needs is left as a place for the next."""
    number = local.of[label]
    local.of[label] = -1
    local.uses[number] -= 1
    if local.uses[number] == 0:
        o = local.at[number]
        fill_matrix(local.rows[:, : state.n], 0.0)
        replace_rows(state.P, state.n, o, local.rows, local.rows[:, :3])
        for a in range(3):
            state.x[o + a] = 0.0


@implement(append, Parking)
def append_active(
    covariance: Parking, slam: Slam, state: State, label: int, local: Clones, work: Work[NamedTuple]
) -> None:
    pass


@implement(held_at, Parking)
def held_at_clone(covariance: Parking, label: int, local: Clones) -> int:
    return local.at[local.of[label]] if local.of[label] >= 0 else 0


@implement(settle, Parking)
def settle_no_clone(covariance: Parking, slam: Slam, whole: State, state: State, local: Clones) -> None:
    pass
