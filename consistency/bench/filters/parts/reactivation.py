"""The update of a robot-centred map, linear for what is in use and iterated for what was parked."""

from __future__ import annotations

import numpy as np

from consistency.bench.filters.compiler.dispatch import implement
from consistency.bench.filters.compiler.jit import inner
from consistency.bench.filters.kernel.linalg import add_transposed_times, copy, copy_matrix, fill
from consistency.bench.filters.kernel.part_functions import (
    Data,
    Frame,
    Slam,
    State,
    correct,
    predict_innovation,
    robot_frame,
)
from consistency.bench.filters.kernel.update_steps import (
    Work,
    add_gram_to_state,
    apply_beyond,
    divide_by_root,
    gather_all_rows,
    replace_rows,
    state_index,
)
from consistency.bench.filters.parts.converting import (
    Converting,
    ConvertingRoom,
    aim_apart,
    aim_chained,
    cast_columns,
    cast_state,
    move_chain,
    unchain,
)
from consistency.bench.filters.parts.invariant_pose import left_jacobian, move_pose
from consistency.bench.filters.parts.inverse_range import carried, observe_range
from consistency.bench.filters.parts.parking import Clones, is_in_doubt, is_new, recentre, turn_variance, unpark
from consistency.referee.types import Array, Indices

SETTLED = 1e-3  # change in standard deviations that ends an iteration


@implement(correct, Converting)
def correct_converted(
    update: Converting,
    slam: Slam,
    state: State,
    data: Data,
    k: int,
    m: int,
    has_innovation: bool,
    local: Clones,
    work: Work[ConvertingRoom],
) -> tuple[int, float, float]:
    room, clones, chained, total = work.room, 0, False, 0.0  # as foreseen; clones are scratch then
    if _is_any_parked(m, local, work) or not has_innovation:
        clones, chained, total = _aim(update, slam, state, data, m, update.leaving_out, local, work)
        m = work.used[0]
    if m == 0:
        return 0, np.nan, np.nan
    code, nis, log_det = divide_by_root(state, 3 * m, work, total)
    if code == 0:
        _move(state, m, work)
        apply_beyond(state, 3 * m, local.factors, work)
        if chained:
            move_chain(state, m, clones, local, work)
        else:
            move_pose(state.x[:3], work.delta[:3], room.frames[clones])
            copy(room.frames[clones], state.x[:3])
        for i in range(m):
            if room.clone[i] >= 0 and not _stays(update, work.label[i], state, local):
                _reactivate(slam, state, work.label[i], local, work)
    return code, nis, log_det


@inner
def _stays(update: Converting, label: int, state: State, local: Clones) -> bool:
    """Whether a landmark in doubt, well known in distance, has a turn since its clone that is not, after the update."""
    rho, most = state.offset[label] + 2, update.unturned if is_new(label, local) else update.held
    is_known = state.P[rho, rho] < (update.known * state.x[rho]) ** 2
    return is_known and is_in_doubt(label, local) and turn_variance(label, state, local) > most


@implement(predict_innovation, Converting)
def predict_innovation_converted(
    update: Converting,
    slam: Slam,
    state: State,
    data: Data,
    k: int,
    m: int,
    local: Clones,
    work: Work[ConvertingRoom],
) -> tuple[int, float]:
    """As far as the update; a chain moves clones and covariance on its way, and they are put back."""
    if not _is_any_in_doubt(m, local, work) or update.chain == 0:
        _, _, total = _aim(update, slam, state, data, m, False, local, work)
        return 0, total
    x, P, origin = state.x[: state.n].copy(), state.P[: state.n, : state.n].copy(), local.origin.copy()
    _, _, total = _aim(update, slam, state, data, m, False, local, work)
    copy(x, state.x[: state.n])
    copy_matrix(P, state.P[: state.n, : state.n])
    copy_matrix(origin, local.origin)
    return 0, total


@inner
def _aim(
    update: Converting,
    slam: Slam,
    state: State,
    data: Data,
    m: int,
    leaving_out: bool,
    local: Clones,
    work: Work[ConvertingRoom],
) -> tuple[int, bool, float]:
    """A, S and the innovation where the update leads, found by iteration where something was parked.

    Where that does not settle, with ``leaving_out`` ``work`` lists only what was not parked. Returns how many clones
    are in it, whether in a chain, and a sum that is finite if all is.
    """
    room = work.room
    chained = _is_any_in_doubt(m, local, work) and update.chain > 0
    if chained:
        recentre(state, local)
    clones = _gather(state, m, chained, local, work)
    chained = chained and _iterate(update, slam, state, data, m, clones, update.chain, True, local, work)
    if not chained and clones > 0 and update.passes > 1:
        is_settled = _iterate(update, slam, state, data, m, clones, update.passes, False, local, work)
        if leaving_out and not is_settled:
            m = _leave_out_parked(m, local, work)
            clones = _gather(state, m, False, local, work)
    if clones == 0 or update.passes == 1:
        fill(room.delta[: 3 + 3 * (m + clones)], 0.0)
        aim_apart(state, m, clones, update.recency, local, room)
        _expect(update, slam, state, data, True, m, clones, local, work)
    if chained:
        cast_state(state, m, clones, room)
    return clones, chained, _innovate(room.rows, state.n + state.base, room.at, m, work)


@inner
def _leave_out_parked(m: int, local: Clones, work: Work[ConvertingRoom]) -> int:
    """``work`` lists, of the ``m`` landmarks, those in use; returns how many. The others count as not seen."""
    left = 0
    for i in range(m):
        if local.of[work.label[i]] < 0:
            work.known[left], work.label[left], work.at[left] = work.known[i], work.label[i], work.at[i]
            left += 1
        else:
            local.seen[work.label[i]] = local.earlier[work.label[i]]
    work.used[0] = left
    return left


@inner
def _is_any_parked(m: int, local: Clones, work: Work[ConvertingRoom]) -> bool:
    is_parked = False
    for i in range(m):
        is_parked = is_parked or local.of[work.label[i]] >= 0
    return is_parked


@inner
def _is_any_in_doubt(m: int, local: Clones, work: Work[ConvertingRoom]) -> bool:
    in_doubt = False
    for i in range(m):
        in_doubt = in_doubt or is_in_doubt(work.label[i], local)
    return in_doubt


@inner
def _gather(state: State, m: int, is_chained: bool, local: Clones, work: Work[ConvertingRoom]) -> int:
    """Rows of P and Phi of all that the update involves; returns how many clones that is.

    They are those of parked landmarks that are seen, or in a chain all of them in the order of time. There the robot
    hangs on the first with a landmark that was in doubt in the last step, too, or on the last of all.
    """
    room = work.room
    clones = _list_all(local, room.number) if is_chained else _list_seen(m, local, work)
    for i in range(m):
        room.at[i], room.clone[i] = work.at[i], -1
        for c in range(clones):
            if room.number[c] == local.of[work.label[i]]:
                room.clone[i] = c
    room.on[0] = clones - 1
    for c in range(clones - 1, -1, -1):
        room.at[m + c] = local.here[room.number[c]]
        if local.doubted[room.number[c]] == 2:
            room.on[0] = c
    gather_all_rows(state, local.factors.Phi, 3, room.at, m + clones, room.rows)
    return clones


@inner
def _list_seen(m: int, local: Clones, work: Work[ConvertingRoom]) -> int:
    clones = 0
    for i in range(m):
        number, is_new = local.of[work.label[i]], True
        for c in range(clones):
            is_new = is_new and work.room.number[c] != number
        if number >= 0 and is_new:
            work.room.number[clones] = number
            clones += 1
    return clones


@inner
def _list_all(local: Clones, numbers: Indices) -> int:
    clones, last = 0, -1
    while True:
        found = -1
        for number in range(len(local.uses)):
            is_next = local.uses[number] > 0 and local.made[number] > last
            if is_next and (found < 0 or local.made[number] < local.made[found]):
                found = number
        if found < 0:
            return clones
        numbers[clones], last = found, local.made[found]
        clones += 1


@inner
def _iterate(
    update: Converting,
    slam: Slam,
    state: State,
    data: Data,
    m: int,
    clones: int,
    passes: int,
    is_chained: bool,
    local: Clones,
    work: Work[ConvertingRoom],
) -> bool:
    """Gauss-Newton on what the update involves; returns whether it settled in ``passes``.

    ``room`` has the last linearisation, ``delta`` where it was made.
    """
    room, size, is_settled = work.room, 3 + 3 * (m + clones), False
    decades, factor, is_raised = 0.0, 1.0, False
    for j in range(m):
        is_raised = is_raised or (_is_unsure(update, j, local, work) and is_new(work.label[j], local))
    among, cast, delta = room.among[:size, :size], room.cast[:size, :size], room.delta[:size]
    for i in range(size):
        for j in range(size):
            among[i, j] = room.rows[i, state_index(3, j, room.at)]
    alone = State(state.x, cast, size, 0, state.offset)
    fill(delta, 0.0)
    for i in range(passes):
        copy(delta, room.before[:size])
        copy_matrix(among, cast)
        if is_chained:
            aim_chained(state, m, clones, local, room)
            cast_columns(cast.T, size, room.place, m, clones, room)
            cast_columns(cast, size, room.place, m, clones, room)
        else:
            aim_apart(state, m, clones, update.recency, local, room)
        _expect(update, slam, state, data, i == 0, m, clones, local, work)
        if is_raised:
            if i == 0:
                decades = update.decades
                if decades == 0.0:
                    _innovate(cast, size, room.place, m, work)
                    decades = _decades(update, m, local, work)
            factor = max(1.0, 10.0 ** (decades - update.cooling * i))
            _temper(update, m, factor, local, work)
        total = _innovate(cast, size, room.place, m, work)
        code, _, _ = divide_by_root(alone, 3 * m, work, total)
        if code > 0:
            return False
        fill(delta, 0.0)
        add_transposed_times(work.A[: 3 * m, :size], work.A[: 3 * m, size], delta)
        if is_chained:
            unchain(delta, m, clones, room)
        is_settled = i > 0 and factor == 1.0 and _is_settled(size, room)
        if is_settled:
            break
    copy(room.before[:size], delta)
    if is_chained:
        aim_chained(state, m, clones, local, room)
    return is_settled


@inner
def _seen_from(
    slam: Slam, clone: Array, pose: Array, y: Array, there: Array, J: Array, shift: Array, D: Array, B: Array
) -> None:
    """``there`` <- a landmark parked at ``clone`` as it is seen from ``pose``; its derivatives by y and by xi."""
    at, frame = robot_frame(clone), robot_frame(pose)
    c, s = frame.c, frame.s
    dx, dy = at.x - frame.x, at.y - frame.y
    turn = Frame(c * dx + s * dy, c * dy - s * dx, c * at.c + s * at.s, c * at.s - s * at.c)
    rho = y[2]
    b = carried(y, turn, slam.landmark.mount, there, J, D, B)
    wx, wy = c * b[0] - s * b[1] + rho * frame.x, s * b[0] + c * b[1] + rho * frame.y
    for a in range(3):
        shift[a, 0] = rho * (D[a, 0] * c - D[a, 1] * s)
        shift[a, 1] = rho * (D[a, 0] * s + D[a, 1] * c)
        shift[a, 2] = D[a, 0] * (s * wx - c * wy) + D[a, 1] * (c * wx + s * wy)


@inner
def _expect(
    update: Converting,
    slam: Slam,
    state: State,
    data: Data,
    is_first: bool,
    m: int,
    clones: int,
    local: Clones,
    work: Work[ConvertingRoom],
) -> None:
    """h and its Jacobians where ``delta`` leads, and the observations there; those of landmarks in use once."""
    x, room, delta = state.x, work.room, work.room.delta
    D, B, around = room.three[0], room.three[1], room.poses[0]
    for j in range(m):
        o, h, c = work.at[j], room.h[j], room.clone[j]
        for a in range(3):
            h[a] = x[o + a] + delta[3 + 3 * j + a]
        if c >= 0:
            copy(h, around)
            _seen_from(slam, room.frames[c], room.frames[clones], around, h, room.own[j], room.shift[j], D, B)
            _times(1.0, room.shift[j], room.turns[c], room.by_clone[j])
            _times(-1.0, room.shift[j], room.turns[clones], room.by_pose[j])
        if is_first or c >= 0:
            i = work.known[j]
            z, of_d, shift = data.z[i], data.R[i, 2, 2], data.shift[i]
            observe_range(slam.sensor, update.pixels, z, of_d, shift, h, room.y[j], room.R[j], D)


@inner
def _times(weight: float, A: Array, B: Array, C: Array) -> None:
    """``C`` <- weight A B, all (3, 3)."""
    for a in range(3):
        for b in range(3):
            C[a, b] = weight * (A[a, 0] * B[0, b] + A[a, 1] * B[1, b] + A[a, 2] * B[2, b])


@inner
def _is_unsure(update: Converting, j: int, local: Clones, work: Work[ConvertingRoom]) -> bool:
    return is_in_doubt(work.label[j], local) if update.decades > 0.0 else work.room.clone[j] >= 0


@inner
def _decades(update: Converting, m: int, local: Clones, work: Work[ConvertingRoom]) -> float:
    """By which the noise of what is unsure is below the variance that is predicted of it."""
    ratio = 1.0
    for j in range(m):
        if _is_unsure(update, j, local, work):
            for a in range(3):
                ratio = max(ratio, work.S[3 * j + a, 3 * j + a] / work.room.R[j, a, a] - 1.0)
    return float(np.log10(ratio))


@inner
def _temper(update: Converting, m: int, factor: float, local: Clones, work: Work[ConvertingRoom]) -> None:
    """R of what is unsure, worked out in this pass, is raised."""
    for j in range(m):
        if _is_unsure(update, j, local, work):
            for a in range(3):
                for b in range(3):
                    work.room.R[j, a, b] *= factor


@inner
def _innovate(rows: Array, width: int, at: Indices, m: int, work: Work[ConvertingRoom]) -> float:
    """A (3 m, width) <- H P of the gathered ``rows``, its next column z - h + H delta, and S <- H P H' + R.

    ``at`` says where the landmarks, and then their clones, are among the columns. Returns a sum, finite if all is.
    """
    room, A, S, delta, finite = work.room, work.A, work.S, work.room.delta, 0.0
    for j in range(m):
        p = 3 + 3 * j
        q = 3 + 3 * (m + room.clone[j])
        for a in range(3):
            gap = room.y[j, a] - room.h[j, a]
            if a == 0:
                gap = (gap + np.pi) % (2.0 * np.pi) - np.pi
            out = A[3 * j + a]
            if room.clone[j] < 0:
                copy(rows[p + a, :width], out[:width])
                gap += delta[p + a]
            else:
                for c in range(3):
                    gap += room.own[j, a, c] * delta[p + c]
                    gap += room.by_clone[j, a, c] * delta[q + c] + room.by_pose[j, a, c] * delta[c]
                l0, l1, l2 = room.own[j, a, 0], room.own[j, a, 1], room.own[j, a, 2]
                q0, q1, q2 = room.by_clone[j, a, 0], room.by_clone[j, a, 1], room.by_clone[j, a, 2]
                p0, p1, p2 = room.by_pose[j, a, 0], room.by_pose[j, a, 1], room.by_pose[j, a, 2]
                for i in range(width):
                    out[i] = (
                        l0 * rows[p, i] + l1 * rows[p + 1, i] + l2 * rows[p + 2, i]
                        + q0 * rows[q, i] + q1 * rows[q + 1, i] + q2 * rows[q + 2, i]
                        + p0 * rows[0, i] + p1 * rows[1, i] + p2 * rows[2, i]
                    )  # fmt: skip
            out[width] = gap
            finite += gap
    for j in range(m):
        o = at[j]
        for row in range(3 * j + 3):
            for a in range(3):
                total = 0.0
                if room.clone[j] < 0:
                    total = A[row, o + a]
                else:
                    q = at[m + room.clone[j]]
                    for c in range(3):
                        total += A[row, o + c] * room.own[j, a, c] + A[row, q + c] * room.by_clone[j, a, c]
                        total += A[row, c] * room.by_pose[j, a, c]
                S[row, 3 * j + a] = total + (room.R[j, row - 3 * j, a] if row >= 3 * j else 0.0)
                finite += S[row, 3 * j + a]
    return finite


@inner
def _is_settled(size: int, room: ConvertingRoom) -> bool:
    settled = True
    for j in range(size):
        settled = settled and abs(room.delta[j] - room.before[j]) <= SETTLED * np.sqrt(room.among[j, j])
    return settled


@inner
def _move(state: State, m: int, work: Work[ConvertingRoom]) -> None:
    """x <- moved by ``work.delta`` <- A' y, but for the robot; P <- P - A' A."""
    x, n = state.x, state.n
    A, delta = work.A[: 3 * m, :n], work.delta[:n]
    fill(delta, 0.0)
    add_transposed_times(A, work.A[: 3 * m, n + state.base], delta)
    add_gram_to_state(-1.0, A, state.P, n)
    for i in range(3, n):
        x[i] += delta[i]


@inner
def _reactivate(slam: Slam, state: State, label: int, local: Clones, work: Work[ConvertingRoom]) -> None:
    """A landmark that was parked, in the frame of the sensor again."""
    x, P, n, base, room, Phi = state.x, state.P, state.n, state.base, work.room, local.factors.Phi
    J, shift, D, turned = room.three[0], room.three[1], room.three[2], room.three[3]
    there, clone = room.poses[0], room.poses[1]
    number, o = local.of[label], state.offset[label]
    q = local.here[number]
    move_pose(local.origin[number], x[q : q + 3], clone)
    _seen_from(slam, clone, x[:3], x[o : o + 3], there, J, shift, D, turned)
    copy(there, x[o : o + 3])
    left_jacobian(x[q : q + 3], D)
    _times(1.0, shift, D, turned)
    room.at[0], room.at[1] = o, q
    gather_all_rows(state, Phi, 3, room.at, 2, room.rows)
    rows, out = room.rows, work.rows
    for i in range(n + base):
        for a in range(3):
            total = 0.0
            for c in range(3):
                total += J[a, c] * rows[3 + c, i] + turned[a, c] * rows[6 + c, i] - shift[a, c] * rows[c, i]
            out[a, i] = total
    for a in range(3):
        if base > 0:
            copy(out[a, n : n + base], Phi[o + a, :base])
        for b in range(3):
            total = 0.0
            for c in range(3):
                total += J[b, c] * out[a, o + c] + turned[b, c] * out[a, q + c] - shift[b, c] * out[a, c]
            D[a, b] = total
    replace_rows(P, n, o, out, D)
    unpark(label, state, local)
