"""The state covariance of the kernels: row-major, its upper half valid, its 3 x 3 pose block full.

A symmetric update of half of P costs half, and BLAS leaves the other half alone. Everything that reads or
writes P does it here, but for the pose block and the three rows of the robot, which are whole.
"""

from __future__ import annotations

from typing import Any

from consistency.filters.blas import add_gram, upper_cholesky
from consistency.filters.jit import inner
from consistency.filters.linalg import DEFICIENT


@inner
def gather_rows(P: Any, n: int, at: Any, m: int, rows: Any) -> None:
    """Whole rows of P: of the robot in rows 0-2, then of the ``m`` landmarks at offsets ``at``."""
    rows[:3, :n] = P[:3, :n]
    for i in range(m):
        o = at[i]
        r0, r1, r2 = rows[3 * i + 3], rows[3 * i + 4], rows[3 * i + 5]
        for j in range(o):
            row = P[j]
            r0[j], r1[j], r2[j] = row[o], row[o + 1], row[o + 2]
        r0[o:n] = P[o, o:n]
        r1[o + 1 : n] = P[o + 1, o + 1 : n]
        r2[o + 2 : n] = P[o + 2, o + 2 : n]
        r1[o], r2[o], r2[o + 1] = r0[o + 1], r0[o + 2], r1[o + 2]


@inner
def definite_root(A: Any, scale: Any) -> Any:
    """Upper half of A <- its root; False if it has none or a pivot is lost to rounding. ``scale`` <- its diagonal."""
    for i in range(len(A)):
        scale[i] = A[i, i]
    definite = upper_cholesky(A)
    for i in range(len(A)):
        definite = definite and A[i, i] * A[i, i] > DEFICIENT * scale[i]
    return definite


@inner
def subtract_gram(P: Any, n: int, W: Any) -> None:
    """P <- P - W' W."""
    add_gram(-1.0, W, P[:n, :n])
    for a in range(3):
        for b in range(a):
            P[a, b] = P[b, a]


@inner
def move_rows(P: Any, n: int, fx: Any, fy: Any) -> None:
    """P <- F P where F is the identity but for F[0, 2] = fx and F[1, 2] = fy."""
    p0, p1, p2 = P[0], P[1], P[2]
    for j in range(n):
        p0[j] += fx * p2[j]
        p1[j] += fy * p2[j]


@inner
def move_pose(P: Any, n: int, fx: Any, fy: Any) -> None:
    """P <- F P F'."""
    move_rows(P, n, fx, fy)
    for i in range(3):
        P[i, 0] += fx * P[i, 2]
        P[i, 1] += fy * P[i, 2]


@inner
def append_landmark(P: Any, n: int, Jp: Any, Jz: Any, R: Any) -> None:
    """Covariance of a landmark put at n: its own and the one with everything before it."""
    for j in range(n):
        for a in range(3):
            P[j, n + a] = Jp[a, 0] * P[0, j] + Jp[a, 1] * P[1, j] + Jp[a, 2] * P[2, j]
    for a in range(3):
        for b in range(a, 3):
            P[n + a, n + b] = 0.5 * (_own(P, n, Jp, Jz, R, a, b) + _own(P, n, Jp, Jz, R, b, a))


@inner
def _own(P: Any, n: int, Jp: Any, Jz: Any, R: Any, a: int, b: int) -> Any:
    """Entry (a, b) of Jp P_pose Jp' + Jz R Jz'."""
    total = 0.0
    for c in range(3):
        total += P[c, n + a] * Jp[b, c]
        for d in range(3):
            total += Jz[a, c] * R[c, d] * Jz[b, d]
    return total
