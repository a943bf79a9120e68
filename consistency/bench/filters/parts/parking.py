"""Landmarks that have not been seen for a while stay in the frame of a clone of the pose.

Nothing moves them there, so that they and the clones are the passive part of a state that is updated locally
(:mod:`consistency.bench.filters.parts.local`): the active part is the robot, the landmarks in use, and what
was seen again since the split. A clone is Exp(xi) T with the pose T at which it was made and xi in the state, so that
what a step says of it is a sum.
"""

from __future__ import annotations

from typing import NamedTuple

from consistency.bench.filters.compiler.dispatch import implement, part
from consistency.bench.filters.compiler.jit import inner
from consistency.bench.filters.kernel.linalg import copy, fill, fill_matrix, filled_matrix, integers, matrix
from consistency.bench.filters.kernel.part_functions import (
    Data,
    Factors,
    Slam,
    State,
    append,
    held_at,
    make_covariance_arrays,
    make_factors,
    prepare,
    settle,
    spare_width,
    withhold,
)
from consistency.bench.filters.kernel.update_steps import Scratch, gather_rows, replace_rows
from consistency.bench.filters.parts.invariant_pose import left_jacobian, move_pose
from consistency.bench.filters.parts.local import LOCAL_FROM, add_label, append_rows, join, take_out, wake
from consistency.referee.types import Array, Indices

WORTH = 1.1  # variables of the whole state for each of active part and base from which updating is local; measured


@part(landmark="InverseRange", error="InvariantPose", update="Converting")
class Parking(NamedTuple):
    """Steps between two rounds of parking, 0 for none, and without a sight before a landmark is parked.

    A return is in doubt where the variance of the turn since the clone is above ``doubt``, rad^2, or that of the
    heading above ``adrift``; if ``whole``, a step with such a return works on the whole state. With ``patience`` a
    round waits while the robot sees nothing, and saw something less than ``unseen`` steps ago. ``start`` is the number
    of variables in the state from which updates are local.
    """

    every: int
    unseen: int
    doubt: float
    adrift: float
    whole: bool
    patience: bool
    start: int = LOCAL_FROM


class Clones(NamedTuple):
    """Which landmarks are parked where."""

    of: Indices  # (n_landmarks,) number of the clone at which each is parked, or -1
    seen: Indices  # (n_landmarks,) step at which each was seen last
    earlier: Indices  # (n_landmarks,) and before that, of what is seen in this step
    doubt: Indices  # (n_landmarks,) of that, 1 if its return is in doubt, 2 if it was seen in the last step, too
    at: Indices  # (clones,) offset of each clone in the whole state, 0 where it has none yet
    here: Indices  # (clones,) and in the variables of a step, 0 where it is in the passive rest
    uses: Indices  # (clones,) landmarks parked at each
    made: Indices  # (clones,) step at which each was made
    doubted: Indices  # (clones,) 1 if a return there is in doubt in this step, 2 if it was in the last, too
    origin: Array  # (clones, 3) pose T of each
    step: Indices  # (1,) steps so far
    due: Indices  # (1,) 1 while a round of parking is due
    rows: Array  # (9, n)
    factors: Factors


@inner
def _most_clones(covariance: Parking, steps: int, n_landmarks: int) -> int:
    return min(steps // covariance.every, n_landmarks) if covariance.every > 0 else 0


@implement(spare_width, Parking)
def clones_width(covariance: Parking, steps: int, n_landmarks: int) -> int:
    return 3 * _most_clones(covariance, steps, n_landmarks)


@implement(make_covariance_arrays, Parking)
def make_clones(covariance: Parking, w: int, n: int, steps: int, n_landmarks: int) -> Clones:
    most = _most_clones(covariance, steps, n_landmarks)
    is_local = most > 0 and n >= covariance.start
    c = max(n // (2 * w), 1) * w if is_local else 3
    return Clones(
        integers(n_landmarks, -1),
        integers(n_landmarks, 0),
        integers(n_landmarks, 0),
        integers(n_landmarks, 0),
        integers(most, 0),
        integers(most, 0),
        integers(most, 0),
        integers(most, 0),
        integers(most, 0),
        filled_matrix(most, 3, 0.0),
        integers(1, 0),
        integers(1, 0),
        filled_matrix(9, n, 0.0),
        make_factors(c, n if is_local else 3, c // w),
    )


# --- a step --------------------------------------------------------------------------------------


@implement(prepare, Parking)
def prepare_parked(
    covariance: Parking, slam: Slam, whole: State, state: State, labels: Indices, parked: Clones
) -> tuple[State, State]:
    """Parks first where that is due; settles the active part before that, or where it has grown too large."""
    step = parked.step[0]
    parked.step[0] = step + 1
    if covariance.every > 0 and step > 0 and step % covariance.every == 0:
        parked.due[0] = 1
    due = parked.due[0] == 1 and not _must_wait(covariance, step, parked)
    if due:
        parked.due[0] = 0
    due = due and _is_any_idle(covariance, whole, step, parked)
    if state.base > 0 and (due or _is_crowded(whole, state, labels, parked)):
        state = _joined(slam, whole, state, parked)
    if due:
        whole = _park(covariance, whole, step, parked)
        state = State(whole.x, whole.P, whole.n, 0, state.offset)
    if state.base == 0:
        needs_whole = _needs_whole(covariance, state, labels, parked)
        if not needs_whole and whole.n >= covariance.start and _is_worth_it(whole, labels, parked):
            state = _split(covariance, whole, state.offset, parked)
    if state.base > 0:
        state = _call_back(covariance, whole, state, labels, parked)
        if _needs_whole(covariance, state, labels, parked):
            state = _joined(slam, whole, state, parked)
    for label in labels:
        parked.earlier[label] = parked.seen[label]
        parked.seen[label] = step + 1
    return whole, state


@implement(withhold, Parking)
def withhold_parked(
    covariance: Parking, state: State, data: Data, k: int, rejected: Array, again: Array, parked: Clones
) -> None:
    """What is rejected was not seen, and no return of it is in doubt."""
    fill(parked.doubted, 0)
    for i in range(data.first[k], data.first[k + 1]):
        label = data.landmark[i]
        if again[i] and parked.of[label] >= 0:
            unpark(label, state, parked)
        if rejected[i]:
            parked.seen[label] = parked.earlier[label]
        elif parked.of[label] >= 0:
            _note_doubt(label, parked)


@inner
def _note_doubt(label: int, parked: Clones) -> None:
    number = parked.of[label]
    parked.doubted[number] = max(parked.doubted[number], parked.doubt[label])


@inner
def _joined(slam: Slam, whole: State, state: State, parked: Clones) -> State:
    """All variables, after what the active part did to them."""
    join(slam, whole, state.n, state.base, parked.factors)
    copy(whole.offset, state.offset)
    copy(parked.at, parked.here)
    return State(whole.x, whole.P, whole.n, 0, state.offset)


@inner
def _needs_whole(covariance: Parking, state: State, labels: Indices, parked: Clones) -> bool:
    """Finds what of the ``labels`` returns in doubt, and whether that takes the whole state."""
    step, any_doubted = parked.step[0] - 1, False
    fill(parked.doubted, 0)
    for label in labels:
        number = parked.of[label]
        if number >= 0:
            parked.doubt[label] = 0
            if state.P[2, 2] > covariance.adrift or turn_variance(label, state, parked) > covariance.doubt:
                any_doubted = True
                parked.doubt[label] = 2 if parked.seen[label] == step else 1
                _note_doubt(label, parked)
    return any_doubted and covariance.whole


@inner
def is_new(label: int, parked: Clones) -> bool:
    """Whether a landmark of this step was not seen in the last one."""
    return parked.step[0] - parked.earlier[label] > 1


@inner
def is_out_of_sight(label: int, parked: Clones) -> bool:
    """Whether a landmark in use was not seen in the last step, whatever is seen in this."""
    step = parked.step[0]
    last = parked.earlier[label] if parked.seen[label] == step else parked.seen[label]
    return parked.of[label] < 0 and step - last > 1


@inner
def forget(label: int, state: State, parked: Clones) -> None:
    """Take a landmark in use out of the state, and keep its place for when it is seen again."""
    o = state.offset[label]
    clear(o, state, parked)
    state.offset[label] = -1 - o


@inner
def turn_variance(label: int, state: State, parked: Clones) -> float:
    """That of the turn since the clone at which a landmark of this step is parked, rad^2."""
    P, o = state.P, parked.here[parked.of[label]] + 2
    return float(P[2, 2] + P[o, o] - 2.0 * P[2, o])


@inner
def is_in_doubt(label: int, parked: Clones) -> bool:
    """Whether a landmark of this step is parked where the turn since then is little known."""
    return parked.of[label] >= 0 and parked.doubted[parked.of[label]] > 0


@implement(append, Parking)
def append_active(
    covariance: Parking, slam: Slam, state: State, label: int, parked: Clones, scratch: Scratch[NamedTuple]
) -> None:
    parked.seen[label] = parked.step[0]
    append_rows(slam, state, label, parked.factors, scratch.Jp)


# --- parking -------------------------------------------------------------------------------------


@inner
def _is_idle(covariance: Parking, whole: State, label: int, step: int, parked: Clones) -> bool:
    return whole.offset[label] >= 0 and parked.of[label] < 0 and step - parked.seen[label] >= covariance.unseen


@inner
def _must_wait(covariance: Parking, step: int, parked: Clones) -> bool:
    last = 0 if covariance.patience else step
    for label in range(len(parked.of)):
        last = max(last, parked.seen[label])
    return 0 < step - last < covariance.unseen


@inner
def _is_any_idle(covariance: Parking, whole: State, step: int, parked: Clones) -> bool:
    idle = False
    for label in range(len(parked.of)):
        idle = idle or _is_idle(covariance, whole, label, step, parked)
    return idle


@inner
def _park(covariance: Parking, whole: State, step: int, parked: Clones) -> State:
    """Idle landmarks at a clone of the pose that has none; the state grows where there is no old place for it."""
    x, P, n = whole.x, whole.P, whole.n
    number = 0
    while parked.uses[number] > 0:
        number += 1
    o = parked.at[number]
    if o == 0:
        o = n
        n += 3
    parked.at[number] = parked.here[number] = o
    parked.made[number] = step
    for label in range(len(parked.of)):
        if _is_idle(covariance, whole, label, step, parked):
            parked.of[label] = number
            parked.uses[number] += 1
    copy(x[:3], parked.origin[number])
    fill(x[o : o + 3], 0.0)
    for a in range(3):
        copy(P[a, :n], parked.rows[a, :n])
    replace_rows(P, n, o, parked.rows, P[:3, :3])
    return State(x, P, n, whole.base, whole.offset)


@inner
def unpark(label: int, state: State, parked: Clones) -> None:
    """A landmark is in use again; a clone that no landmark needs is left as a place for the next."""
    number = parked.of[label]
    parked.of[label] = -1
    parked.uses[number] -= 1
    if parked.uses[number] == 0:
        clear(parked.here[number], state, parked)


@inner
def clear(o: int, state: State, parked: Clones) -> None:
    """Nothing is left of the block at ``o``."""
    fill_matrix(parked.rows[:3, : state.n], 0.0)
    replace_rows(state.P, state.n, o, parked.rows, parked.rows[:, :3])
    fill(state.x[o : o + 3], 0.0)
    fill_matrix(parked.factors.Phi[o : o + 3, : state.base], 0.0)


@implement(held_at, Parking)
def held_at_clone(covariance: Parking, label: int, parked: Clones) -> int:
    return parked.at[parked.of[label]] if parked.of[label] >= 0 else 0


# --- local updating ------------------------------------------------------------------------------


@inner
def _is_worth_it(whole: State, labels: Indices, parked: Clones) -> bool:
    """Whether an active part of robot and landmarks in use, with a base as large, is small beside the whole.

    It must have room for what of the ``labels`` is new or called back, each with a clone.
    """
    n, more = 3, 0
    for label in range(len(parked.of)):
        if whole.offset[label] >= 0 and parked.of[label] < 0:
            n += 3
    for label in labels:
        if whole.offset[label] < 0:
            more += 3
        elif parked.of[label] >= 0:
            more += 6
    return n + more <= len(parked.factors.x) and 2.0 * WORTH * n <= whole.n


@inner
def _is_crowded(whole: State, state: State, labels: Indices, parked: Clones) -> bool:
    """Whether the next step has no room in the active part, or would cost more than one on the whole."""
    back = new = 0
    for label in labels:
        if whole.offset[label] < 0:
            new += 3
        elif state.offset[label] < 0:
            back += 6 if parked.here[parked.of[label]] == 0 else 3
    n = state.n + back
    return n + new > len(parked.factors.x) or n + state.base + back > whole.n


@inner
def _split(covariance: Parking, whole: State, offset: Indices, parked: Clones) -> State:
    """The robot and the landmarks in use become active; ``offset`` (n_landmarks,) <- that of each there, or -1."""
    f, n = parked.factors, 3
    fill(offset, -1)
    fill(parked.here, 0)
    for label in range(len(parked.of)):
        o = whole.offset[label]
        if o >= 0 and parked.of[label] < 0:
            add_label(label, o, n, n, 3, f)
            offset[label] = n
            n += 3
    take_out(covariance, 3, whole, n, f)
    return State(f.x, f.P, n, n, offset)


@inner
def _call_back(covariance: Parking, whole: State, active: State, labels: Indices, parked: Clones) -> State:
    """Passive ones of ``labels`` (m,), and their clones, become active and join the base."""
    f, n, b, more = parked.factors, active.n, active.base, 0
    for label in labels:
        if whole.offset[label] >= 0 and active.offset[label] < 0:
            number = parked.of[label]
            if parked.here[number] == 0:
                add_label(-1 - parked.at[number], parked.at[number], n + more, b + more, 3, f)
                parked.here[number] = n + more
                more += 3
            add_label(label, whole.offset[label], n + more, b + more, 3, f)
            active.offset[label] = n + more
            more += 3
    if more > 0:
        wake(covariance, 3, whole, n, b, more, f)
    return State(active.x, active.P, n + more, b + more, active.offset)


@implement(settle, Parking)
def settle_clones(covariance: Parking, slam: Slam, whole: State, state: State, parked: Clones) -> None:
    """``whole`` <- all variables; a clone <- its pose, with the covariance of the error about that."""
    if state.base > 0:
        join(slam, whole, state.n, state.base, parked.factors)
    recentre(State(whole.x, whole.P, whole.n, 0, whole.offset), parked)
    for number in range(len(parked.at)):
        if parked.uses[number] > 0:
            copy(parked.origin[number], whole.x[parked.at[number] : parked.at[number] + 3])


@inner
def recentre(state: State, parked: Clones) -> None:
    """Each clone of a whole state <- an error of zero about the pose that it has, and the covariance of that error."""
    x, P, n, rows = state.x, state.P, state.n, parked.rows
    turn, own, at = matrix(3, 3), matrix(3, 3), integers(1, 0)
    for number in range(len(parked.at)):
        if parked.uses[number] > 0:
            o = at[0] = parked.at[number]
            left_jacobian(x[o : o + 3], turn)
            gather_rows(P, n, 3, at, 1, rows[3:])
            for i in range(n):
                for a in range(3):
                    rows[a, i] = turn[a, 0] * rows[6, i] + turn[a, 1] * rows[7, i] + turn[a, 2] * rows[8, i]
            for a in range(3):
                for b in range(3):
                    own[a, b] = turn[b, 0] * rows[a, o] + turn[b, 1] * rows[a, o + 1] + turn[b, 2] * rows[a, o + 2]
            replace_rows(P, n, o, rows, own)
            move_pose(parked.origin[number], x[o : o + 3], turn[0])
            copy(turn[0], parked.origin[number])
            fill(x[o : o + 3], 0.0)
