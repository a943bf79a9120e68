"""Linearisation rules of the kernels: how a Gaussian goes through f and h, chosen by a code.

A rule is a ``predict`` over the robot and an ``innovate`` over the seen landmarks; the loop in
``trial`` is the same for all. Only the robot moves, and only the robot and the seen landmarks are
observed, so both work on those variables and carry the rest of the state through its covariance.
``sigma_points`` has the unscented rule.
"""

from __future__ import annotations

from typing import Any

from consistency.filters.covariance import gather_rows, move_pose, move_rows
from consistency.filters.jit import inner
from consistency.filters.observation import linearise
from consistency.filters.sigma_points import innovate_unscented, predict_unscented
from consistency.models.motion import unicycle, unicycle_jacobian, unicycle_noise

# EKF, Jacobians at the estimate, Herath et al. (2007) eq. 9-13; Kalman filter of a linear world, F, G
# and H at the known reference, eq. 1-8; UKF, Julier & Uhlmann (2004)
LINEARISED, FIXED, UNSCENTED = 0, 1, 2


@inner
def predict(
    rule: int, x: Any, P: Any, n: int, Phi: Any, b: int, u: Any, pose0: Any, q: Any, points: Any, work: Any
) -> None:
    """x, P, Phi <- one step of motion, in place; ``u`` is (dt, v, omega) and ``q`` (sigma_v, sigma_omega).

    Phi has ``b`` columns, none unless the updating is local.
    """
    heading = pose0[2] if rule == FIXED else x[2]
    if rule == UNSCENTED:
        predict_unscented(x, P, n, Phi, b, u, points, work)
    else:
        fx, fy = unicycle_jacobian(heading, u[0], u[1])
        move_pose(P, n, fx, fy)
        move_rows(Phi, b, fx, fy)
        if rule == FIXED:
            _move_fixed(x, u, pose0, fx, fy)
        else:
            x[0], x[1], x[2] = unicycle(x[0], x[1], x[2], u[0], u[1], u[2])
    _add_motion_noise(P, heading, u[0], q)


@inner
def innovate(
    rule: int,
    model: int,
    x: Any,
    P: Any,
    n: int,
    Phi: Any,
    b: int,
    m: int,
    pose0: Any,
    landmarks0: Any,
    rig: Any,
    points: Any,
    work: Any,
) -> Any:
    """zhat, S (without R) and A = Cov(z, x) of the ``m`` landmarks in ``work.at``; False if P is indefinite.

    Behind the ``n`` columns of A, and treated alike, come the ``b`` that belong to Phi.
    """
    gather_rows(P, n, work.at, m, work.rows)
    if b > 0:
        _gather_phi(Phi, n, b, m, work)
    if rule == UNSCENTED:
        return innovate_unscented(model, x, n + b, m, rig, points, work)
    _innovate_jacobian(model, x, n + b, m, pose0, landmarks0, rig, work)
    return True


@inner
def _gather_phi(Phi: Any, n: int, b: int, m: int, work: Any) -> None:
    work.rows[:3, n : n + b] = Phi[:3, :b]
    for i in range(m):
        o = work.at[i]
        work.rows[3 * i + 3 : 3 * i + 6, n : n + b] = Phi[o : o + 3, :b]


@inner
def _add_motion_noise(P: Any, heading: Any, dt: Any, q: Any) -> None:
    xx, xy, yy, hh = unicycle_noise(heading, dt, q[0], q[1])
    P[0, 0] += xx
    P[0, 1] += xy
    P[1, 0] += xy
    P[1, 1] += yy
    P[2, 2] += hh


@inner
def _move_fixed(x: Any, u: Any, pose0: Any, fx: Any, fy: Any) -> None:
    nx, ny, nh = unicycle(pose0[0], pose0[1], pose0[2], u[0], u[1], u[2])
    dh = x[2] - pose0[2]
    x[0] = nx + (x[0] - pose0[0]) + fx * dh
    x[1] = ny + (x[1] - pose0[1]) + fy * dh
    x[2] = nh + dh


@inner
def _innovate_jacobian(
    model: int, x: Any, width: int, m: int, pose0: Any, landmarks0: Any, rig: Any, work: Any
) -> None:
    """zhat, S and A = H P: a row of H has six numbers."""
    zhat, A, S, Hp, Hl = work.zhat, work.A, work.S, work.Hp, work.Hl
    p0, p1, p2 = work.rows[0], work.rows[1], work.rows[2]
    for i in range(m):
        o = work.at[i]
        at0, expected = landmarks0[work.label[i]], zhat[3 * i : 3 * i + 3]
        linearise(model, x[:3], x[o : o + 3], pose0, at0, rig, expected, Hp[i], Hl[i])
        l0, l1, l2 = work.rows[3 * i + 3], work.rows[3 * i + 4], work.rows[3 * i + 5]
        for a in range(3):
            row = A[3 * i + a]
            g0, g1, g2, h0, h1, h2 = Hp[i, a, 0], Hp[i, a, 1], Hp[i, a, 2], Hl[i, a, 0], Hl[i, a, 1], Hl[i, a, 2]
            for j in range(width):
                row[j] = g0 * p0[j] + g1 * p1[j] + g2 * p2[j] + h0 * l0[j] + h1 * l1[j] + h2 * l2[j]
    for i in range(m):
        o = work.at[i]
        for r in range(3 * i + 3):
            for a in range(3):
                total = 0.0
                for b in range(3):
                    total += A[r, b] * Hp[i, a, b] + A[r, o + b] * Hl[i, a, b]
                S[r, 3 * i + a] = total
