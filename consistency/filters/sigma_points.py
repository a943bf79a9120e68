"""The unscented rule, exact at the size of what is observed.

With the variables ordered robot, seen landmarks (as observed), the rest, the Cholesky factor of P is
[[C, 0], [G, D]]. A sigma point through a column of D moves only variables that neither f nor h reads, so
it projects onto the mean: such points add nothing to S or to the cross-covariance, and their weight counts
as weight of the centre. What is left is 2 L + 1 points over the L = 3 + 3 m variables involved; the rest of
the state follows through G = P_rest,involved C'^-1, so that Cov(z, x) = Cov(z, C-coordinates) C^-1 P_involved,x
and M = Cov(z, C-coordinates) C^-1, of size 3 m x L, is all that sees the whole state.

C is lower triangular. The points of column j of the i-th seen landmark leave the robot and the landmarks
before i where they are, bit by bit; only what comes from i on is projected again.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from consistency.filters.blas import add_gram, product_of_transposed, solve_upper
from consistency.filters.covariance import definite_root
from consistency.filters.jit import inner
from consistency.filters.linalg import semidefinite_cholesky
from consistency.filters.observation import predict_observation
from consistency.models.motion import unicycle


@inner
def _weights(L: int, points: Any) -> Any:
    """Spread and weights of scaled sigma points over L variables (Merwe 2004): spread, w0m, w0c, w."""
    alpha, beta, kappa = points[0], points[1], points[2]
    spread2 = alpha * alpha * (L + kappa)
    w0 = 1.0 - L / spread2
    return np.sqrt(spread2), w0, w0 + 1.0 - alpha * alpha + beta, 0.5 / spread2


@inner
def predict_unscented(x: Any, P: Any, n: int, Phi: Any, b: int, u: Any, points: Any, work: Any) -> None:
    """x, P, Phi <- the unscented transform of the robot; without process noise."""
    spread, w0m, w0c, w = _weights(3, points)
    C, F, Y = work.small, work.F, work.moved
    if not semidefinite_cholesky(P[:3, :3], C):
        P[0, 0] = np.nan  # an indefinite prior is reported by the loop
        return
    Y[6, 0], Y[6, 1], Y[6, 2] = unicycle(x[0], x[1], x[2], u[0], u[1], u[2])
    for j in range(3):
        for side in range(2):
            step = spread if side == 0 else -spread
            p0, p1, p2 = x[0] + step * C[0, j], x[1] + step * C[1, j], x[2] + step * C[2, j]
            k = 2 * j + side
            Y[k, 0], Y[k, 1], Y[k, 2] = unicycle(p0, p1, p2, u[0], u[1], u[2])
    for a in range(3):
        x[a] = w0m * Y[6, a]
        for k in range(6):
            x[a] += w * Y[k, a]
        for j in range(3):
            F[a, j] = w * spread * (Y[2 * j, a] - Y[2 * j + 1, a])  # Cov(f, C-coordinates)
    _move_cross(P, 3, n, C, F)
    _move_cross(Phi, 0, b, C, F)
    for a in range(3):
        for b in range(3):
            P[a, b] = w0c * (Y[6, a] - x[a]) * (Y[6, b] - x[b])
            for k in range(6):
                P[a, b] += w * (Y[k, a] - x[a]) * (Y[k, b] - x[b])


@inner
def _move_cross(P: Any, first: int, last: int, C: Any, F: Any) -> None:
    """Columns first..last-1 of the robot's rows: P <- F C^-1 P; a zero pivot of C carries nothing."""
    i0, i1, i2 = _reciprocal(C[0, 0]), _reciprocal(C[1, 1]), _reciprocal(C[2, 2])
    c10, c20, c21 = C[1, 0], C[2, 0], C[2, 1]
    f00, f01, f02 = F[0, 0], F[0, 1], F[0, 2]
    f10, f11, f12 = F[1, 0], F[1, 1], F[1, 2]
    f20, f21, f22 = F[2, 0], F[2, 1], F[2, 2]
    p0, p1, p2 = P[0], P[1], P[2]
    for j in range(first, last):
        g0 = p0[j] * i0
        g1 = (p1[j] - c10 * g0) * i1
        g2 = (p2[j] - c20 * g0 - c21 * g1) * i2
        p0[j] = f00 * g0 + f01 * g1 + f02 * g2
        p1[j] = f10 * g0 + f11 * g1 + f12 * g2
        p2[j] = f20 * g0 + f21 * g1 + f22 * g2


@inner
def _reciprocal(pivot: Any) -> Any:
    return 0.0 if pivot == 0.0 else 1.0 / pivot


@inner
def innovate_unscented(model: int, x: Any, width: int, m: int, rig: Any, points: Any, work: Any) -> bool:
    """zhat, S (without R) and A = P_zx from the rows of P in ``work``; False if P is indefinite."""
    L = 3 + 3 * m
    spread, w0m, w0c, w = _weights(L, points)
    if not _root(L, work):
        return False
    _project(model, x, m, spread, rig, work)
    Z, S, Mt, zhat = work.Z[: 2 * L + 1, : 3 * m], work.S[: 3 * m, : 3 * m], work.Mt[:L, : 3 * m], work.zhat
    centre = Z[2 * L]
    for c in range(3 * m):
        zhat[c] = w0m * centre[c]
    for k in range(2 * L):
        for c in range(3 * m):
            zhat[c] += w * Z[k, c]
    for k in range(2 * L + 1):
        for c in range(3 * m):
            Z[k, c] -= zhat[c]
    for a in range(3 * m):
        for b in range(a, 3 * m):
            S[a, b] = w0c * centre[a] * centre[b]
    add_gram(w, Z[: 2 * L], S)
    for j in range(L):
        for c in range(3 * m):
            Mt[j, c] = w * spread * (Z[2 * j, c] - Z[2 * j + 1, c])
        if work.U[j, j] == 0.0:  # row j of Mt and the rest of row j of U are zero, and stay so
            work.U[j, j] = 1.0
    solve_upper(work.U[:L, :L], Mt)
    product_of_transposed(Mt, work.rows[:L, :width], work.A[: 3 * m, :width])
    return True


@inner
def _variable(a: int, at: Any) -> Any:
    """State index of the a-th of the variables involved."""
    return a if a < 3 else at[a // 3 - 1] + a % 3


@inner
def _root(L: int, work: Any) -> Any:
    """Upper root U = C' of the prior over the variables involved; False if it is indefinite."""
    rows, at, U = work.rows, work.at, work.U[:L, :L]
    for b in range(L):
        j = _variable(b, at)
        for a in range(b + 1):
            U[a, b] = rows[a, j]
    return definite_root(U, work.scale) or _singular_root(L, work)


@inner
def _singular_root(L: int, work: Any) -> bool:
    """The same for a semidefinite prior: a zero pivot has a zero row."""
    rows, at, U, block = work.rows, work.at, work.U[:L, :L], work.block[:L, :L]
    for b in range(L):
        j = _variable(b, at)
        for a in range(L):
            block[a, b] = rows[a, j]
    if not semidefinite_cholesky(block, U):
        return False
    for a in range(L):
        for b in range(a):
            U[b, a] = U[a, b]
    return True


@inner
def _project(model: int, x: Any, m: int, spread: Any, rig: Any, work: Any) -> None:
    """Z <- h of the sigma points, in pairs along the rows of U; the last row is h of the mean."""
    L = 3 + 3 * m
    at, U, Z = work.at, work.U, work.Z
    landmark = work.small[0]
    for j in range(L):
        U[j, j - j % 3 : j] = 0.0  # the lower half holds anything, and the three of a point are moved together
    c, s = np.cos(x[2]), np.sin(x[2])
    for i in range(m):
        predict_observation(model, x[0], x[1], c, s, x[at[i] : at[i] + 3], rig, Z[2 * L, 3 * i : 3 * i + 3])
    for k in range(2 * L):
        j, step = k // 2, spread if k % 2 == 0 else -spread
        first = 0 if j < 3 else j // 3 - 1
        Z[k, : 3 * first] = Z[2 * L, : 3 * first]
        px, py, ck, sk = x[0], x[1], c, s
        if j < 3:
            heading = x[2] + step * U[j, 2]
            px, py, ck, sk = x[0] + step * U[j, 0], x[1] + step * U[j, 1], np.cos(heading), np.sin(heading)
        for i in range(first, m):
            for a in range(3):
                landmark[a] = x[at[i] + a] + step * U[j, 3 + 3 * i + a]
            predict_observation(model, px, py, ck, sk, landmark, rig, Z[k, 3 * i : 3 * i + 3])
