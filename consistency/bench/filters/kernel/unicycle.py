"""Differential drive, Herath, Kodagoda & Dissanayake (2007) eq. 18: pose (x, y, heading), noise on v and omega.

A control ``u`` (3,) is dt, s; v, m/s; omega, rad/s.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from consistency.bench.filters.compiler.dispatch import part
from consistency.bench.filters.compiler.jit import inner
from consistency.bench.models.motion import unicycle, unicycle_jacobian, unicycle_noise
from consistency.referee.types import Array


@part()
class Unicycle(NamedTuple):
    """Standard deviations of v (m/s) and omega (rad/s), as the filter believes them."""

    sigma_v: float
    sigma_omega: float


class Frame(NamedTuple):
    """A planar robot: its position in m, cosine and sine of its heading."""

    x: float
    y: float
    c: float
    s: float


@inner
def robot_frame(pose: Array) -> Frame:
    """Position and axes of the robot at ``pose`` (3,), which is all that landmarks need to know of it."""
    return Frame(pose[0], pose[1], np.cos(pose[2]), np.sin(pose[2]))


@inner
def move(pose: Array, u: Array, out: Array) -> None:
    """``out`` (3,) <- f of ``pose`` (3,) without noise: Euler, at the heading before the step."""
    dt, v, omega = u[0], u[1], u[2]
    out[0], out[1], out[2] = unicycle(pose[0], pose[1], pose[2], dt, v, omega)


@inner
def move_about(at: Array, u: Array, pose: Array) -> None:
    """``pose`` (3,) <- f(at) + F (pose - at): f to first order about ``at`` (3,)."""
    dt, v, omega = u[0], u[1], u[2]
    fx, fy = unicycle_jacobian(at[2], dt, v)
    x, y, heading = unicycle(at[0], at[1], at[2], dt, v, omega)
    turn = pose[2] - at[2]
    pose[0] = x + (pose[0] - at[0]) + fx * turn
    pose[1] = y + (pose[1] - at[1]) + fy * turn
    pose[2] = heading + turn


@inner
def propagate_covariance(at: Array, u: Array, P: Array, n: int, Phi: Array, base: int) -> None:
    """P (n, n) <- F P F' and Phi (n, base) <- F Phi, with F (3, 3) the Jacobian of f at ``at`` (3,).

    Of both, the rows of the robot are changed; in P the block of the robot becomes valid as a whole.
    """
    fx, fy = unicycle_jacobian(at[2], u[0], u[1])
    propagate_covariance_by(fy, -fx, P, n, Phi, base)


@inner
def propagate_covariance_by(dx: float, dy: float, P: Array, n: int, Phi: Array, base: int) -> None:
    """:func:`propagate_covariance` with F of a displacement of the robot by (dx, dy) in the world, m.

    F is the identity but for F[0, 2] = -dy and F[1, 2] = dx: how the position turns with the heading.
    """
    _move_rows(P, n, -dy, dx)
    for i in range(3):
        P[i, 0] += -dy * P[i, 2]
        P[i, 1] += dx * P[i, 2]
    _move_rows(Phi, base, -dy, dx)


@inner
def _move_rows(P: Array, n: int, fx: float, fy: float) -> None:
    """Rows 0 and 1 of P (3, n) <- F P."""
    p0, p1, p2 = P[0], P[1], P[2]
    for j in range(n):
        p0[j] += fx * p2[j]
        p1[j] += fy * p2[j]


@inner
def add_motion_noise(motion: Unicycle, at: Array, u: Array, P: Array) -> None:
    """P[:3, :3] += G diag(sigma_v^2, sigma_omega^2) G', with G (3, 2) the Jacobian of f by the noise at ``at`` (3,)."""
    xx, xy, yy, hh = unicycle_noise(at[2], u[0], motion.sigma_v, motion.sigma_omega)
    P[0, 0] += xx
    P[0, 1] += xy
    P[1, 0] += xy
    P[1, 1] += yy
    P[2, 2] += hh


@inner
def noise_columns(motion: Unicycle, at: Array, u: Array, G: Array) -> None:
    """``G[:, :2]`` <- G Q^(1/2) at ``at`` (3,): dt sigma_v along the heading and dt sigma_omega in heading."""
    along, turn = u[0] * motion.sigma_v, u[0] * motion.sigma_omega
    G[0, 0], G[1, 0], G[2, 0] = along * np.cos(at[2]), along * np.sin(at[2]), 0.0
    G[0, 1], G[1, 1], G[2, 1] = 0.0, 0.0, turn


@inner
def propagate_covariance_root(P: Array, first: int, last: int, C: Array, F: Array) -> None:
    """Columns first..last-1 of the robot's rows: P (3, n) <- F C^-1 P for a lower root C (3, 3) and F (3, 3).

    By forward substitution. A direction whose pivot in C is zero carries nothing.
    """
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
def _reciprocal(pivot: float) -> float:
    return 0.0 if pivot == 0.0 else 1.0 / pivot
