"""Where an update moves the robot and its clones, and the errors about those poses: charts of a robot-centred state.

Apart, each pose is Exp(xi) T. Chained, in the order of time, pose j is E_j T_j with E_j = E_j-1 Exp(xi_j - xi_j-1), so
that the motion between two poses depends on its own error alone. Errors about the poses moved so are C (xi - what moved
them): row j of C is row j - 1 plus B_j = Ad(E_j-1) J_l(xi_j - xi_j-1) times the difference of the rows. The robot is
the last; in place of the clone before it, it hangs on clone ``room.on``.
"""

from __future__ import annotations

import numpy as np

from consistency.bench.filters.compiler.jit import inner
from consistency.bench.filters.covariance_update.parking import Clones
from consistency.bench.filters.error.invariant_pose import exponential, left_jacobian, move_pose
from consistency.bench.filters.kernel.arrays import copy, copy_matrix, fill, fill_matrix
from consistency.bench.filters.kernel.covariance import replace_rows
from consistency.bench.filters.kernel.part_functions import State, Triple
from consistency.bench.filters.kernel.work_arrays import Work
from consistency.bench.filters.update.converting import ConvertingRoom
from consistency.referee.types import Array, Indices


@inner
def aim_apart(state: State, m: int, clones: int, recency: bool, local: Clones, room: ConvertingRoom) -> None:
    """``frames`` (clones + 1, 3) <- the poses to which ``delta`` leads, ``turns`` <- d error about each / d delta.

    With ``recency`` that of the robot is the identity: most of its ``delta`` is noise of the last motion, which came
    after all older errors.
    """
    xi = room.poses[3]
    for c in range(clones):
        q, p = room.at[m + c], 3 + 3 * (m + c)
        for a in range(3):
            xi[a] = state.x[q + a] + room.delta[p + a]
        move_pose(local.origin[room.number[c]], xi, room.frames[c])
        left_jacobian(xi, room.turns[c])
    move_pose(state.x[:3], room.delta[:3], room.frames[clones])
    fill(xi, 0.0)
    left_jacobian(xi if recency else room.delta[:3], room.turns[clones])


@inner
def aim_chained(state: State, m: int, clones: int, local: Clones, room: ConvertingRoom) -> None:
    """The same in the chain; ``delta`` of the poses <- C delta, ``links`` (clones + 1, 3, 3) <- B."""
    whole, step, last, J = room.poses[0], room.poses[1], room.poses[2], room.three[0]
    whole_on, last_on = room.poses[3], room.poses[4]
    fill(whole, 0.0)
    fill(last, 0.0)
    for c in range(clones + 1):
        p, before = _place(m, c, clones), _place(m, room.on[0] if c == clones else c - 1, clones)
        if c == clones:
            copy(whole_on, whole)
            copy(last_on, last)
        for a in range(3):
            step[a] = room.delta[p + a] - last[a]
            last[a] = room.delta[p + a]
        left_jacobian(step, J)
        _turn_link(whole, J, room.links[c])
        for a in range(3):
            room.delta[p + a] = room.delta[before + a] if c > 0 else 0.0
            for b in range(3):
                room.delta[p + a] += room.links[c, a, b] * step[b]
        _move_on(whole, step)
        _compose(whole, state.x[:3] if c == clones else local.origin[room.number[c]], room.frames[c])
        if c == room.on[0]:
            copy(whole, whole_on)
            copy(last, last_on)
        fill_matrix(room.turns[c], 0.0)
        for a in range(3):
            room.turns[c, a, a] = 1.0


@inner
def unchain(delta: Array, m: int, clones: int, room: ConvertingRoom) -> None:
    """``delta`` of the poses, in the places of the rows of ``room``, <- C^-1 delta."""
    step, last, total, last_on, total_on = room.poses[0], room.poses[1], room.poses[2], room.poses[3], room.poses[4]
    fill(last, 0.0)
    fill(total, 0.0)
    for c in range(clones + 1):
        p, B = _place(m, c, clones), room.links[c]
        if c == clones:
            copy(last_on, last)
            copy(total_on, total)
        for a in range(3):
            step[a] = delta[p + a] - last[a]
            last[a] = delta[p + a]
        total[2] += step[2]
        x, y = step[0] - B[0, 2] * step[2], step[1] - B[1, 2] * step[2]
        scale = 1.0 / (B[0, 0] * B[1, 1] - B[0, 1] * B[1, 0])
        total[0] += scale * (B[1, 1] * x - B[0, 1] * y)
        total[1] += scale * (B[0, 0] * y - B[1, 0] * x)
        copy(total, delta[p : p + 3])
        if c == room.on[0]:
            copy(last, last_on)
            copy(total, total_on)


@inner
def cast_columns(rows: Array, count: int, at: Indices, m: int, clones: int, room: ConvertingRoom) -> None:
    """``rows`` (count, n) <- rows C'; ``at`` says where the landmarks, and then the clones, are among the columns."""
    for i in range(count):
        row = rows[i]
        u = v = u_on = v_on = (0.0, 0.0, 0.0)
        for c in range(clones + 1):
            q = 0 if c == clones else at[m + c]
            if c == clones:
                u, v = u_on, v_on
            u, v = _link(room.links[c], (row[q], row[q + 1], row[q + 2]), u, v)
            row[q], row[q + 1], row[q + 2] = v
            if c == room.on[0]:
                u_on, v_on = u, v


@inner
def _link(B: Array, here: Triple, last: Triple, cast: Triple) -> tuple[Triple, Triple]:
    """What is ``here``, and its image: that of the ``last``, ``cast``, plus B (here - last)."""
    x, y, t = here[0] - last[0], here[1] - last[1], here[2] - last[2]
    moved = (
        cast[0] + B[0, 0] * x + B[0, 1] * y + B[0, 2] * t,
        cast[1] + B[1, 0] * x + B[1, 1] * y + B[1, 2] * t,
        cast[2] + B[2, 0] * x + B[2, 1] * y + B[2, 2] * t,
    )
    return here, moved


@inner
def cast_state(state: State, m: int, clones: int, room: ConvertingRoom) -> None:
    """P (n, n) <- C P C', and its gathered ``rows`` with it."""
    P, n = state.P, state.n
    cast_columns(room.rows.T, n, room.place, m, clones, room)
    cast_columns(room.rows, 3 + 3 * (m + clones), room.at, m, clones, room)
    copy_matrix(room.rows[:3, :n], P[:3, :n])
    for c in range(clones):
        o, p = room.at[m + c], 3 + 3 * (m + c)
        replace_rows(P, n, o, room.rows[p : p + 3], room.rows[p : p + 3, o : o + 3])


@inner
def move_chain(state: State, m: int, clones: int, local: Clones, work: Work[ConvertingRoom]) -> None:
    """The robot and all clones <- moved by the error ``work.delta`` (n,) about where they were aimed from."""
    room, x = work.room, state.x
    copy(work.delta[:3], room.delta[:3])
    for c in range(clones):
        p, q = 3 + 3 * (m + c), room.at[m + c]
        copy(work.delta[q : q + 3], room.delta[p : p + 3])
        fill(x[q : q + 3], 0.0)
    unchain(room.delta, m, clones, room)
    aim_chained(state, m, clones, local, room)
    for c in range(clones):
        copy(room.frames[c], local.origin[room.number[c]])
    copy(room.frames[clones], x[:3])


@inner
def _place(m: int, c: int, clones: int) -> int:
    """Of the c-th pose among the gathered rows: the robot, then m landmarks, then the clones."""
    return 0 if c == clones else 3 + 3 * (m + c)


@inner
def _turn_link(pose: Array, J: Array, B: Array) -> None:
    """``B`` (3, 3) <- Ad of the pose (3,) times J (3, 3), whose last row is 0, 0, 1."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    for b in range(3):
        B[0, b] = c * J[0, b] - s * J[1, b]
        B[1, b] = s * J[0, b] + c * J[1, b]
        B[2, b] = J[2, b]
    B[0, 2] += pose[1]
    B[1, 2] -= pose[0]


@inner
def _move_on(pose: Array, xi: Array) -> None:
    """``pose`` (3,) <- T Exp(xi)."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    _, _, along, across = exponential(xi[2])
    x, y = along * xi[0] - across * xi[1], across * xi[0] + along * xi[1]
    pose[0] += c * x - s * y
    pose[1] += s * x + c * y
    pose[2] += xi[2]


@inner
def _compose(pose: Array, other: Array, out: Array) -> None:
    """``out`` (3,) <- the pose ``other`` in the frame of ``pose``, both (3,)."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    out[0] = pose[0] + c * other[0] - s * other[1]
    out[1] = pose[1] + s * other[0] + c * other[1]
    out[2] = pose[2] + other[2]
