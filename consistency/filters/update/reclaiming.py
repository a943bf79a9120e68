"""The update of a robot-centred map, linear for what is in use and iterated for what was parked."""

from __future__ import annotations

import numpy as np

from consistency.filters.error.invariant_pose import left_jacobian, move_pose
from consistency.filters.kernel.arrays import copy, fill, fill_matrix
from consistency.filters.kernel.blas import add_transposed_times
from consistency.filters.kernel.covariance import gather_rows, replace_rows, subtract_gram
from consistency.filters.kernel.dispatch import implement
from consistency.filters.kernel.gain import divide_by_root
from consistency.filters.kernel.jit import inner
from consistency.filters.kernel.slam import Data, Frame, State, correct, robot_frame
from consistency.filters.kernel.work import Work
from consistency.filters.landmark.inverse_range import carried
from consistency.filters.sensor.conversion import observe_range
from consistency.filters.update.converting import CentredSlam, Converting, ConvertingRoom
from consistency.filters.upkeep.parking import Clones, unpark
from consistency.types import Array

SETTLED = 1e-3  # change in standard deviations that ends an iteration
TEMPERED = 2.0  # decades by which the noise of parked landmarks is raised in the first pass; half a decade less in each


@implement(correct, Converting)
def correct_converted(
    update: Converting,
    slam: CentredSlam,
    state: State,
    data: Data,
    k: int,
    m: int,
    local: Clones,
    work: Work[ConvertingRoom],
) -> tuple[int, float]:
    P, n, room = state.P, state.n, work.room
    parked = _gather(state, m, local, work)
    fill(room.delta[:n], 0.0)
    passes = update.passes if parked > 0 else 1
    A, nis = work.A[: 3 * m, :n], np.nan
    for i in range(passes):
        copy(room.delta[:n], room.before[:n])
        _expect(update, slam, state, data, i, m, local, work)
        if passes > 1:
            _temper(m, max(1.0, 10.0 ** (TEMPERED - 0.5 * i)), room)
        total = _innovate(state, m, work)
        code, nis = divide_by_root(state, 3 * m, work, total)
        if code > 0:
            return code, nis
        fill(room.delta[:n], 0.0)
        add_transposed_times(A, work.A[: 3 * m, n], room.delta[:n])
        if i >= 2.0 * TEMPERED and _is_settled(P, n, room):
            break
    subtract_gram(P, n, 3, A)
    _move(update, state, parked, local, work)
    for i in range(m):
        if room.clone[i] >= 0:
            _activate(slam, state, work.label[i], local, work)
    return 0, nis


@inner
def _gather(state: State, m: int, local: Clones, work: Work[ConvertingRoom]) -> int:
    """Rows of P of all that the update involves; returns how many of the landmarks are parked."""
    room, parked = work.room, 0
    for i in range(m):
        room.at[i] = work.at[i]
        number = local.of[work.label[i]]
        room.clone[i] = -1
        if number >= 0:
            room.clone[i] = parked
            room.at[m + parked] = local.at[number]
            parked += 1
    gather_rows(state.P, state.n, 3, 3, room.at, m + parked, room.rows)
    return parked


@inner
def _seen_from(
    slam: CentredSlam, clone: Array, pose: Array, y: Array, there: Array, J: Array, shift: Array, D: Array
) -> None:
    """``there`` <- a landmark parked at ``clone`` as it is seen from ``pose``; its derivatives by y and by xi."""
    at, frame = robot_frame(slam.motion, clone), robot_frame(slam.motion, pose)
    c, s = frame.c, frame.s
    dx, dy = at.x - frame.x, at.y - frame.y
    turn = Frame(c * dx + s * dy, c * dy - s * dx, c * at.c + s * at.s, c * at.s - s * at.c)
    rho = y[2]
    b = carried(y, turn, slam.landmark.mount, there, J, D)
    wx, wy = c * b[0] - s * b[1] + rho * frame.x, s * b[0] + c * b[1] + rho * frame.y
    for a in range(3):
        shift[a, 0] = rho * (D[a, 0] * c - D[a, 1] * s)
        shift[a, 1] = rho * (D[a, 0] * s + D[a, 1] * c)
        shift[a, 2] = D[a, 0] * (s * wx - c * wy) + D[a, 1] * (c * wx + s * wy)


@inner
def _expect(
    update: Converting,
    slam: CentredSlam,
    state: State,
    data: Data,
    i: int,
    m: int,
    local: Clones,
    work: Work[ConvertingRoom],
) -> None:
    """h and its Jacobians where ``delta`` leads, and the observations there; those of active landmarks once."""
    x, room = state.x, work.room
    D, turn, around, pose, clone = room.three[0], room.three[1], room.poses[0], room.poses[1], room.poses[2]
    move_pose(x[:3], room.delta[:3], pose)
    for j in range(m):
        o, h = work.at[j], room.h[j]
        for a in range(3):
            h[a] = x[o + a] + room.delta[o + a]
        is_parked = room.clone[j] >= 0
        if is_parked:
            copy(h, around)
            q = room.at[m + room.clone[j]]
            move_pose(x[q : q + 3], room.delta[q : q + 3], clone)
            _seen_from(slam, clone, pose, around, h, room.own[j], room.shift[j], D)
            left_jacobian(room.delta[q : q + 3], turn)
            _times(1.0, room.shift[j], turn, room.by_clone[j])
            left_jacobian(room.delta[:3], turn)
            _times(-1.0, room.shift[j], turn, room.by_pose[j])
        if is_parked or i == 0:
            z = data.z[work.known[j]]
            observe_range(slam.sensor, update.pixels, z, h, room.y[j], room.R[j], D, around)


@inner
def _times(weight: float, A: Array, B: Array, C: Array) -> None:
    """``C`` <- weight A B, all (3, 3)."""
    for a in range(3):
        for b in range(3):
            C[a, b] = weight * (A[a, 0] * B[0, b] + A[a, 1] * B[1, b] + A[a, 2] * B[2, b])


@inner
def _temper(m: int, factor: float, room: ConvertingRoom) -> None:
    """R of the parked landmarks, worked out in this pass, is raised."""
    for j in range(m):
        if room.clone[j] >= 0:
            for a in range(3):
                for b in range(3):
                    room.R[j, a, b] *= factor


@inner
def _innovate(state: State, m: int, work: Work[ConvertingRoom]) -> float:
    """A <- H P, its last column z - h + H delta, and S <- H P H' + R; returns a sum, finite if all of it is."""
    n, room, A, S = state.n, work.room, work.A, work.S
    rows, delta, finite = room.rows, room.delta, 0.0
    for j in range(m):
        p = 3 + 3 * j
        for a in range(3):
            gap = room.y[j, a] - room.h[j, a]
            if a == 0:
                gap = (gap + np.pi) % (2.0 * np.pi) - np.pi
            out = A[3 * j + a]
            if room.clone[j] < 0:
                copy(rows[p + a, :n], out[:n])
                gap += delta[work.at[j] + a]
            else:
                q = 3 + 3 * m + 3 * room.clone[j]
                o, at = work.at[j], room.at[m + room.clone[j]]
                for c in range(3):
                    gap += room.own[j, a, c] * delta[o + c]
                    gap += room.by_clone[j, a, c] * delta[at + c] + room.by_pose[j, a, c] * delta[c]
                l0, l1, l2 = room.own[j, a, 0], room.own[j, a, 1], room.own[j, a, 2]
                q0, q1, q2 = room.by_clone[j, a, 0], room.by_clone[j, a, 1], room.by_clone[j, a, 2]
                p0, p1, p2 = room.by_pose[j, a, 0], room.by_pose[j, a, 1], room.by_pose[j, a, 2]
                for i in range(n):
                    out[i] = (
                        l0 * rows[p, i] + l1 * rows[p + 1, i] + l2 * rows[p + 2, i]
                        + q0 * rows[q, i] + q1 * rows[q + 1, i] + q2 * rows[q + 2, i]
                        + p0 * rows[0, i] + p1 * rows[1, i] + p2 * rows[2, i]
                    )  # fmt: skip
            out[n] = gap
            finite += gap
    for j in range(m):
        o = work.at[j]
        for row in range(3 * j + 3):
            for a in range(3):
                total = 0.0
                if room.clone[j] < 0:
                    total = A[row, o + a]
                else:
                    at = room.at[m + room.clone[j]]
                    for c in range(3):
                        total += A[row, o + c] * room.own[j, a, c] + A[row, at + c] * room.by_clone[j, a, c]
                        total += A[row, c] * room.by_pose[j, a, c]
                S[row, 3 * j + a] = total + (room.R[j, row - 3 * j, a] if row >= 3 * j else 0.0)
                finite += S[row, 3 * j + a]
    return finite


@inner
def _is_settled(P: Array, n: int, room: ConvertingRoom) -> bool:
    settled = True
    for j in range(n):
        settled = settled and abs(room.delta[j] - room.before[j]) <= SETTLED * np.sqrt(P[j, j])
    return settled


@inner
def _move(update: Converting, state: State, parked: int, local: Clones, work: Work[ConvertingRoom]) -> None:
    """x <- moved by ``delta``, and P <- about where that is."""
    x, room = state.x, work.room
    delta, turn, pose = room.delta, room.three[1], room.poses[1]
    for label in range(len(state.offset)):
        o = state.offset[label]
        if o >= 0:
            for a in range(3):
                x[o + a] += delta[o + a]
    move_pose(x[:3], delta[:3], pose)
    left_jacobian(delta[:3], turn)
    if not update.turning:  # as if the additive error of the pose were moved along
        fill_matrix(turn, 0.0)
        turn[0, 0] = turn[1, 1] = turn[2, 2] = 1.0
        turn[0, 2], turn[1, 2] = pose[1] - x[1], x[0] - pose[0]
    copy(pose, x[:3])
    _turn(state, 0, work)
    for number in range(len(local.at)):
        if local.uses[number] > 0:
            o = local.at[number]
            move_pose(x[o : o + 3], delta[o : o + 3], pose)
            copy(pose, x[o : o + 3])
            if parked > 0 and update.turning:
                left_jacobian(delta[o : o + 3], turn)
                _turn(state, o, work)


@inner
def _turn(state: State, o: int, work: Work[ConvertingRoom]) -> None:
    """Rows and columns of P at ``o`` <- those of the pose there, turned by ``three[1]``."""
    P, n, room = state.P, state.n, work.room
    T, own, rows = room.three[1], room.three[2], room.rows
    work.room.at[0] = o
    gather_rows(P, n, 3, 3, room.at, 0 if o == 0 else 1, rows)
    first = 0 if o == 0 else 3
    for i in range(n):
        v0, v1, v2 = rows[first, i], rows[first + 1, i], rows[first + 2, i]
        for a in range(3):
            rows[first + a, i] = T[a, 0] * v0 + T[a, 1] * v1 + T[a, 2] * v2
    for a in range(3):
        for b in range(3):
            own[a, b] = (
                rows[first + a, o] * T[b, 0] + rows[first + a, o + 1] * T[b, 1] + rows[first + a, o + 2] * T[b, 2]
            )
    replace_rows(P, n, o, rows[first : first + 3], own)


@inner
def _activate(slam: CentredSlam, state: State, label: int, local: Clones, work: Work[ConvertingRoom]) -> None:
    """A landmark that was parked, in the frame of the sensor again."""
    x, P, n, room = state.x, state.P, state.n, work.room
    J, shift, D, own, there = room.three[0], room.three[1], room.three[2], room.three[3], room.poses[0]
    o, q = state.offset[label], local.at[local.of[label]]
    _seen_from(slam, x[q : q + 3], x[:3], x[o : o + 3], there, J, shift, D)
    copy(there, x[o : o + 3])
    room.at[0], room.at[1] = o, q
    gather_rows(P, n, 3, 3, room.at, 2, room.rows)
    rows = room.rows
    for i in range(n):
        for a in range(3):
            total = 0.0
            for c in range(3):
                total += J[a, c] * rows[3 + c, i] + shift[a, c] * (rows[6 + c, i] - rows[c, i])
            work.rows[a, i] = total
    for a in range(3):
        for b in range(3):
            total = 0.0
            for c in range(3):
                total += J[b, c] * work.rows[a, o + c] + shift[b, c] * (work.rows[a, q + c] - work.rows[a, c])
            own[a, b] = total
    replace_rows(P, n, o, work.rows, own)
    unpark(label, state, local)
