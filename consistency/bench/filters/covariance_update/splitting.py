"""The active part of the state and the passive rest: split, joined by more, written back; see ``local``."""

from __future__ import annotations

from typing import NamedTuple

from consistency.bench.filters.compiler.dispatch import generic
from consistency.bench.filters.compiler.jit import inner
from consistency.bench.filters.kernel.arrays import copy, copy_matrix, fill, fill_matrix
from consistency.bench.filters.kernel.blas import (
    add_symmetric_product,
    add_times_transposed,
    add_transposed_times,
    product,
    symmetric_times,
    times_symmetric,
)
from consistency.bench.filters.kernel.covariance import gather_rows, state_index
from consistency.bench.filters.kernel.local_state import Factors
from consistency.bench.filters.kernel.part_functions import Slam, State, landmark_width, robot_width
from consistency.referee.types import Array


@generic()
def start_rows(covariance: NamedTuple, x: Array, width: int, p: int, i: int, j: int, Phi: Array) -> None:
    """Rows i.. of Phi, zero so far, <- the ``width`` variables at ``p`` of the whole, in columns j.. of the base."""
    raise NotImplementedError


@generic()
def to_base(covariance: NamedTuple, x: Array, p: int, robot: Array, landmark: Array) -> None:
    """Columns of the block at ``p`` of the whole state become those of the base; ``robot`` has the robot's columns."""
    raise NotImplementedError


@inner
def add_label(label: int, offset: int, n: int, b: int, r: int, w: int, local: Factors) -> None:
    """A block of the whole state, at ``offset``, is at ``n`` of the active part and at ``b`` of the base.

    Of what is no landmark the ``label`` is -1 - offset.
    """
    local.label[(n - r) // w], local.base[(b - r) // w] = label, offset


@inner
def _entry(P: Array, i: int, j: int) -> float:
    """P[i, j] of P (n, n) whose upper half is valid."""
    return P[i, j] if i <= j else P[j, i]


@inner
def append_rows(slam: Slam, state: State, label: int, local: Factors, Jp: Array) -> None:
    """A landmark that begins at its offset in the active part, with Jacobian Jp (w, r) by the robot."""
    r, w, o, base, Phi = (
        robot_width(slam.motion),
        landmark_width(slam.landmark),
        state.offset[label],
        state.base,
        local.Phi,
    )
    if base == 0:
        return
    for a in range(w):
        for j in range(base):
            total = 0.0
            for c in range(r):
                total += Jp[a, c] * Phi[c, j]
            Phi[o + a, j] = total
    local.label[(o - r) // w] = label


@inner
def take_out(covariance: NamedTuple, r: int, w: int, whole: State, n: int, local: Factors) -> None:
    """The robot and the blocks that ``local.base`` lists, ``n`` variables in all, become active and the base."""
    x, P = whole.x, whole.P
    for i in range(n):
        p = state_index(r, w, i, local.base)
        local.x[i] = x[p]
        for j in range(i, n):
            local.P[i, j] = _entry(P, p, state_index(r, w, j, local.base))
            local.Psi[i, j] = 0.0
        fill(local.Phi[i, :n], 0.0)
        local.theta[i] = 0.0
    start_rows(covariance, x, r, 0, 0, 0, local.Phi)
    for i in range(r, n, w):
        start_rows(covariance, x, w, state_index(r, w, i, local.base), i, i, local.Phi)
    for i in range(r):
        for j in range(i):
            local.P[i, j] = local.P[j, i]


@inner
def wake(covariance: NamedTuple, r: int, w: int, whole: State, n: int, b: int, more: int, local: Factors) -> None:
    """The last ``more`` variables that ``local.base`` lists join, at ``n`` in the active part, ``b`` in the base."""
    x0, P0, x, P, Phi, Psi = whole.x, whole.P, local.x, local.P, local.Phi, local.Psi
    D, G = local.cross[:more, :b], local.gain[:more, :b]
    for i in range(more):
        p = state_index(r, w, b + i, local.base)
        x[n + i] = x0[p]
        for j in range(b):
            D[i, j] = _entry(P0, p, state_index(r, w, j, local.base))
        for j in range(i, more):
            P[n + i, n + j] = _entry(P0, p, state_index(r, w, b + j, local.base))
    for j in range(r, b, w):
        to_base(covariance, x0, local.base[(j - r) // w], D[:, :r], D[:, j : j + 2])
    times_symmetric(D, Psi[:b, :b], G)
    fill_matrix(P[:n, n : n + more], 0.0)
    add_times_transposed(1.0, Phi[:n, :b], D, P[:n, n : n + more])
    add_times_transposed(-1.0, G, D, P[n : n + more, n : n + more])
    for i in range(more):
        for j in range(b):
            x[n + i] += D[i, j] * local.theta[j]
            Phi[n + i, j] = -G[i, j]
    fill_matrix(Phi[: n + more, b : b + more], 0.0)
    fill_matrix(Psi[: b + more, b : b + more], 0.0)
    fill(local.theta[b : b + more], 0.0)
    for i in range(0, more, w):
        start_rows(covariance, x0, w, local.base[(b + i - r) // w], n + i, b + i, Phi)


@inner
def join(slam: Slam, whole: State, n: int, b: int, local: Factors) -> None:
    """x, P of the ``whole`` <- what the active part and the factors say; the passive part is settled."""
    r, w, x = robot_width(slam.motion), landmark_width(slam.landmark), whole.x
    x0 = local.rows[:b, : whole.n]
    gather_rows(whole.P, whole.n, r, w, local.base, (b - r) // w, x0)
    owed = local.owed[:b, : whole.n]
    for j in range(r, b, w):
        to_base(slam.covariance, x, local.base[(j - r) // w], x0[:r].T, x0[j : j + 2].T)
    symmetric_times(local.Psi[:b, :b], x0, owed)
    add_symmetric_product(-1.0, x0, owed, whole.P[: whole.n, : whole.n])
    add_transposed_times(x0, local.theta[:b], x[: whole.n])
    _settle(r, w, whole, n, b, local)


@inner
def _settle(r: int, w: int, whole: State, n: int, b: int, local: Factors) -> None:
    """Rows and columns of the active variables in the whole state."""
    P, at, across = whole.P, local.label, local.owed[:n, : whole.n]
    for i in range((n - r) // w):
        at[i] = whole.offset[at[i]] if at[i] >= 0 else -1 - at[i]
    product(local.Phi[:n, :b], local.rows[:b, : whole.n], across)
    _settle_rows(whole, r, 0, 0, across, local)
    for i in range(r, n, w):
        _settle_rows(whole, w, i, state_index(r, w, i, at), across, local)
    for i in range(n):
        p = state_index(r, w, i, at)
        for j in range(i, n):
            q = state_index(r, w, j, at)
            P[min(p, q), max(p, q)] = local.P[i, j]
    copy_matrix(local.P[:r, :r], P[:r, :r])


@inner
def _settle_rows(whole: State, width: int, i: int, p: int, across: Array, local: Factors) -> None:
    """Those of the ``width`` variables at ``i`` of the active part and ``p`` of the whole."""
    for j in range(p):
        for a in range(width):
            whole.P[j, p + a] = across[i + a, j]
    for a in range(width):
        copy(across[i + a, p + a :], whole.P[p + a, p + a : whole.n])
        whole.x[p + a] = local.x[i + a]
