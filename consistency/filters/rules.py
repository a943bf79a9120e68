"""Linearisation rules of the kernels: how a Gaussian goes through f and h, chosen by a code.

A rule is a ``predict`` over the robot and an ``innovate`` over the seen landmarks; the loop in
``trial`` is the same for all. Only the robot moves, and only the robot and the seen landmarks are
observed, so both work on those variables and carry the rest of the state through its covariance.

The unscented rule is exact at the size of the problem. With the variables ordered robot, seen landmarks
(as observed), the rest, the Cholesky factor is [[C, 0], [G, D]]. The sigma points through D move only
variables that f and h do not read: they all project onto the mean. Counting them there leaves 2 L + 1
points over the L = 3 + 3 m variables involved, and the rest of the state follows through
G = P_rest,involved C^-T.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from consistency.filters.jit import inner
from consistency.filters.linalg import forward_substitute, semidefinite_cholesky
from consistency.filters.observation import linearise, predict_observation
from consistency.models.motion import unicycle, unicycle_jacobian, unicycle_noise

# EKF, Jacobians at the estimate, Herath et al. (2007) eq. 9-13; Kalman filter of a linear world, F, G
# and H at the known reference, eq. 1-8; UKF, Julier & Uhlmann (2004)
LINEARISED, FIXED, UNSCENTED = 0, 1, 2


@inner
def predict(rule: int, x: Any, P: Any, n: int, u: Any, pose0: Any, q: Any, points: Any) -> None:
    """x, P <- one step of motion, in place; ``u`` is (dt, v, omega) and ``q`` (sigma_v, sigma_omega)."""
    if rule == UNSCENTED:
        _predict_unscented(x, P, n, u, q, points)
    elif rule == FIXED:
        _predict_fixed(x, P, n, u, pose0, q)
    else:
        _predict_linearised(x, P, n, u, q)


@inner
def innovate(
    rule: int, model: int, x: Any, P: Any, n: int, at: Any, pose0: Any, landmarks0: Any, rig: Any, points: Any,
    zhat: Any, S: Any, A: Any,
) -> Any:  # fmt: skip
    """zhat, S (without R) and A = Cov(z, x) of the landmarks at state offsets ``at``; False if P is indefinite."""
    if rule == UNSCENTED:
        return _innovate_unscented(model, x, P, n, at, rig, points, zhat, S, A)
    _innovate_jacobian(model, x, P, n, at, pose0, landmarks0, rig, zhat, S, A)
    return True


@inner
def _add_motion_noise(P: Any, heading: Any, dt: Any, q: Any) -> None:
    xx, xy, yy, hh = unicycle_noise(heading, dt, q[0], q[1])
    P[0, 0] += xx
    P[0, 1] += xy
    P[1, 0] += xy
    P[1, 1] += yy
    P[2, 2] += hh


@inner
def _move_covariance(P: Any, n: int, fx: Any, fy: Any) -> None:
    """P <- F P F' where F is the identity but for F[0, 2] = fx and F[1, 2] = fy."""
    for j in range(n):
        P[0, j] += fx * P[2, j]
        P[1, j] += fy * P[2, j]
    for i in range(n):
        P[i, 0] += fx * P[i, 2]
        P[i, 1] += fy * P[i, 2]


@inner
def _predict_linearised(x: Any, P: Any, n: int, u: Any, q: Any) -> None:
    heading = x[2]
    fx, fy = unicycle_jacobian(heading, u[0], u[1])
    x[0], x[1], x[2] = unicycle(x[0], x[1], heading, u[0], u[1], u[2])
    _move_covariance(P, n, fx, fy)
    _add_motion_noise(P, heading, u[0], q)


@inner
def _predict_fixed(x: Any, P: Any, n: int, u: Any, pose0: Any, q: Any) -> None:
    fx, fy = unicycle_jacobian(pose0[2], u[0], u[1])
    nx, ny, nh = unicycle(pose0[0], pose0[1], pose0[2], u[0], u[1], u[2])
    dh = x[2] - pose0[2]
    x[0] = nx + (x[0] - pose0[0]) + fx * dh
    x[1] = ny + (x[1] - pose0[1]) + fy * dh
    x[2] = nh + dh
    _move_covariance(P, n, fx, fy)
    _add_motion_noise(P, pose0[2], u[0], q)


@inner
def _innovate_jacobian(
    model: int, x: Any, P: Any, n: int, at: Any, pose0: Any, landmarks0: Any, rig: Any, zhat: Any, S: Any, A: Any
) -> None:
    """zhat, S (without R) and A = H P of the landmarks at state offsets ``at``."""
    m = len(at)
    Hp, Hl = np.empty((m, 3, 3)), np.empty((m, 3, 3))
    for i in range(m):
        o = at[i]
        linearise(model, x[:3], x[o : o + 3], pose0, landmarks0[i], rig, zhat[3 * i : 3 * i + 3], Hp[i], Hl[i])
        for a in range(3):
            row = A[3 * i + a]
            for j in range(n):
                row[j] = (
                    Hp[i, a, 0] * P[0, j]
                    + Hp[i, a, 1] * P[1, j]
                    + Hp[i, a, 2] * P[2, j]
                    + Hl[i, a, 0] * P[o, j]
                    + Hl[i, a, 1] * P[o + 1, j]
                    + Hl[i, a, 2] * P[o + 2, j]
                )
    for r in range(3 * m):
        for i in range(m):
            o = at[i]
            for a in range(3):
                total = 0.0
                for b in range(3):
                    total += A[r, b] * Hp[i, a, b] + A[r, o + b] * Hl[i, a, b]
                S[r, 3 * i + a] = total


@inner
def _weights(L: int, points: Any) -> Any:
    """Spread and weights of scaled sigma points over L variables (Merwe 2004): spread, w0m, w0c, w."""
    alpha, beta, kappa = points[0], points[1], points[2]
    spread2 = alpha * alpha * (L + kappa)
    w0 = 1.0 - L / spread2
    return np.sqrt(spread2), w0, w0 + 1.0 - alpha * alpha + beta, 0.5 / spread2


@inner
def _predict_unscented(x: Any, P: Any, n: int, u: Any, q: Any, points: Any) -> None:
    heading = x[2]
    spread, w0m, w0c, w = _weights(3, points)
    C = np.zeros((3, 3))
    if not semidefinite_cholesky(P[:3, :3], C):
        P[0, 0] = np.nan  # an indefinite prior is reported by the loop
        return
    Gt = P[:3, :n].copy()
    forward_substitute(C, Gt)
    Y = np.empty((7, 3))
    Y[6] = unicycle(x[0], x[1], x[2], u[0], u[1], u[2])
    for j in range(3):
        for side in range(2):
            step = spread if side == 0 else -spread
            p0, p1, p2 = x[0] + step * C[0, j], x[1] + step * C[1, j], x[2] + step * C[2, j]
            Y[2 * j + side] = unicycle(p0, p1, p2, u[0], u[1], u[2])
    mean = w0m * Y[6]
    for i in range(6):
        mean += w * Y[i]
    block = np.zeros((3, 3))
    for i in range(7):
        weight = w0c if i == 6 else w
        for a in range(3):
            for b in range(3):
                block[a, b] += weight * (Y[i, a] - mean[a]) * (Y[i, b] - mean[b])
    D = np.empty((3, 3))  # Cov(f, C-coordinates)
    for j in range(3):
        D[:, j] = w * spread * (Y[2 * j] - Y[2 * j + 1])
    cross = np.dot(D, Gt)
    P[:3, 3:n] = cross[:, 3:]
    P[3:n, :3] = cross[:, 3:].T
    P[:3, :3] = block
    x[:3] = mean
    _add_motion_noise(P, heading, u[0], q)


@inner
def _innovate_unscented(
    model: int, x: Any, P: Any, n: int, at: Any, rig: Any, points: Any, zhat: Any, S: Any, A: Any
) -> bool:
    """zhat, S (without R) and A = P_zx of the landmarks at state offsets ``at``."""
    m = len(at)
    L = 3 + 3 * m
    spread, w0m, w0c, w = _weights(L, points)
    seen = np.empty(L, np.int64)
    seen[:3] = np.arange(3)
    for i in range(m):
        seen[3 + 3 * i : 6 + 3 * i] = at[i] + np.arange(3)
    Gt = np.empty((L, n))
    block, mean = np.empty((L, L)), np.empty(L)
    for a in range(L):
        Gt[a] = P[seen[a], :n]
        mean[a] = x[seen[a]]
        for b in range(L):
            block[a, b] = P[seen[a], seen[b]]
    C = np.zeros((L, L))
    if not semidefinite_cholesky(block, C):
        return False
    forward_substitute(C, Gt)
    Z = np.empty((2 * L + 1, 3 * m))
    for k in range(2 * L + 1):
        s = mean.copy()
        if k < 2 * L:
            s += (spread if k % 2 == 0 else -spread) * C[:, k // 2]
        for i in range(m):
            predict_observation(model, s[:3], s[3 + 3 * i : 6 + 3 * i], rig, Z[k, 3 * i : 3 * i + 3])
    zhat[:] = w0m * Z[2 * L]
    for k in range(2 * L):
        zhat += w * Z[k]
    for k in range(2 * L + 1):
        Z[k] -= zhat
    B = np.empty((L, 3 * m))  # Cov(C-coordinates, z)
    for j in range(L):
        B[j] = w * spread * (Z[2 * j] - Z[2 * j + 1])
    S[:] = w * np.dot(Z[: 2 * L].T, Z[: 2 * L])
    for a in range(3 * m):
        for b in range(3 * m):
            S[a, b] += w0c * Z[2 * L, a] * Z[2 * L, b]
    A[:, :n] = np.dot(B.T, Gt)
    return True
