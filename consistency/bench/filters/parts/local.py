"""Local updating: a step costs what the active part of the map costs, and nothing is approximated.

Compressed EKF, Guivant & Nebot (2001). The state is split into the active part a (robot, landmarks in use) and
the passive rest. While only a is moved and observed, all that a step does to the rest goes through the covariance
of the rest with the base, the variables that were active when the split was made (index 0: at that time):

    P_a,rest = Phi P0_base,rest        P_rest = P0_rest - P0_rest,base Psi P0_base,rest
    x_rest = x0_rest + P0_rest,base theta

Motion and observation act on rows of P_a, so they act on rows of [P_a | Phi] alike: the columns of Phi are
carried behind those of P_a, and with W = S^-1/2 Cov(z, .) over both (W_a, W_b) and the whitened innovation y

    Phi <- Phi - W_a' W_b,    Psi <- Psi + W_b' W_b,    theta <- theta + W_b' y.

The landmarks of the base are taken relative to the robot of the base: l - r and less its turn with the heading.
Otherwise what is observed is a small difference of large numbers wherever the pose is uncertain and its
surroundings are not: on a long loop rounding is then ten times as large.

A new landmark is a row of Phi. A passive landmark l that is seen again needs no pass over the map: it joins
the base, with P0_l,base Phi' as its covariance with a and -P0_l,base Psi as its row of Phi. Only when the base has
grown too large is everything written back; a rule for when keeps the sum of both costs low. It works for
every linearisation rule, because Cov(z, .) = M P_involved,. in each of them.
"""

from __future__ import annotations

from typing import NamedTuple

from consistency.bench.filters.compiler.dispatch import generic, implement, part
from consistency.bench.filters.compiler.jit import inner
from consistency.bench.filters.kernel.linalg import (
    add_symmetric_product,
    add_times_transposed,
    add_transposed_times,
    copy,
    copy_matrix,
    fill,
    fill_matrix,
    product,
    symmetric_times,
    times_symmetric,
)
from consistency.bench.filters.kernel.part_functions import (
    Factors,
    Slam,
    State,
    append,
    landmark_width,
    make_covariance_arrays,
    make_factors,
    prepare,
    settle,
)
from consistency.bench.filters.kernel.update_steps import Scratch, across, gather_rows, mirror, state_index
from consistency.referee.types import Array, Indices


@generic(default=True)
def start_rows(covariance: NamedTuple, x: Array, width: int, p: int, i: int, j: int, Phi: Array) -> None:
    """Rows i.. of Phi, zero so far, <- the ``width`` variables at ``p`` of the whole, in columns j.. of the base."""
    for a in range(width):
        Phi[i + a, j + a] += 1.0


@generic(default=True)
def to_base(covariance: NamedTuple, x: Array, p: int, robot: Array, landmark: Array) -> None:
    """Columns of the block at ``p`` of the whole state become those of the base; ``robot`` has the robot's columns.

    By default they are the same.
    """


@inner
def add_label(label: int, offset: int, n: int, b: int, w: int, factors: Factors) -> None:
    """A block of the whole state, at ``offset``, is at ``n`` of the active part and at ``b`` of the base.

    Of what is not a landmark the ``label`` is -1 - offset.
    """
    factors.label[(n - 3) // w], factors.base[(b - 3) // w] = label, offset


@inner
def _entry(P: Array, i: int, j: int) -> float:
    """P[i, j] of P (n, n) whose upper half is valid."""
    return P[i, j] if i <= j else P[j, i]


@inner
def append_rows(slam: Slam, state: State, label: int, factors: Factors, Jp: Array) -> None:
    """A landmark that begins at its offset in the active part, with Jacobian Jp (w, 3) by the robot."""
    w, o, Phi = landmark_width(slam.landmark), state.offset[label], factors.Phi
    if state.base == 0:
        return
    for a in range(w):
        for j in range(state.base):
            Phi[o + a, j] = across(Phi, j, Jp, a)
    factors.label[(o - 3) // w] = label


@inner
def take_out(covariance: NamedTuple, w: int, whole: State, n: int, factors: Factors) -> None:
    """The robot and the blocks that ``factors.base`` lists, ``n`` variables in all, become active and the base."""
    x, P = whole.x, whole.P
    for i in range(n):
        p = state_index(w, i, factors.base)
        factors.x[i] = x[p]
        for j in range(i, n):
            factors.P[i, j] = _entry(P, p, state_index(w, j, factors.base))
            factors.Psi[i, j] = 0.0
        fill(factors.Phi[i, :n], 0.0)
        factors.theta[i] = 0.0
    start_rows(covariance, x, 3, 0, 0, 0, factors.Phi)
    for i in range(3, n, w):
        start_rows(covariance, x, w, state_index(w, i, factors.base), i, i, factors.Phi)
    mirror(factors.P)


@inner
def wake(covariance: NamedTuple, w: int, whole: State, n: int, b: int, more: int, factors: Factors) -> None:
    """The last ``more`` variables that ``factors.base`` lists join, at ``n`` in the active part, ``b`` in the base."""
    x0, P0, x, P, Phi, Psi = whole.x, whole.P, factors.x, factors.P, factors.Phi, factors.Psi
    D, G = factors.cross[:more, :b], factors.gain[:more, :b]
    for i in range(more):
        p = state_index(w, b + i, factors.base)
        x[n + i] = x0[p]
        for j in range(b):
            D[i, j] = _entry(P0, p, state_index(w, j, factors.base))
        for j in range(i, more):
            P[n + i, n + j] = _entry(P0, p, state_index(w, b + j, factors.base))
    for j in range(3, b, w):
        to_base(covariance, x0, factors.base[(j - 3) // w], D[:, :3], D[:, j : j + 2])
    times_symmetric(D, Psi[:b, :b], G)
    fill_matrix(P[:n, n : n + more], 0.0)
    add_times_transposed(1.0, Phi[:n, :b], D, P[:n, n : n + more])
    add_times_transposed(-1.0, G, D, P[n : n + more, n : n + more])
    for i in range(more):
        for j in range(b):
            x[n + i] += D[i, j] * factors.theta[j]
            Phi[n + i, j] = -G[i, j]
    fill_matrix(Phi[: n + more, b : b + more], 0.0)
    fill_matrix(Psi[: b + more, b : b + more], 0.0)
    fill(factors.theta[b : b + more], 0.0)
    for i in range(0, more, w):
        start_rows(covariance, x0, w, factors.base[(b + i - 3) // w], n + i, b + i, Phi)


@inner
def join(slam: Slam, whole: State, n: int, b: int, factors: Factors) -> None:
    """x, P of the ``whole`` <- what the active part and the factors say; the passive part is settled."""
    w, x = landmark_width(slam.landmark), whole.x
    x0 = factors.rows[:b, : whole.n]
    gather_rows(whole.P, whole.n, w, factors.base, (b - 3) // w, x0)
    owed = factors.owed[:b, : whole.n]
    for j in range(3, b, w):
        to_base(slam.covariance, x, factors.base[(j - 3) // w], x0[:3].T, x0[j : j + 2].T)
    symmetric_times(factors.Psi[:b, :b], x0, owed)
    add_symmetric_product(-1.0, x0, owed, whole.P[: whole.n, : whole.n])
    add_transposed_times(x0, factors.theta[:b], x[: whole.n])
    _settle(w, whole, n, b, factors)


@inner
def _settle(w: int, whole: State, n: int, b: int, factors: Factors) -> None:
    """Rows and columns of the active variables in the whole state."""
    P, at, beyond = whole.P, factors.label, factors.owed[:n, : whole.n]
    for i in range((n - 3) // w):
        p = whole.offset[at[i]] if at[i] >= 0 else at[i]
        at[i] = p if p >= 0 else -1 - p
    product(factors.Phi[:n, :b], factors.rows[:b, : whole.n], beyond)
    _settle_rows(whole, 3, 0, 0, beyond, factors)
    for i in range(3, n, w):
        _settle_rows(whole, w, i, state_index(w, i, at), beyond, factors)
    for i in range(n):
        p = state_index(w, i, at)
        for j in range(i, n):
            q = state_index(w, j, at)
            P[min(p, q), max(p, q)] = factors.P[i, j]
    copy_matrix(factors.P[:3, :3], P[:3, :3])


@inner
def _settle_rows(whole: State, width: int, i: int, p: int, across: Array, factors: Factors) -> None:
    """Those of the ``width`` variables at ``i`` of the active part and ``p`` of the whole."""
    for j in range(p):
        for a in range(width):
            whole.P[j, p + a] = across[i + a, j]
    for a in range(width):
        copy(across[i + a, p + a :], whole.P[p + a, p + a : whole.n])
        whole.x[p + a] = factors.x[i + a]


LOCAL_FROM = 100  # variables in the state from which local updating is tried; measured, as the next three
TRAFFIC = 60.0  # writing P back, in variables of the base: what going through memory costs beside the arithmetic
OVERHEAD = 1e5  # multiplications (twice over) that the calls of a local step are worth
PAUSE = 16  # steps of dense updating after a local stretch that did not pay; four times as many after the next


@part(landmark="WorldPoint", error="Additive")
class Local(NamedTuple):
    """Variables in the state from which updates are local.

    Only where nothing but the robot moves, which an additive error of world points grants. What is taken relative
    to the robot (``_raw``, ``_relative``) is the planar position of a point.
    """

    start: int


@implement(make_covariance_arrays, Local)
def make_local_factors(covariance: Local, w: int, n: int, steps: int, n_landmarks: int) -> Factors:
    if n < covariance.start:
        return make_factors(3, 3, 1)
    c = max(n // (2 * w), 1) * w
    return make_factors(c, n, c // w)


@implement(prepare, Local)
def prepare_active(
    covariance: Local, slam: Slam, whole: State, state: State, labels: Indices, factors: Factors
) -> tuple[State, State]:
    """The active part that a step works on, settled first where that is due, and split where it begins."""
    w, home, offset = landmark_width(slam.landmark), whole.offset, state.offset
    x, P, n, b = state.x, state.P, state.n, state.base
    if b > 0 and is_due(whole.n, n, b, w * len(labels), factors):
        join(slam, whole, n, b, factors)
        count_settling(whole.n, n, b, factors)
        x, P, n, b = whole.x, whole.P, whole.n, 0
        copy(home, offset)
    if b == 0 and n >= covariance.start and may_split(w, len(labels), factors):
        n = split(covariance, w, whole, labels, offset, factors)
        start_counting(n, factors)
        x, P, b = factors.x, factors.P, n
    if b > 0:
        more = activate(covariance, w, whole, labels, State(x, P, n, b, offset), factors)
        n, b = n + more, b + more
        count(whole.n, n, b, more, w * len(labels), factors)
    return whole, State(x, P, n, b, offset)


@implement(append, Local)
def append_factors(
    covariance: Local, slam: Slam, state: State, label: int, factors: Factors, scratch: Scratch[NamedTuple]
) -> None:
    append_rows(slam, state, label, factors, scratch.Jp)


@implement(settle, Local)
def settle_active(covariance: Local, slam: Slam, whole: State, state: State, factors: Factors) -> None:
    if state.base > 0:
        join(slam, whole, state.n, state.base, factors)


@implement(start_rows, Local)
def start_raw_rows(covariance: Local, x: Array, width: int, p: int, i: int, j: int, Phi: Array) -> None:
    for a in range(width):
        Phi[i + a, j + a] += 1.0
    if p > 0:
        Phi[i, 0] += 1.0
        Phi[i, 2] -= x[p + 1] - x[1]
        Phi[i + 1, 1] += 1.0
        Phi[i + 1, 2] += x[p] - x[0]


@implement(to_base, Local)
def to_relative_base(covariance: Local, x: Array, p: int, robot: Array, landmark: Array) -> None:
    """x and y of a landmark relative to the robot."""
    dx, dy = x[p] - x[0], x[p + 1] - x[1]
    for i in range(len(landmark)):
        landmark[i, 0] -= robot[i, 0] - dy * robot[i, 2]
        landmark[i, 1] -= robot[i, 1] + dx * robot[i, 2]


@inner
def split(covariance: Local, w: int, whole: State, labels: Indices, offset: Indices, factors: Factors) -> int:
    """The robot and the known ones of ``labels`` (m,) become active and the base; returns their number of variables.

    ``offset`` (n_landmarks,) <- that of each landmark in the active part, or -1.
    """
    fill(offset, -1)
    n = 3
    for label in labels:
        if whole.offset[label] >= 0:
            add_label(label, whole.offset[label], n, n, w, factors)
            offset[label] = n
            n += w
    take_out(covariance, w, whole, n, factors)
    return n


@inner
def activate(covariance: Local, w: int, whole: State, labels: Indices, active: State, factors: Factors) -> int:
    """Passive ones of ``labels`` (m,) become active and join the base; returns by how many variables both grow."""
    more, n, b, home = 0, active.n, active.base, whole.offset
    for label in labels:
        if home[label] >= 0 and active.offset[label] < 0:
            add_label(label, home[label], n + more, b + more, w, factors)
            active.offset[label] = n + more
            more += w
    if more > 0:
        wake(covariance, w, whole, n, b, more, factors)
    return more


# --- when ----------------------------------------------------------------------------------------
# Costs are multiplications, twice over; of the steps since the split: their number, their cost, what dense steps would
# have cost, the size of the first base. After a stretch that did not pay: the pause, and what is left of it.
STEPS, SPENT, DENSE, FIRST, LONG, LEFT = range(6)


@inner
def _work(n: int, b: int, seen: int) -> float:
    """Cost of a local step in which landmarks of ``seen`` variables are seen."""
    return OVERHEAD + float(seen) * (n + b) * (n + b)


@inner
def may_split(w: int, seen: int, factors: Factors) -> bool:
    """Whether the next steps are to be local; counts the pause down."""
    tally = factors.tally
    tally[LEFT] = max(tally[LEFT] - 1.0, 0.0)
    return tally[LEFT] == 0.0 and 2 * (3 + w * seen) <= len(factors.x)


@inner
def start_counting(b: int, factors: Factors) -> None:
    """After a split with a base of ``b`` variables."""
    tally = factors.tally
    tally[STEPS] = tally[SPENT] = tally[DENSE] = 0.0
    tally[FIRST] = b


@inner
def count(whole: int, n: int, b: int, more: int, seen: int, factors: Factors) -> None:
    """A local step in which ``more`` variables became active."""
    tally = factors.tally
    tally[STEPS] += 1.0
    tally[SPENT] += _work(n, b, seen) + (OVERHEAD + 4.0 * more * b * (n + b) if more > 0 else 0.0)
    tally[DENSE] += float(seen) * whole * whole


@inner
def is_due(whole: int, n: int, b: int, seen: int, factors: Factors) -> bool:
    """Whether settling now makes the average step cheapest, or the active part has no room for the next.

    The average falls until a step costs more than it. What settling costs for each variable that joined since the
    split is paid whenever it is done; waiting spreads what it costs for the first ones over more steps.
    """
    tally = factors.tally
    if n + seen > len(factors.x) or n + b > whole:
        return True
    return _work(n, b, seen) * tally[STEPS] - tally[SPENT] > whole * whole * (tally[FIRST] + TRAFFIC)


@inner
def count_settling(whole: int, n: int, b: int, factors: Factors) -> None:
    """Whether the stretch paid; if not, a pause."""
    tally = factors.tally
    settling = whole * whole * (b + TRAFFIC) + 2.0 * whole * b * (n + b)
    paid = tally[SPENT] + settling < tally[DENSE]
    tally[LONG] = 0.0 if paid else max(4.0 * tally[LONG], PAUSE)
    tally[LEFT] = tally[LONG]
