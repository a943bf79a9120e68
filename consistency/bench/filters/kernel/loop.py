"""The one loop over a trial that all compiled filters share."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from consistency.bench.filters.compiler.dispatch import by_reference, keep
from consistency.bench.filters.compiler.jit import Kernel, inner
from consistency.bench.filters.kernel.linalg import (
    copy,
    copy_matrix,
    definiteness_with,
    fill,
    fill_matrix,
    filled,
    filled_blocks,
    filled_matrix,
    integers,
    matrix,
    sum_of,
)
from consistency.bench.filters.kernel.part_functions import (
    Data,
    Slam,
    State,
    append,
    correct,
    held_at,
    insert_error,
    landmark_width,
    make_covariance_arrays,
    make_guard_arrays,
    may_enter,
    observed_width,
    place,
    pose_covariance,
    predict,
    prepare,
    rejected_rows,
    robot_frame,
    screen,
    settle,
    spare_width,
    to_error,
    world_point,
)
from consistency.bench.filters.kernel.update_steps import NOT_FINITE, POSE, Scratch, begin_landmark, make_scratch
from consistency.referee.types import Array, Indices


class Outcome(NamedTuple):
    """What a filter said of a trial of T steps; NaN from the step of a failure on."""

    pose: Array  # (T, 3)
    covariance: Array  # (T, 3, 3), of the additive error
    own: Array  # (T, 3, 3), of the filter's own error
    nis: Array  # (T,)
    nis_dof: Indices  # (T,)
    log_det: Array  # (T,), of S
    step: int  # of the failure, or 0
    code: int  # of REASONS, or 0
    points: Array  # (n_landmarks, 3), landmarks in the world after the last step, NaN where none was seen
    spread: Array  # (n_landmarks, 3, 3), and their covariances
    joint: Array  # (3 + 3 K, 3 + 3 K), covariance of the robot and the K landmarks of these, additive errors
    rejected: Array  # (M,) observations that a guard rejected, or (0,)


@inner
def _find_known(data: Data, k: int, offset: Indices, scratch: Scratch[NamedTuple]) -> int:
    """Observations of step k + 1 whose landmark is in the state, their offsets, and how many they are."""
    m = 0
    for i in range(data.first[k], data.first[k + 1]):
        label = data.landmark[i]
        if offset[label] >= 0:
            scratch.known[m], scratch.label[m], scratch.at[m] = i, label, offset[label]
            m += 1
    return m


@inner
def _insert_new(
    slam: Slam,
    state: State,
    data: Data,
    k: int,
    of_covariance: NamedTuple,
    scratch: Scratch[NamedTuple],
    of_guard: NamedTuple,
) -> State:
    """The state with the landmarks that begin in step k + 1: at its end, or again at their place."""
    w = landmark_width(slam.landmark)
    x, P, n, base, offset = state.x, state.P, state.n, state.base, state.offset
    for i in range(data.first[k], data.first[k + 1]):
        label = data.landmark[i]
        o = offset[label]
        if may_enter(slam.guard, i, o >= 0, of_guard):
            if o < 0:
                o = offset[label] = n if o == -1 else -1 - o
                n = max(n, o + w)
            place(slam.point, slam, State(x, P, o, base, offset), k, label, data.z[i], scratch)
            insert_error(slam.error, x[:3], x[o : o + w], scratch.Jp)
            append(slam.covariance, slam, State(x, P, n, base, offset), label, of_covariance, scratch)
            begin_landmark(P, n, o, scratch.Jp, scratch.Jz, data.R[i])
    return State(x, P, n, base, offset)


@inner
def _step(
    slam: Slam,
    state: State,
    data: Data,
    k: int,
    of_covariance: NamedTuple,
    scratch: Scratch[NamedTuple],
    of_guard: NamedTuple,
) -> tuple[State, int, int, float, float]:
    """Step k + 1: the state after it, a code of REASONS or 0, the landmarks in the update, the NIS, and log det S."""
    predict(slam.update, slam, state, k, data.controls[k], of_covariance, scratch)
    m, nis, log_det = _find_known(data, k, state.offset, scratch), np.nan, np.nan
    code, m, has_innovation = screen(slam.guard, slam, state, data, k, m, of_covariance, scratch, of_guard)
    if code > 0:
        return state, code, 0, nis, log_det
    if m > 0:
        scratch.used[0] = m
        code, nis, log_det = correct(slam.update, slam, state, data, k, m, has_innovation, of_covariance, scratch)
        m = scratch.used[0]
        if code > 0:
            return state, code, 0, nis, log_det
    state = _insert_new(slam, state, data, k, of_covariance, scratch, of_guard)
    return state, 0 if np.isfinite(sum_of(state.x[: state.n])) else NOT_FINITE, m, nis, log_det


@inner
def _most_seen(first: Indices) -> int:
    """The most landmarks seen in a step, of first (T + 1,)."""
    most = 0
    for k in range(len(first) - 1):
        most = max(most, first[k + 1] - first[k])
    return most


@inner
def _map(slam: Slam, state: State, of_covariance: NamedTuple, points: Array, spread: Array) -> Array:
    """``points``, ``spread`` <- the landmarks in the world, as ``Outcome`` has them; returns its ``joint``, D P D'."""
    w, P = landmark_width(slam.landmark), state.P
    width, count = 3 + w, 1
    for label in range(len(points)):
        count += 1 if state.offset[label] >= 0 else 0
    D, at, block = filled_blocks(count, 3, width, 0.0), integers(count * width, 0), matrix(width, width)
    for a in range(3):
        D[0, a, a], at[a] = 1.0, a
    to_error(slam.error, state.x[:3], filled(w, 1.0), D[0, :, :3], D[0, :, 3:])
    i, n = 0, 3
    for label in range(len(points)):
        o = state.offset[label]
        if o >= 0:
            i += 1
            pose_at, own = held_at(slam.covariance, label, of_covariance), at[width * i : width * i + width]
            pose, values = state.x[pose_at : pose_at + 3], state.x[o : o + w]
            world_point(slam.landmark, robot_frame(pose), values, points[label], D[i, :, :3], D[i, :, 3:])
            to_error(slam.error, pose, values, D[i, :, :3], D[i, :, 3:])
            for a in range(width):
                own[a] = pose_at + a if a < 3 else o + a - 3
                n = max(n, own[a] + 1)
            for a in range(width):
                for b in range(a, width):
                    block[a, b] = block[b, a] = P[min(own[a], own[b]), max(own[a], own[b])]
            _transform(D[i], block, spread[label])
    joint, rows = matrix(3 * count, 3 * count), matrix(3, n)
    for i in range(count):
        fill_matrix(rows, 0.0)
        for b in range(width):
            p, d0, d1, d2 = at[width * i + b], D[i, 0, b], D[i, 1, b], D[i, 2, b]
            for q in range(n):
                value = P[min(p, q), max(p, q)]
                rows[0, q] += d0 * value
                rows[1, q] += d1 * value
                rows[2, q] += d2 * value
        for j in range(i, count):
            for a in range(3):
                for b in range(3):
                    total = 0.0
                    for c in range(width):
                        total += rows[a, at[width * j + c]] * D[j, b, c]
                    joint[3 * i + a, 3 * j + b] = joint[3 * j + b, 3 * i + a] = total
    return joint


@inner
def _transform(D: Array, P: Array, out: Array) -> None:
    """``out`` (m, m) <- D P D', with D (m, n)."""
    for i in range(len(out)):
        for j in range(len(out)):
            total = 0.0
            for a in range(len(P)):
                for b in range(len(P)):
                    total += D[i, a] * P[a, b] * D[j, b]
            out[i, j] = total


class Memory(NamedTuple):
    """All arrays of a trial."""

    x: Array
    P: Array
    active: Indices  # (n_landmarks,) offset of each landmark in the active part, or -1
    home: Indices  # and in the whole state


@inner
def _empty_outcome(T: int, n_landmarks: int) -> Outcome:
    """Outcome of T steps, NaN everywhere."""
    return Outcome(
        filled_matrix(T, 3, np.nan),
        filled_blocks(T, 3, 3, np.nan),
        filled_blocks(T, 3, 3, np.nan),
        filled(T, np.nan),
        integers(T, 0),
        filled(T, np.nan),
        0,
        0,
        filled_matrix(n_landmarks, 3, np.nan),
        filled_blocks(n_landmarks, 3, 3, np.nan),
        matrix(0, 0),
        np.empty(0, np.bool_),
    )


@inner
def _keep_pose(slam: Slam, state: State, k: int, out: Outcome, scratch: Scratch[NamedTuple]) -> int:
    """Estimate of step k + 1; returns the rank of its own covariance as ``definiteness`` says it.

    -1 too where the covariance of the additive error has lost its rank to rounding.
    """
    copy_matrix(state.P[:3, :3], out.own[k])
    copy(state.x[:3], out.pose[k])
    pose_covariance(slam.error, out.pose[k], out.own[k], out.covariance[k])
    rank = definiteness_with(out.own[k], scratch.small)
    return -1 if rank == 1 and definiteness_with(out.covariance[k], scratch.small) < 1 else rank


@inner
def _settle_new(labels: Indices, n: int, w: int, state: State, home: Indices) -> int:
    """Places of the landmarks that are new, from ``n`` on if updating is local; returns the size of the whole."""
    if state.base == 0:
        copy(state.offset, home)
        return state.n
    for label in labels:
        if home[label] == -1 and state.offset[label] >= 0:  # a guard may have kept it out
            home[label] = n
            n += w
    for label in range(len(home)):  # forgotten in this step, or begun again
        if (state.offset[label] < -1 and home[label] >= 0) or (state.offset[label] >= 0 and home[label] < -1):
            home[label] = -1 - home[label]
    return n


def run_trial(own_slam: Slam, own_data: Data, size: int) -> Outcome:
    """Filter a whole trial whose state grows to at most ``size`` variables.

    The loop stands here, not in a function of its own: compiling such a function a second time, as a part of this one,
    would take a tenth of the whole.
    """
    slam, data = by_reference(own_slam), by_reference(own_data)
    T, w = len(data.controls), landmark_width(slam.landmark)
    size += spare_width(slam.covariance, T, data.n_landmarks)
    labels, most = data.n_landmarks, _most_seen(data.first)
    own_memory = Memory(filled(size, 0.0), filled_matrix(size, size, 0.0), integers(labels, -1), integers(labels, -1))
    own_out, own_scratch = _empty_outcome(T, labels), make_scratch(slam, size, most, T, labels)
    own_covariance_arrays = make_covariance_arrays(slam.covariance, w, size, T, labels)
    own_guard_arrays = make_guard_arrays(slam.guard, observed_width(slam.sensor), most, len(data.landmark), labels)
    memory, scratch, of_covariance, out = (
        by_reference(own_memory),
        by_reference(own_scratch),
        by_reference(own_covariance_arrays),
        by_reference(own_out),
    )
    of_guard = by_reference(own_guard_arrays)
    copy(data.start, memory.x[:3])
    whole = State(memory.x, memory.P, 3, 0, memory.home)
    state = State(memory.x, memory.P, 3, 0, memory.active)  # of a step: the whole, unless it has a base
    full_rank, step, code = False, 0, 0
    for k in range(T):
        seen = data.landmark[data.first[k] : data.first[k + 1]]
        whole, state = prepare(slam.covariance, slam, whole, state, seen, of_covariance)
        state, code, m, nis, log_det = _step(slam, state, data, k, of_covariance, scratch, of_guard)
        if m > 0:
            out.nis[k], out.nis_dof[k], out.log_det[k] = nis, observed_width(slam.sensor) * m, log_det
        if code == 0:
            rank = _keep_pose(slam, state, k, out, scratch)
            if rank < 0 or (full_rank and rank == 0):
                code = POSE
                fill(out.pose[k], np.nan)
                fill_matrix(out.covariance[k], np.nan)
                fill_matrix(out.own[k], np.nan)
            full_rank = full_rank or rank == 1
        if code > 0:
            step = k + 1
            break
        whole = State(memory.x, memory.P, _settle_new(seen, whole.n, w, state, memory.home), 0, memory.home)
    if code == 0:
        settle(slam.covariance, slam, whole, state, of_covariance)
        joint = _map(slam, whole, of_covariance, out.points, out.spread)
    else:
        joint = matrix(0, 0)
    rejected = rejected_rows(slam.guard, own_guard_arrays)
    keep((own_slam, own_data, own_memory, own_scratch, own_covariance_arrays, own_guard_arrays))
    return Outcome(
        own_out.pose, own_out.covariance, own_out.own, own_out.nis, own_out.nis_dof, own_out.log_det, step, code,
        own_out.points, own_out.spread, joint, rejected,
    )  # fmt: skip


trial_kernel = Kernel(run_trial)
