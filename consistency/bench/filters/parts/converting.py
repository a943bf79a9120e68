"""A robot-centred map whose observations are converted to its variables: parts, scratch arrays, motion, new landmarks.

Where an update moves the robot and its clones, and the errors about those poses: charts of a robot-centred state.

Apart, each pose is Exp(xi) T. Chained, in the order of time, pose j is E_j T_j with E_j = E_j-1 Exp(xi_j - xi_j-1), so
that the motion between two poses depends on its own error alone. Errors about the poses moved so are C (xi - what moved
them): row j of C is row j - 1 plus B_j = Ad(E_j-1) J_l(xi_j - xi_j-1) times the difference of the rows. The robot is
the last; in place of the clone before it, it hangs on clone ``of_update.on``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from consistency.bench.filters.compiler.dispatch import implement, part
from consistency.bench.filters.compiler.jit import inner
from consistency.bench.filters.kernel.linalg import (
    blocks,
    copy,
    copy_matrix,
    fill,
    fill_matrix,
    integers,
    matrix,
    vector,
)
from consistency.bench.filters.kernel.part_functions import (
    Frame,
    Slam,
    State,
    Triple,
    make_update_arrays,
    move,
    noise_columns,
    place,
    predict,
)
from consistency.bench.filters.kernel.update_steps import (
    Scratch,
    add_gram_to_state,
    multiply_columns,
    multiply_rows,
    replace_rows,
)
from consistency.bench.filters.parts.invariant_pose import exponential, left_jacobian, move_pose
from consistency.bench.filters.parts.inverse_range import (
    Pixels,
    add_square,
    carried,
    conversion_jacobian,
    convert,
    row_times,
    second_order,
    subtract_bias,
)
from consistency.bench.filters.parts.parking import Clones, forget, is_out_of_sight
from consistency.referee.types import Array, Indices


@part(sensor="Uvd", landmark="InverseRange", error="InvariantPose", covariance="Parking")
class Converting(NamedTuple):
    """What is known of the pixels, and what is done about a return.

    ``passes`` of such an update at most, and of one in a ``chain``, tried first, 0 for none; ``clones`` at most, and no
    more than landmarks. ``recency``: a moved robot keeps the errors from before its last motion; ``curvature``: a
    motion moves landmarks by the mean of its noise to second order; ``spread``: and adds to their covariance what that
    noise and, with ``own_spread``, their own errors add to second order. The noise of a new return in doubt is raised
    by so many ``decades`` at first, that of any return by as many as it is below what is predicted if these are 0, and
    by ``cooling`` less in each pass. ``leaving_out``: a return that does not settle is left out of the update. A
    landmark in doubt whose rho is known to this part of it, ``known``, stays parked where the variance of the turn
    since its clone, rad^2, is above ``unturned`` after its first update, and above ``held`` after later ones. One in
    use and out of sight is forgotten where its direction, rad, or its rho are known no better than ``blurred``, 0 for
    never: its rho in relation to itself, and only if that is above ``near``.
    """

    pixels: Pixels
    passes: int
    chain: int
    clones: int
    recency: bool
    curvature: bool
    spread: bool
    own_spread: bool
    decades: float
    cooling: float
    leaving_out: bool
    unturned: float
    held: float
    known: float
    blurred: float
    near: float


@part(update="Converting")
class Converted(NamedTuple):
    """No parameters. Observations are linear in the map, so there is no point at which they are linearised."""


class ConvertingArrays(NamedTuple):
    """For up to m landmarks and c clones in a step, and a state of up to n variables."""

    at: Indices  # (m + c,) offsets of the seen landmarks, then of clones: of those that are parked, or all
    number: Indices  # (c,) numbers of these clones
    clone: Indices  # (m,) which of these clones a landmark has, or -1
    rows: Array  # (3 + 3 (m + c), n) rows of P, and behind them of Phi, of the robot and of all these
    among: Array  # (3 + 3 (m + c), 3 + 3 (m + c)) their columns of these alone
    cast: Array  # (3 + 3 (m + c), 3 + 3 (m + c)) and by errors about the poses of a pass
    place: Indices  # (m + c,) their offsets there
    on: Indices  # (1,) which of these clones the robot hangs on
    frames: Array  # (c + 1, 3) poses of the clones and of the robot where ``delta`` leads
    turns: Array  # (c + 1, 3, 3) error about each / d delta
    links: Array  # (c + 1, 3, 3) how errors about them are chained
    own: Array  # (m, 3, 3) Jacobian with respect to the landmark
    shift: Array  # (m, 3, 3) and to xi of its clone less that of the pose, about the moved state
    by_clone: Array  # (m, 3, 3) and to xi of its clone
    by_pose: Array  # (m, 3, 3) and to xi of the pose about the state before
    y: Array  # (m, 3) converted observations
    h: Array  # (m, 3) what is expected
    R: Array  # (m, 3, 3)
    delta: Array  # (3 + 3 (m + c),) a correction of the robot and of all these
    before: Array  # (3 + 3 (m + c),)
    noise: Array  # (4, n) what the motion of this step added to the errors, for each of its noises and their squares
    moving: Indices  # (n / 3,) offsets of the landmarks that move
    J: Array  # (n / 3, 3, 3) how
    own_spread: Array  # (n / 3, 3, 3) covariance that the errors of each alone add to second order, upper half
    ways: Array  # (5, 9) derivatives by these errors
    three: Array  # (4, 3, 3)
    poses: Array  # (5, 3)


@inner
def _every_third(n: int) -> Indices:
    """3, 6, 9, ..., (n,)."""
    places = integers(n, 0)
    for i in range(n):
        places[i] = 3 + 3 * i
    return places


@implement(make_update_arrays, Converting)
def converting_arrays(update: Converting, w: int, s: int, m: int, n: int) -> ConvertingArrays:
    c = max(m, min(update.clones, (n - 3) // 6))
    most = 3 + 3 * (m + c)
    return ConvertingArrays(
        integers(m + c, 0), integers(c, 0), integers(m, 0), matrix(most, n),
        matrix(most, most), matrix(most, most), _every_third(m + c), integers(1, 0),
        matrix(c + 1, 3), blocks(c + 1, 3, 3), blocks(c + 1, 3, 3),
        blocks(m, 3, 3), blocks(m, 3, 3), blocks(m, 3, 3), blocks(m, 3, 3),
        matrix(m, 3), matrix(m, 3), blocks(m, 3, 3), vector(most), vector(most),
        matrix(4, n), integers(n // 3, 0), blocks(n // 3, 3, 3), blocks(n // 3, 3, 3), matrix(5, 9),
        blocks(4, 3, 3), matrix(5, 3),
    )  # fmt: skip


@implement(predict, Converting)
def predict_centred(
    update: Converting,
    slam: Slam,
    state: State,
    k: int,
    u: Array,
    parked: Clones,
    scratch: Scratch[ConvertingArrays],
) -> None:
    x, P, n, of_update, G = state.x, state.P, state.n, scratch.of_update, scratch.small
    noise_columns(slam.motion, x[:3], u, G)
    move(x[:3], u, x[:3])
    noise = of_update.noise[: 4 if update.spread else 2, :n]
    fill_matrix(noise, 0.0)
    for c in range(2):
        noise[c, 0], noise[c, 1], noise[c, 2] = G[0, c] + x[1] * G[2, c], G[1, c] - x[0] * G[2, c], G[2, c]
    forward, c, s = u[0] * u[1], np.cos(u[0] * u[2]), -np.sin(u[0] * u[2])
    turn = Frame(-c * forward, -s * forward, c, s)
    moving = 0
    for label in range(len(state.offset)):
        o = state.offset[label]
        if o >= 0 and parked.of[label] < 0:
            J, own, there, rho = of_update.J[moving], of_update.own_spread[moving], of_update.poses[0], x[o + 2]
            D, B, L, means = of_update.three[0], of_update.three[1], of_update.three[2], of_update.three[3]
            point = carried(x[o : o + 3], turn, slam.landmark.mount, there, J, D, B)
            along, about = u[0] * slam.motion.sigma_v, u[0] * slam.motion.sigma_omega
            for a in range(3):
                noise[0, o + a] = -along * rho * (D[a, 0] * c + D[a, 1] * s)
                noise[1, o + a] = about * (D[a, 0] * point[1] - D[a, 1] * point[0])
            if update.curvature or update.spread:
                take_root(P, o, L)
                second_order(
                    x[o : o + 3], L, point, D, B, turn, slam.landmark.mount, along, about,
                    0 if update.own_spread else 3, of_update.ways, means, own,
                )  # fmt: skip
                if not update.own_spread:
                    d0, d1, d2 = row_times(D, 0, c, s, 0.0), row_times(D, 1, c, s, 0.0), row_times(D, 2, c, s, 0.0)
                    fill_matrix(own, 0.0)
                    add_square(along * along * P[o + 2, o + 2], d0, d1, d2, own)
                for a in range(3):
                    if update.curvature:
                        there[a] += means[0, a] + means[1, a]
                    if update.spread:  # the square of a normal of variance s^2 has variance 2 s^4
                        noise[2, o + a], noise[3, o + a] = np.sqrt(2.0) * means[0, a], np.sqrt(2.0) * means[1, a]
            copy(there, x[o : o + 3])
            of_update.moving[moving] = o
            moving += 1
    _move_rows(P, n, of_update.moving, of_update.J, moving)
    for i in range(moving if state.base > 0 else 0):
        multiply_rows(parked.factors.Phi[of_update.moving[i] : of_update.moving[i] + 3], of_update.J[i], 0, state.base)
    add_gram_to_state(1.0, noise, P, n)
    for i in range(moving if update.spread else 0):
        o = of_update.moving[i]
        for a in range(3):
            for b in range(a, 3):
                P[o + a, o + b] += of_update.own_spread[i, a, b]
    if update.blurred > 0.0:
        for label in range(len(state.offset)):
            o = state.offset[label]
            if o >= 0 and is_out_of_sight(label, parked) and _is_driven_through(update, x, P, o, noise[1, o]):
                forget(label, state, parked)


@inner
def _is_driven_through(update: Converting, x: Array, P: Array, o: int, fresh: float) -> bool:
    """Whether a linear model no longer holds where the landmark at ``o`` is, as after driving through it.

    ``fresh`` is the standard deviation that the turn of this step added to its azimuth.
    """
    rho, most = x[o + 2], update.blurred * update.blurred
    is_anywhere = P[o, o] - fresh * fresh > most or P[o + 1, o + 1] > most
    return rho <= 0.0 or is_anywhere or (rho > update.near and P[o + 2, o + 2] > most * rho * rho)


@inner
def take_root(P: Array, o: int, L: Array) -> None:
    """``L`` (3, 3) <- lower root of the block at ``o`` of P; a column is zero where nothing is left of the variance."""
    for j in range(3):
        for i in range(3):
            rest = P[o + j, o + i] if i >= j else 0.0
            for c in range(j if i >= j else 0):
                rest -= L[i, c] * L[j, c]
            if i > j:
                L[i, j] = rest / L[j, j] if L[j, j] > 0.0 else 0.0
            else:
                L[i, j] = np.sqrt(max(rest, 0.0))


@inner
def _move_rows(P: Array, n: int, at: Indices, J: Array, count: int) -> None:
    """P <- F P F' where F is the identity but for blocks J (count, 3, 3) at offsets ``at``."""
    for i in range(count):
        o, F = at[i], J[i]
        p0, p1, p2 = P[o], P[o + 1], P[o + 2]
        p1[o], p2[o], p2[o + 1] = p0[o + 1], p0[o + 2], p1[o + 2]
        multiply_rows(P[o : o + 3], F, o, n)
    for j in range(n):
        row = P[j]
        for i in range(count):
            o, F = at[i], J[i]
            if o + 2 >= j:
                multiply_columns(row, o, F)


@implement(place, Converted)
def place_converted(
    point: Converted, slam: Slam, state: State, k: int, label: int, z: Array, scratch: Scratch[ConvertingArrays]
) -> None:
    sensor, pixels, y = slam.sensor, slam.update.pixels, state.x[state.n : state.n + 3]
    convert(sensor, z[0], z[1], z[2], y)
    if pixels.debiasing:
        subtract_bias(sensor, pixels, z[0], z[1], z[2], y)
    conversion_jacobian(sensor, z[0], z[1], z[2], scratch.Jz)
    fill_matrix(scratch.Jp, 0.0)


@inner
def aim_apart(state: State, m: int, clones: int, recency: bool, parked: Clones, of_update: ConvertingArrays) -> None:
    """``frames`` (clones + 1, 3) <- the poses to which ``delta`` leads, ``turns`` <- d error about each / d delta.

    With ``recency`` that of the robot is the identity: most of its ``delta`` is noise of the last motion, which came
    after all older errors.
    """
    xi = of_update.poses[3]
    for c in range(clones):
        q, p = of_update.at[m + c], 3 + 3 * (m + c)
        for a in range(3):
            xi[a] = state.x[q + a] + of_update.delta[p + a]
        move_pose(parked.origin[of_update.number[c]], xi, of_update.frames[c])
        left_jacobian(xi, of_update.turns[c])
    move_pose(state.x[:3], of_update.delta[:3], of_update.frames[clones])
    fill(xi, 0.0)
    left_jacobian(xi if recency else of_update.delta[:3], of_update.turns[clones])


@inner
def aim_chained(state: State, m: int, clones: int, parked: Clones, of_update: ConvertingArrays) -> None:
    """The same in the chain; ``delta`` of the poses <- C delta, ``links`` (clones + 1, 3, 3) <- B."""
    whole, step, last, J = of_update.poses[0], of_update.poses[1], of_update.poses[2], of_update.three[0]
    whole_on, last_on = of_update.poses[3], of_update.poses[4]
    fill(whole, 0.0)
    fill(last, 0.0)
    for c in range(clones + 1):
        p, before = _place(m, c, clones), _place(m, of_update.on[0] if c == clones else c - 1, clones)
        if c == clones:
            copy(whole_on, whole)
            copy(last_on, last)
        for a in range(3):
            step[a] = of_update.delta[p + a] - last[a]
            last[a] = of_update.delta[p + a]
        left_jacobian(step, J)
        _turn_link(whole, J, of_update.links[c])
        for a in range(3):
            of_update.delta[p + a] = of_update.delta[before + a] if c > 0 else 0.0
            for b in range(3):
                of_update.delta[p + a] += of_update.links[c, a, b] * step[b]
        _move_on(whole, step)
        _compose(whole, state.x[:3] if c == clones else parked.origin[of_update.number[c]], of_update.frames[c])
        if c == of_update.on[0]:
            copy(whole, whole_on)
            copy(last, last_on)
        fill_matrix(of_update.turns[c], 0.0)
        for a in range(3):
            of_update.turns[c, a, a] = 1.0


@inner
def unchain(delta: Array, m: int, clones: int, of_update: ConvertingArrays) -> None:
    """``delta`` of the poses, in the places of the rows of ``of_update``, <- C^-1 delta."""
    step, last, total, last_on, total_on = (
        of_update.poses[0],
        of_update.poses[1],
        of_update.poses[2],
        of_update.poses[3],
        of_update.poses[4],
    )
    fill(last, 0.0)
    fill(total, 0.0)
    for c in range(clones + 1):
        p, B = _place(m, c, clones), of_update.links[c]
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
        if c == of_update.on[0]:
            copy(last, last_on)
            copy(total, total_on)


@inner
def cast_columns(rows: Array, count: int, at: Indices, m: int, clones: int, of_update: ConvertingArrays) -> None:
    """``rows`` (count, n) <- rows C'; ``at`` says where the landmarks, and then the clones, are among the columns."""
    for i in range(count):
        row = rows[i]
        u = v = u_on = v_on = (0.0, 0.0, 0.0)
        for c in range(clones + 1):
            q = 0 if c == clones else at[m + c]
            if c == clones:
                u, v = u_on, v_on
            u, v = _link(of_update.links[c], (row[q], row[q + 1], row[q + 2]), u, v)
            row[q], row[q + 1], row[q + 2] = v
            if c == of_update.on[0]:
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
def cast_state(state: State, m: int, clones: int, of_update: ConvertingArrays) -> None:
    """P (n, n) <- C P C', and its gathered ``rows`` with it."""
    P, n = state.P, state.n
    cast_columns(of_update.rows.T, n, of_update.place, m, clones, of_update)
    cast_columns(of_update.rows, 3 + 3 * (m + clones), of_update.at, m, clones, of_update)
    copy_matrix(of_update.rows[:3, :n], P[:3, :n])
    for c in range(clones):
        o, p = of_update.at[m + c], 3 + 3 * (m + c)
        replace_rows(P, n, o, of_update.rows[p : p + 3], of_update.rows[p : p + 3, o : o + 3])


@inner
def move_chain(state: State, m: int, clones: int, parked: Clones, scratch: Scratch[ConvertingArrays]) -> None:
    """The robot and all clones <- moved by the error ``scratch.delta`` (n,) about where they were aimed from."""
    of_update, x = scratch.of_update, state.x
    copy(scratch.delta[:3], of_update.delta[:3])
    for c in range(clones):
        p, q = 3 + 3 * (m + c), of_update.at[m + c]
        copy(scratch.delta[q : q + 3], of_update.delta[p : p + 3])
        fill(x[q : q + 3], 0.0)
    unchain(of_update.delta, m, clones, of_update)
    aim_chained(state, m, clones, parked, of_update)
    for c in range(clones):
        copy(of_update.frames[c], parked.origin[of_update.number[c]])
    copy(of_update.frames[clones], x[:3])


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
