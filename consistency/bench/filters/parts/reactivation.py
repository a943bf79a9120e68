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
    Scratch,
    add_gram_to_state,
    apply_beyond,
    divide_by_root,
    gather_all_rows,
    replace_rows,
    state_index,
)
from consistency.bench.filters.parts.converting import (
    Converting,
    ConvertingArrays,
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
    parked: Clones,
    scratch: Scratch[ConvertingArrays],
) -> tuple[int, float, float]:
    of_update, clones, chained, total = scratch.of_update, 0, False, 0.0  # as foreseen; clones are scratch then
    if _is_any_parked(m, parked, scratch) or not has_innovation:
        clones, chained, total = _aim(update, slam, state, data, m, update.leaving_out, parked, scratch)
        m = scratch.used[0]
    if m == 0:
        return 0, np.nan, np.nan
    code, nis, log_det = divide_by_root(state, 3 * m, scratch, total)
    if code == 0:
        _move(state, m, scratch)
        apply_beyond(state, 3 * m, parked.factors, scratch)
        if chained:
            move_chain(state, m, clones, parked, scratch)
        else:
            move_pose(state.x[:3], scratch.delta[:3], of_update.frames[clones])
            copy(of_update.frames[clones], state.x[:3])
        for i in range(m):
            if of_update.clone[i] >= 0 and not _stays(update, scratch.label[i], state, parked):
                _reactivate(slam, state, scratch.label[i], parked, scratch)
    return code, nis, log_det


@inner
def _stays(update: Converting, label: int, state: State, parked: Clones) -> bool:
    """Whether a landmark in doubt, well known in distance, has a turn since its clone that is not, after the update."""
    rho, most = state.offset[label] + 2, update.unturned if is_new(label, parked) else update.held
    is_known = state.P[rho, rho] < (update.known * state.x[rho]) ** 2
    return is_known and is_in_doubt(label, parked) and turn_variance(label, state, parked) > most


@implement(predict_innovation, Converting)
def predict_innovation_converted(
    update: Converting,
    slam: Slam,
    state: State,
    data: Data,
    k: int,
    m: int,
    parked: Clones,
    scratch: Scratch[ConvertingArrays],
) -> tuple[int, float]:
    """As far as the update; a chain moves clones and covariance on its way, and they are put back."""
    if not _is_any_in_doubt(m, parked, scratch) or update.chain == 0:
        _, _, total = _aim(update, slam, state, data, m, False, parked, scratch)
        return 0, total
    x, P, origin = state.x[: state.n].copy(), state.P[: state.n, : state.n].copy(), parked.origin.copy()
    _, _, total = _aim(update, slam, state, data, m, False, parked, scratch)
    copy(x, state.x[: state.n])
    copy_matrix(P, state.P[: state.n, : state.n])
    copy_matrix(origin, parked.origin)
    return 0, total


@inner
def _aim(
    update: Converting,
    slam: Slam,
    state: State,
    data: Data,
    m: int,
    leaving_out: bool,
    parked: Clones,
    scratch: Scratch[ConvertingArrays],
) -> tuple[int, bool, float]:
    """A, S and the innovation where the update leads, found by iteration where something was parked.

    Where that does not settle, with ``leaving_out`` ``scratch`` lists only what was not parked. Returns how many clones
    are in it, whether in a chain, and a sum that is finite if all is.
    """
    of_update = scratch.of_update
    chained = _is_any_in_doubt(m, parked, scratch) and update.chain > 0
    if chained:
        recentre(state, parked)
    clones = _gather(state, m, chained, parked, scratch)
    chained = chained and _iterate(update, slam, state, data, m, clones, update.chain, True, parked, scratch)
    if not chained and clones > 0 and update.passes > 1:
        is_settled = _iterate(update, slam, state, data, m, clones, update.passes, False, parked, scratch)
        if leaving_out and not is_settled:
            m = _leave_out_parked(m, parked, scratch)
            clones = _gather(state, m, False, parked, scratch)
    if clones == 0 or update.passes == 1:
        fill(of_update.delta[: 3 + 3 * (m + clones)], 0.0)
        aim_apart(state, m, clones, update.recency, parked, of_update)
        _expect(update, slam, state, data, True, m, clones, parked, scratch)
    if chained:
        cast_state(state, m, clones, of_update)
    return clones, chained, _innovate(of_update.rows, state.n + state.base, of_update.at, m, scratch)


@inner
def _leave_out_parked(m: int, parked: Clones, scratch: Scratch[ConvertingArrays]) -> int:
    """``scratch`` lists, of the ``m`` landmarks, those in use; returns how many. The others count as not seen."""
    left = 0
    for i in range(m):
        if parked.of[scratch.label[i]] < 0:
            scratch.known[left], scratch.label[left], scratch.at[left] = (
                scratch.known[i],
                scratch.label[i],
                scratch.at[i],
            )
            left += 1
        else:
            parked.seen[scratch.label[i]] = parked.earlier[scratch.label[i]]
    scratch.used[0] = left
    return left


@inner
def _is_any_parked(m: int, parked: Clones, scratch: Scratch[ConvertingArrays]) -> bool:
    is_parked = False
    for i in range(m):
        is_parked = is_parked or parked.of[scratch.label[i]] >= 0
    return is_parked


@inner
def _is_any_in_doubt(m: int, parked: Clones, scratch: Scratch[ConvertingArrays]) -> bool:
    in_doubt = False
    for i in range(m):
        in_doubt = in_doubt or is_in_doubt(scratch.label[i], parked)
    return in_doubt


@inner
def _gather(state: State, m: int, is_chained: bool, parked: Clones, scratch: Scratch[ConvertingArrays]) -> int:
    """Rows of P and Phi of all that the update involves; returns how many clones that is.

    They are those of parked landmarks that are seen, or in a chain all of them in the order of time. There the robot
    hangs on the first with a landmark that was in doubt in the last step, too, or on the last of all.
    """
    of_update = scratch.of_update
    clones = _list_all(parked, of_update.number) if is_chained else _list_seen(m, parked, scratch)
    for i in range(m):
        of_update.at[i], of_update.clone[i] = scratch.at[i], -1
        for c in range(clones):
            if of_update.number[c] == parked.of[scratch.label[i]]:
                of_update.clone[i] = c
    of_update.on[0] = clones - 1
    for c in range(clones - 1, -1, -1):
        of_update.at[m + c] = parked.here[of_update.number[c]]
        if parked.doubted[of_update.number[c]] == 2:
            of_update.on[0] = c
    gather_all_rows(state, parked.factors.Phi, 3, of_update.at, m + clones, of_update.rows)
    return clones


@inner
def _list_seen(m: int, parked: Clones, scratch: Scratch[ConvertingArrays]) -> int:
    clones = 0
    for i in range(m):
        number, is_new = parked.of[scratch.label[i]], True
        for c in range(clones):
            is_new = is_new and scratch.of_update.number[c] != number
        if number >= 0 and is_new:
            scratch.of_update.number[clones] = number
            clones += 1
    return clones


@inner
def _list_all(parked: Clones, numbers: Indices) -> int:
    clones, last = 0, -1
    while True:
        found = -1
        for number in range(len(parked.uses)):
            is_next = parked.uses[number] > 0 and parked.made[number] > last
            if is_next and (found < 0 or parked.made[number] < parked.made[found]):
                found = number
        if found < 0:
            return clones
        numbers[clones], last = found, parked.made[found]
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
    parked: Clones,
    scratch: Scratch[ConvertingArrays],
) -> bool:
    """Gauss-Newton on what the update involves; returns whether it settled in ``passes``.

    ``of_update`` has the last linearisation, ``delta`` where it was made.
    """
    of_update, size, is_settled = scratch.of_update, 3 + 3 * (m + clones), False
    decades, factor, is_raised = 0.0, 1.0, False
    for j in range(m):
        is_raised = is_raised or (_is_unsure(update, j, parked, scratch) and is_new(scratch.label[j], parked))
    among, cast, delta = of_update.among[:size, :size], of_update.cast[:size, :size], of_update.delta[:size]
    for i in range(size):
        for j in range(size):
            among[i, j] = of_update.rows[i, state_index(3, j, of_update.at)]
    alone = State(state.x, cast, size, 0, state.offset)
    fill(delta, 0.0)
    for i in range(passes):
        copy(delta, of_update.before[:size])
        copy_matrix(among, cast)
        if is_chained:
            aim_chained(state, m, clones, parked, of_update)
            cast_columns(cast.T, size, of_update.place, m, clones, of_update)
            cast_columns(cast, size, of_update.place, m, clones, of_update)
        else:
            aim_apart(state, m, clones, update.recency, parked, of_update)
        _expect(update, slam, state, data, i == 0, m, clones, parked, scratch)
        if is_raised:
            if i == 0:
                decades = update.decades
                if decades == 0.0:
                    _innovate(cast, size, of_update.place, m, scratch)
                    decades = _decades(update, m, parked, scratch)
            factor = max(1.0, 10.0 ** (decades - update.cooling * i))
            _temper(update, m, factor, parked, scratch)
        total = _innovate(cast, size, of_update.place, m, scratch)
        code, _, _ = divide_by_root(alone, 3 * m, scratch, total)
        if code > 0:
            return False
        fill(delta, 0.0)
        add_transposed_times(scratch.A[: 3 * m, :size], scratch.A[: 3 * m, size], delta)
        if is_chained:
            unchain(delta, m, clones, of_update)
        is_settled = i > 0 and factor == 1.0 and _is_settled(size, of_update)
        if is_settled:
            break
    copy(of_update.before[:size], delta)
    if is_chained:
        aim_chained(state, m, clones, parked, of_update)
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
    parked: Clones,
    scratch: Scratch[ConvertingArrays],
) -> None:
    """h and its Jacobians where ``delta`` leads, and the observations there; those of landmarks in use once."""
    x, of_update, delta = state.x, scratch.of_update, scratch.of_update.delta
    D, B, around = of_update.three[0], of_update.three[1], of_update.poses[0]
    for j in range(m):
        o, h, c = scratch.at[j], of_update.h[j], of_update.clone[j]
        for a in range(3):
            h[a] = x[o + a] + delta[3 + 3 * j + a]
        if c >= 0:
            copy(h, around)
            _seen_from(
                slam,
                of_update.frames[c],
                of_update.frames[clones],
                around,
                h,
                of_update.own[j],
                of_update.shift[j],
                D,
                B,
            )
            _times(1.0, of_update.shift[j], of_update.turns[c], of_update.by_clone[j])
            _times(-1.0, of_update.shift[j], of_update.turns[clones], of_update.by_pose[j])
        if is_first or c >= 0:
            i = scratch.known[j]
            z, of_d, shift = data.z[i], data.R[i, 2, 2], data.shift[i]
            observe_range(slam.sensor, update.pixels, z, of_d, shift, h, of_update.y[j], of_update.R[j], D)


@inner
def _times(weight: float, A: Array, B: Array, C: Array) -> None:
    """``C`` <- weight A B, all (3, 3)."""
    for a in range(3):
        for b in range(3):
            C[a, b] = weight * (A[a, 0] * B[0, b] + A[a, 1] * B[1, b] + A[a, 2] * B[2, b])


@inner
def _is_unsure(update: Converting, j: int, parked: Clones, scratch: Scratch[ConvertingArrays]) -> bool:
    return is_in_doubt(scratch.label[j], parked) if update.decades > 0.0 else scratch.of_update.clone[j] >= 0


@inner
def _decades(update: Converting, m: int, parked: Clones, scratch: Scratch[ConvertingArrays]) -> float:
    """By which the noise of what is unsure is below the variance that is predicted of it."""
    ratio = 1.0
    for j in range(m):
        if _is_unsure(update, j, parked, scratch):
            for a in range(3):
                ratio = max(ratio, scratch.S[3 * j + a, 3 * j + a] / scratch.of_update.R[j, a, a] - 1.0)
    return float(np.log10(ratio))


@inner
def _temper(update: Converting, m: int, factor: float, parked: Clones, scratch: Scratch[ConvertingArrays]) -> None:
    """R of what is unsure, worked out in this pass, is raised."""
    for j in range(m):
        if _is_unsure(update, j, parked, scratch):
            for a in range(3):
                for b in range(3):
                    scratch.of_update.R[j, a, b] *= factor


@inner
def _innovate(rows: Array, width: int, at: Indices, m: int, scratch: Scratch[ConvertingArrays]) -> float:
    """A (3 m, width) <- H P of the gathered ``rows``, its next column z - h + H delta, and S <- H P H' + R.

    ``at`` says where the landmarks, and then their clones, are among the columns. Returns a sum, finite if all is.
    """
    of_update, A, S, delta, finite = scratch.of_update, scratch.A, scratch.S, scratch.of_update.delta, 0.0
    for j in range(m):
        p = 3 + 3 * j
        q = 3 + 3 * (m + of_update.clone[j])
        for a in range(3):
            gap = of_update.y[j, a] - of_update.h[j, a]
            if a == 0:
                gap = (gap + np.pi) % (2.0 * np.pi) - np.pi
            out = A[3 * j + a]
            if of_update.clone[j] < 0:
                copy(rows[p + a, :width], out[:width])
                gap += delta[p + a]
            else:
                for c in range(3):
                    gap += of_update.own[j, a, c] * delta[p + c]
                    gap += of_update.by_clone[j, a, c] * delta[q + c] + of_update.by_pose[j, a, c] * delta[c]
                l0, l1, l2 = of_update.own[j, a, 0], of_update.own[j, a, 1], of_update.own[j, a, 2]
                q0, q1, q2 = of_update.by_clone[j, a, 0], of_update.by_clone[j, a, 1], of_update.by_clone[j, a, 2]
                p0, p1, p2 = of_update.by_pose[j, a, 0], of_update.by_pose[j, a, 1], of_update.by_pose[j, a, 2]
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
                if of_update.clone[j] < 0:
                    total = A[row, o + a]
                else:
                    q = at[m + of_update.clone[j]]
                    for c in range(3):
                        total += A[row, o + c] * of_update.own[j, a, c] + A[row, q + c] * of_update.by_clone[j, a, c]
                        total += A[row, c] * of_update.by_pose[j, a, c]
                S[row, 3 * j + a] = total + (of_update.R[j, row - 3 * j, a] if row >= 3 * j else 0.0)
                finite += S[row, 3 * j + a]
    return finite


@inner
def _is_settled(size: int, of_update: ConvertingArrays) -> bool:
    settled = True
    for j in range(size):
        settled = settled and abs(of_update.delta[j] - of_update.before[j]) <= SETTLED * np.sqrt(of_update.among[j, j])
    return settled


@inner
def _move(state: State, m: int, scratch: Scratch[ConvertingArrays]) -> None:
    """x <- moved by ``scratch.delta`` <- A' y, but for the robot; P <- P - A' A."""
    x, n = state.x, state.n
    A, delta = scratch.A[: 3 * m, :n], scratch.delta[:n]
    fill(delta, 0.0)
    add_transposed_times(A, scratch.A[: 3 * m, n + state.base], delta)
    add_gram_to_state(-1.0, A, state.P, n)
    for i in range(3, n):
        x[i] += delta[i]


@inner
def _reactivate(slam: Slam, state: State, label: int, parked: Clones, scratch: Scratch[ConvertingArrays]) -> None:
    """A landmark that was parked, in the frame of the sensor again."""
    x, P, n, base, of_update, Phi = state.x, state.P, state.n, state.base, scratch.of_update, parked.factors.Phi
    J, shift, D, turned = of_update.three[0], of_update.three[1], of_update.three[2], of_update.three[3]
    there, clone = of_update.poses[0], of_update.poses[1]
    number, o = parked.of[label], state.offset[label]
    q = parked.here[number]
    move_pose(parked.origin[number], x[q : q + 3], clone)
    _seen_from(slam, clone, x[:3], x[o : o + 3], there, J, shift, D, turned)
    copy(there, x[o : o + 3])
    left_jacobian(x[q : q + 3], D)
    _times(1.0, shift, D, turned)
    of_update.at[0], of_update.at[1] = o, q
    gather_all_rows(state, Phi, 3, of_update.at, 2, of_update.rows)
    rows, out = of_update.rows, scratch.rows
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
    unpark(label, state, parked)
