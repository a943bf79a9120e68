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
Else what is observed would be a small difference of large numbers wherever the pose is uncertain and what is around
it is not: on a long loop rounding is then ten times as large.

A new landmark is a row of Phi. A passive landmark l that is seen again needs no pass over the map: it joins
the base, with P0_l,base Phi' as its covariance with a and -P0_l,base Psi as its row of Phi. Only when the base has
grown too large is everything written back; a rule for when keeps the sum of both costs low. It works for
every linearisation rule, because Cov(z, .) = M P_involved,. in each of them.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from consistency.filters.blas import (
    add_symmetric_product,
    add_times_transposed,
    add_transposed_times,
    product,
    symmetric_times,
    times_symmetric,
)
from consistency.filters.covariance import gather_rows
from consistency.filters.jit import inner

LOCAL_FROM = 100  # variables in the state from which local updating is tried; measured, as the next three
TRAFFIC = 60.0  # writing P back, in variables of the base: what going through memory costs beside the arithmetic
OVERHEAD = 1e5  # multiplications (twice over) that the calls of a local step are worth
PAUSE = 16  # steps of dense updating after a local stretch that did not pay; four times as many after the next


class Local(NamedTuple):
    """The active part, of up to ``c`` variables of ``n``, and what the passive rest is owed."""

    x: Any  # (c,)
    P: Any  # (c, c), as ``covariance`` keeps it
    Phi: Any  # (c, c)
    Psi: Any  # (c, c), upper half
    theta: Any  # (c,)
    label: Any  # (c // 3,) labels of the active landmarks in their order
    base: Any  # (c // 3,) offsets in the whole state of the landmarks in the base
    rows: Any  # (c, n) P0_base,all
    owed: Any  # (c, n) Psi P0_base,all, then Phi P0_base,all
    cross: Any  # (c, c) P0_l,base of the landmarks l that join
    gain: Any  # (c, c) P0_l,base Psi
    tally: Any  # (6,) what the rules at the end of this file count


@inner
def make_local(n: int, local_from: int) -> Any:
    """Arrays for a state of up to ``n`` variables; empty where it never reaches ``local_from``."""
    c, width = (max(n // 6, 1) * 3, n) if n >= local_from else (3, 3)
    return Local(
        np.empty(c),
        np.empty((c, c)),
        np.empty((c, c)),
        np.empty((c, c)),
        np.empty(c),
        np.empty(c // 3, np.int64),
        np.empty(c // 3, np.int64),
        np.empty((c, width)),
        np.empty((c, width)),
        np.empty((c, c)),
        np.empty((c, c)),
        np.zeros(6),
    )


@inner
def _entry(P: Any, i: int, j: int) -> Any:
    return P[i, j] if i <= j else P[j, i]


@inner
def _place(i: int, at: Any) -> Any:
    """Variable in the whole state of the i-th of a part: the robot, then landmarks at offsets ``at``."""
    return i if i < 3 else at[i // 3 - 1] + i % 3


@inner
def _raw(x: Any, p: int, i: int, j: int, Phi: Any) -> None:
    """Adds to rows i..i+2 of Phi the robot, or the landmark at ``p`` of the whole state, in columns of the base."""
    for a in range(3):
        Phi[i + a, j + a] += 1.0
    if p > 0:
        Phi[i, 0] += 1.0
        Phi[i, 2] -= x[p + 1] - x[1]
        Phi[i + 1, 1] += 1.0
        Phi[i + 1, 2] += x[p] - x[0]


@inner
def _relative(x: Any, p: int, robot: Any, landmark: Any) -> None:
    """Columns of the landmark at ``p``, x and y, become those of the base, relative to the columns of the ``robot``."""
    dx, dy = x[p] - x[0], x[p + 1] - x[1]
    for i in range(len(landmark)):
        landmark[i, 0] -= robot[i, 0] - dy * robot[i, 2]
        landmark[i, 1] -= robot[i, 1] + dx * robot[i, 2]


@inner
def split(x: Any, P: Any, home: Any, labels: Any, offset: Any, local: Any) -> int:
    """The robot and the known ones of ``labels`` become active and the base; returns their number of variables.

    ``home`` has the offset of each landmark in the whole state; ``offset`` <- that in the active part, or -1.
    """
    offset[:] = -1
    n = 3
    for label in labels:
        if home[label] >= 0:
            local.label[n // 3 - 1], local.base[n // 3 - 1] = label, home[label]
            offset[label] = n
            n += 3
    for i in range(n):
        p = _place(i, local.base)
        local.x[i] = x[p]
        for j in range(i, n):
            local.P[i, j] = _entry(P, p, _place(j, local.base))
            local.Psi[i, j] = 0.0
        local.Phi[i, :n] = 0.0
        local.theta[i] = 0.0
    for i in range(0, n, 3):
        _raw(x, _place(i, local.base), i, i, local.Phi)
    for i in range(3):
        for j in range(i):
            local.P[i, j] = local.P[j, i]
    return n


@inner
def activate(x0: Any, P0: Any, home: Any, labels: Any, offset: Any, n: int, b: int, local: Any) -> int:
    """The passive ones of ``labels`` become active and join the base; returns by how many variables both grow."""
    more = 0
    for label in labels:
        if home[label] >= 0 and offset[label] < 0:
            local.label[(n + more) // 3 - 1], local.base[(b + more) // 3 - 1] = label, home[label]
            offset[label] = n + more
            more += 3
    if more > 0:
        _activate(x0, P0, n, b, more, local)
    return more


@inner
def _activate(x0: Any, P0: Any, n: int, b: int, more: int, local: Any) -> None:
    """The last ``more`` variables of the base, at ``n`` in the active part and at ``b`` in the base."""
    x, P, Phi, Psi = local.x, local.P, local.Phi, local.Psi
    D, G = local.cross[:more, :b], local.gain[:more, :b]
    for i in range(more):
        p = _place(b + i, local.base)
        x[n + i] = x0[p]
        for j in range(b):
            D[i, j] = _entry(P0, p, _place(j, local.base))
        for j in range(i, more):
            P[n + i, n + j] = _entry(P0, p, _place(b + j, local.base))
    for j in range(3, b, 3):
        _relative(x0, local.base[j // 3 - 1], D[:, :3], D[:, j : j + 2])
    times_symmetric(D, Psi[:b, :b], G)
    P[:n, n : n + more] = 0.0
    add_times_transposed(1.0, Phi[:n, :b], D, P[:n, n : n + more])
    add_times_transposed(-1.0, G, D, P[n : n + more, n : n + more])
    for i in range(more):
        for j in range(b):
            x[n + i] += D[i, j] * local.theta[j]
            Phi[n + i, j] = -G[i, j]
    Phi[: n + more, b : b + more] = 0.0
    Psi[: b + more, b : b + more] = 0.0
    local.theta[b : b + more] = 0.0
    for i in range(0, more, 3):
        _raw(x0, local.base[(b + i) // 3 - 1], n + i, b + i, Phi)


@inner
def append(label: int, n: int, b: int, Jp: Any, local: Any) -> None:
    """A new landmark at ``n`` of the active part."""
    Phi = local.Phi
    for a in range(3):
        for j in range(b):
            Phi[n + a, j] = Jp[a, 0] * Phi[0, j] + Jp[a, 1] * Phi[1, j] + Jp[a, 2] * Phi[2, j]
    local.label[n // 3 - 1] = label


@inner
def join(x: Any, P: Any, whole: int, home: Any, n: int, b: int, local: Any) -> None:
    """x, P of ``whole`` variables <- what the active part and the factors say; the passive part is settled."""
    x0 = local.rows[:b, :whole]
    gather_rows(P, whole, local.base, b // 3 - 1, x0)
    owed = local.owed[:b, :whole]
    for j in range(3, b, 3):
        _relative(x, local.base[j // 3 - 1], x0[:3].T, x0[j : j + 2].T)
    symmetric_times(local.Psi[:b, :b], x0, owed)
    add_symmetric_product(-1.0, x0, owed, P[:whole, :whole])
    add_transposed_times(x0, local.theta[:b], x[:whole])
    _settle_active(x, P, whole, home, n, b, local)


@inner
def _settle_active(x: Any, P: Any, whole: int, home: Any, n: int, b: int, local: Any) -> None:
    """Rows and columns of the active variables in the whole state."""
    at, across = local.label, local.owed[:n, :whole]
    for i in range(n // 3 - 1):
        at[i] = home[at[i]]
    product(local.Phi[:n, :b], local.rows[:b, :whole], across)
    for i in range(0, n, 3):
        p = _place(i, at)
        c0, c1, c2 = across[i], across[i + 1], across[i + 2]
        for j in range(p):
            row = P[j]
            row[p], row[p + 1], row[p + 2] = c0[j], c1[j], c2[j]
        for a in range(3):
            P[p + a, p + a : whole] = across[i + a, p + a :]
            x[p + a] = local.x[i + a]
    for i in range(n):
        p = _place(i, at)
        for j in range(i, n):
            q = _place(j, at)
            P[min(p, q), max(p, q)] = local.P[i, j]
    P[:3, :3] = local.P[:3, :3]


# --- when ----------------------------------------------------------------------------------------
# Costs are multiplications, twice over; of the steps since the split: their number, their cost, what dense steps would
# have cost, the size of the first base. After a stretch that did not pay: the pause, and what is left of it.
STEPS, SPENT, DENSE, FIRST, LONG, LEFT = range(6)


@inner
def _work(n: int, b: int, seen: int) -> Any:
    return OVERHEAD + 3.0 * seen * (n + b) * (n + b)


@inner
def _settling(whole: int, n: int, b: int) -> Any:
    return whole * whole * (b + TRAFFIC) + 2.0 * whole * b * (n + b)


@inner
def may_split(whole: int, seen: int, local: Any) -> Any:
    """Whether the next steps are to be local; counts the pause down."""
    tally = local.tally
    tally[LEFT] = max(tally[LEFT] - 1.0, 0.0)
    return tally[LEFT] == 0.0 and 6 * (1 + seen) <= len(local.x)


@inner
def start_counting(b: int, local: Any) -> None:
    """After a split with a base of ``b`` variables."""
    tally = local.tally
    tally[STEPS] = tally[SPENT] = tally[DENSE] = 0.0
    tally[FIRST] = b


@inner
def count(whole: int, n: int, b: int, more: int, seen: int, local: Any) -> None:
    """A local step in which ``more`` variables became active."""
    tally = local.tally
    tally[STEPS] += 1.0
    tally[SPENT] += _work(n, b, seen) + (OVERHEAD + 4.0 * more * b * (n + b) if more > 0 else 0.0)
    tally[DENSE] += 3.0 * seen * whole * whole


@inner
def is_due(whole: int, n: int, b: int, seen: int, local: Any) -> Any:
    """Whether settling now makes the average step cheapest, or the active part has no room for the next.

    The average falls until a step costs more than it. What settling costs for each variable that joined since the
    split is paid whenever it is done; waiting spreads what it costs for the first ones over more steps.
    """
    tally = local.tally
    if n + 3 * seen > len(local.x) or n + b > whole:
        return True
    return _work(n, b, seen) * tally[STEPS] - tally[SPENT] > whole * whole * (tally[FIRST] + TRAFFIC)


@inner
def count_settling(whole: int, n: int, b: int, local: Any) -> None:
    """Whether the stretch paid; if not, a pause."""
    tally = local.tally
    paid = tally[SPENT] + _settling(whole, n, b) < tally[DENSE]
    tally[LONG] = 0.0 if paid else max(4.0 * tally[LONG], PAUSE)
    tally[LEFT] = tally[LONG]
