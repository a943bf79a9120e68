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
from consistency.bench.filters.kernel.covariance import across, gather_rows, mirror, state_index
from consistency.bench.filters.kernel.part_functions import Factors, Slam, State, landmark_width
from consistency.referee.types import Array


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
def add_label(label: int, offset: int, n: int, b: int, w: int, local: Factors) -> None:
    """A block of the whole state, at ``offset``, is at ``n`` of the active part and at ``b`` of the base.

    Of what is not a landmark the ``label`` is -1 - offset.
    """
    local.label[(n - 3) // w], local.base[(b - 3) // w] = label, offset


@inner
def _entry(P: Array, i: int, j: int) -> float:
    """P[i, j] of P (n, n) whose upper half is valid."""
    return P[i, j] if i <= j else P[j, i]


@inner
def append_rows(slam: Slam, state: State, label: int, local: Factors, Jp: Array) -> None:
    """A landmark that begins at its offset in the active part, with Jacobian Jp (w, 3) by the robot."""
    w, o, Phi = landmark_width(slam.landmark), state.offset[label], local.Phi
    if state.base == 0:
        return
    for a in range(w):
        for j in range(state.base):
            Phi[o + a, j] = across(Phi, j, Jp, a)
    local.label[(o - 3) // w] = label


@inner
def take_out(covariance: NamedTuple, w: int, whole: State, n: int, local: Factors) -> None:
    """The robot and the blocks that ``local.base`` lists, ``n`` variables in all, become active and the base."""
    x, P = whole.x, whole.P
    for i in range(n):
        p = state_index(w, i, local.base)
        local.x[i] = x[p]
        for j in range(i, n):
            local.P[i, j] = _entry(P, p, state_index(w, j, local.base))
            local.Psi[i, j] = 0.0
        fill(local.Phi[i, :n], 0.0)
        local.theta[i] = 0.0
    start_rows(covariance, x, 3, 0, 0, 0, local.Phi)
    for i in range(3, n, w):
        start_rows(covariance, x, w, state_index(w, i, local.base), i, i, local.Phi)
    mirror(local.P)


@inner
def wake(covariance: NamedTuple, w: int, whole: State, n: int, b: int, more: int, local: Factors) -> None:
    """The last ``more`` variables that ``local.base`` lists join, at ``n`` in the active part, ``b`` in the base."""
    x0, P0, x, P, Phi, Psi = whole.x, whole.P, local.x, local.P, local.Phi, local.Psi
    D, G = local.cross[:more, :b], local.gain[:more, :b]
    for i in range(more):
        p = state_index(w, b + i, local.base)
        x[n + i] = x0[p]
        for j in range(b):
            D[i, j] = _entry(P0, p, state_index(w, j, local.base))
        for j in range(i, more):
            P[n + i, n + j] = _entry(P0, p, state_index(w, b + j, local.base))
    for j in range(3, b, w):
        to_base(covariance, x0, local.base[(j - 3) // w], D[:, :3], D[:, j : j + 2])
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
        start_rows(covariance, x0, w, local.base[(b + i - 3) // w], n + i, b + i, Phi)


@inner
def join(slam: Slam, whole: State, n: int, b: int, local: Factors) -> None:
    """x, P of the ``whole`` <- what the active part and the factors say; the passive part is settled."""
    w, x = landmark_width(slam.landmark), whole.x
    x0 = local.rows[:b, : whole.n]
    gather_rows(whole.P, whole.n, w, local.base, (b - 3) // w, x0)
    owed = local.owed[:b, : whole.n]
    for j in range(3, b, w):
        to_base(slam.covariance, x, local.base[(j - 3) // w], x0[:3].T, x0[j : j + 2].T)
    symmetric_times(local.Psi[:b, :b], x0, owed)
    add_symmetric_product(-1.0, x0, owed, whole.P[: whole.n, : whole.n])
    add_transposed_times(x0, local.theta[:b], x[: whole.n])
    _settle(w, whole, n, b, local)


@inner
def _settle(w: int, whole: State, n: int, b: int, local: Factors) -> None:
    """Rows and columns of the active variables in the whole state."""
    P, at, beyond = whole.P, local.label, local.owed[:n, : whole.n]
    for i in range((n - 3) // w):
        at[i] = whole.offset[at[i]] if at[i] >= 0 else -1 - at[i]
    product(local.Phi[:n, :b], local.rows[:b, : whole.n], beyond)
    _settle_rows(whole, 3, 0, 0, beyond, local)
    for i in range(3, n, w):
        _settle_rows(whole, w, i, state_index(w, i, at), beyond, local)
    for i in range(n):
        p = state_index(w, i, at)
        for j in range(i, n):
            q = state_index(w, j, at)
            P[min(p, q), max(p, q)] = local.P[i, j]
    copy_matrix(local.P[:3, :3], P[:3, :3])


@inner
def _settle_rows(whole: State, width: int, i: int, p: int, across: Array, local: Factors) -> None:
    """Those of the ``width`` variables at ``i`` of the active part and ``p`` of the whole."""
    for j in range(p):
        for a in range(width):
            whole.P[j, p + a] = across[i + a, j]
    for a in range(width):
        copy(across[i + a, p + a :], whole.P[p + a, p + a : whole.n])
        whole.x[p + a] = local.x[i + a]
