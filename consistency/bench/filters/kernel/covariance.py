"""The state covariance of the kernels: row-major, its upper half valid, the block of the robot full.

A symmetric update of half of P costs half, and BLAS leaves the other half alone. Everything that reads or
writes P does it here, but for the block and the rows of the robot, which are whole.
"""

from __future__ import annotations

from consistency.bench.filters.compiler.jit import inner
from consistency.bench.filters.kernel.arrays import copy, copy_matrix
from consistency.bench.filters.kernel.blas import add_gram, upper_cholesky
from consistency.bench.filters.kernel.linalg import DEFICIENT
from consistency.bench.filters.kernel.part_functions import State
from consistency.referee.types import Array, Indices


@inner
def state_index(w: int, a: int, at: Indices) -> int:
    """Index in the state of the a-th of some variables: the robot's, then those of the landmarks at ``at``."""
    return a if a < 3 else at[(a - 3) // w] + (a - 3) % w


@inner
def gather_rows(P: Array, n: int, w: int, at: Indices, m: int, rows: Array) -> None:
    """``rows`` (3 + w m, n) <- whole rows of P (n, n): the robot's, then those of ``m`` landmarks at ``at`` (m,)."""
    copy_matrix(P[:3, :n], rows[:3, :n])
    for i in range(m):
        o, first = at[i], 3 + w * i
        for j in range(o):
            for a in range(w):
                rows[first + a, j] = P[j, o + a]
        for a in range(w):
            for j in range(o + a, n):
                rows[first + a, j] = P[o + a, j]
            for b in range(a):
                rows[first + a, o + b] = rows[first + b, o + a]


@inner
def gather_all_rows(state: State, Phi: Array, w: int, at: Indices, m: int, rows: Array) -> None:
    """:func:`gather_rows`, with those of Phi, which are treated alike, in columns n..n + base - 1."""
    n, base = state.n, state.base
    gather_rows(state.P, n, w, at, m, rows)
    for i in range(3 + w * m if base > 0 else 0):
        copy(Phi[state_index(w, i, at), :base], rows[i, n : n + base])


@inner
def definite_root(A: Array, scale: Array) -> bool:
    """Upper half of A (n, n) <- its root, ``scale`` (n,) <- its diagonal; False where a pivot is not above rounding."""
    for i in range(len(A)):
        scale[i] = A[i, i]
    definite = upper_cholesky(A)
    for i in range(len(A)):
        definite = definite and A[i, i] * A[i, i] > DEFICIENT * scale[i]
    return definite


@inner
def add_gram_to_state(weight: float, W: Array, P: Array, n: int) -> None:
    """P (n, n) <- P + weight W' W with W (k, n); the block of the robot is valid as a whole."""
    add_gram(weight, W, P[:n, :n])
    mirror(P)


@inner
def mirror(P: Array) -> None:
    """The lower half of the block of the robot <- its upper half."""
    for a in range(3):
        for b in range(a):
            P[a, b] = P[b, a]


@inner
def replace_rows(P: Array, n: int, o: int, rows: Array, own: Array) -> None:
    """Rows and columns of the three variables at ``o`` <- ``rows`` (3, >= n), their own block <- ``own`` (3, 3)."""
    for j in range(o):
        for a in range(3):
            P[j, o + a] = rows[a, j]
    for a in range(3):
        for j in range(o + 3, n):
            P[o + a, j] = rows[a, j]
        for b in range(a, 3):
            P[o + a, o + b] = P[o + b, o + a] = 0.5 * (own[a, b] + own[b, a])


@inner
def move_block(P: Array, n: int, o: int, F: Array) -> None:
    """P (n, n) <- G P G', with G the identity but for its block F (3, 3) at ``o``, beyond the robot's."""
    for j in range(o):
        multiply_columns(P[j], o, F)
    multiply_rows(P[o : o + 3], F, o + 3, n)
    p0, p1, p2 = P[o], P[o + 1], P[o + 2]
    xx, xy, xz, yy, yz, zz = p0[o], p0[o + 1], p0[o + 2], p1[o + 1], p1[o + 2], p2[o + 2]
    for a in range(3):
        v0 = F[a, 0] * xx + F[a, 1] * xy + F[a, 2] * xz
        v1 = F[a, 0] * xy + F[a, 1] * yy + F[a, 2] * yz
        v2 = F[a, 0] * xz + F[a, 1] * yz + F[a, 2] * zz
        for b in range(a, 3):
            P[o + a, o + b] = v0 * F[b, 0] + v1 * F[b, 1] + v2 * F[b, 2]


@inner
def multiply_rows(rows: Array, F: Array, first: int, last: int) -> None:
    """``rows`` (3, n) <- F rows in columns first..last-1, with F (3, 3)."""
    p0, p1, p2 = rows[0], rows[1], rows[2]
    for j in range(first, last):
        v0, v1, v2 = p0[j], p1[j], p2[j]
        p0[j] = F[0, 0] * v0 + F[0, 1] * v1 + F[0, 2] * v2
        p1[j] = F[1, 0] * v0 + F[1, 1] * v1 + F[1, 2] * v2
        p2[j] = F[2, 0] * v0 + F[2, 1] * v1 + F[2, 2] * v2


@inner
def multiply_columns(row: Array, o: int, F: Array) -> None:
    """The three entries of ``row`` (n,) at ``o`` <- F times them."""
    v0, v1, v2 = row[o], row[o + 1], row[o + 2]
    for a in range(3):
        row[o + a] = F[a, 0] * v0 + F[a, 1] * v1 + F[a, 2] * v2


@inner
def begin_landmark(P: Array, n: int, o: int, Jp: Array, Jz: Array, R: Array) -> None:
    """Rows and columns at ``o`` of P (n, n) <- covariance of a new landmark there, Jp (w, 3), Jz (w, s), R (s, s)."""
    w = len(Jp)
    for j in range(o):
        for a in range(w):
            P[j, o + a] = across(P, j, Jp, a)
    for a in range(w):
        for j in range(o + w, n):
            P[o + a, j] = across(P, j, Jp, a)
        for b in range(a, w):
            P[o + a, o + b] = 0.5 * (_own(P, o, Jp, Jz, R, a, b) + _own(P, o, Jp, Jz, R, b, a))


@inner
def across(P: Array, j: int, Jp: Array, a: int) -> float:
    """Entry (a, j) of Jp P_pose,all, (w, n)."""
    total = 0.0
    for c in range(Jp.shape[1]):
        total += Jp[a, c] * P[c, j]
    return total


@inner
def _own(P: Array, n: int, Jp: Array, Jz: Array, R: Array, a: int, b: int) -> float:
    """Entry (a, b) of Jp P_pose Jp' + Jz R Jz', (w, w)."""
    s, total = Jz.shape[1], 0.0
    for c in range(max(3, s)):
        if c < 3:
            total += P[c, n + a] * Jp[b, c]
        if c < s:
            for d in range(s):
                total += Jz[a, c] * R[c, d] * Jz[b, d]
    return total
