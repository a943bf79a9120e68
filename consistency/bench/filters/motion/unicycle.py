"""Differential drive, Herath, Kodagoda & Dissanayake (2007) eq. 18: pose (x, y, heading), noise on v and omega."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from consistency.bench.filters.compiler.dispatch import implement, part
from consistency.bench.filters.compiler.jit import inner
from consistency.bench.filters.kernel.part_functions import (
    Frame,
    add_motion_noise,
    move,
    move_about,
    noise_columns,
    propagate_covariance,
    propagate_covariance_by,
    propagate_covariance_root,
    robot_frame,
    robot_width,
)
from consistency.bench.models.motion import unicycle, unicycle_jacobian, unicycle_noise
from consistency.referee.types import Array


@part()
class Unicycle(NamedTuple):
    """Standard deviations of v (m/s) and omega (rad/s), as the filter believes them."""

    sigma_v: float
    sigma_omega: float


@implement(robot_width, Unicycle)
def unicycle_width(motion: Unicycle) -> int:
    """3: x, y in m, heading in rad."""
    return 3


@implement(move, Unicycle)
def move_unicycle(motion: Unicycle, pose: Array, u: Array, out: Array) -> None:
    """out (3,) <- eq. 18 without noise, Euler, at the heading before the step."""
    dt, v, omega = u[0], u[1], u[2]
    out[0], out[1], out[2] = unicycle(pose[0], pose[1], pose[2], dt, v, omega)


@implement(move_about, Unicycle)
def move_unicycle_about(motion: Unicycle, at: Array, u: Array, pose: Array) -> None:
    """pose (3,) <- eq. 18 to first order about ``at`` (3,)."""
    dt, v, omega = u[0], u[1], u[2]
    fx, fy = unicycle_jacobian(at[2], dt, v)
    x, y, heading = unicycle(at[0], at[1], at[2], dt, v, omega)
    turn = pose[2] - at[2]
    pose[0] = x + (pose[0] - at[0]) + fx * turn
    pose[1] = y + (pose[1] - at[1]) + fy * turn
    pose[2] = heading + turn


@implement(propagate_covariance, Unicycle)
def propagate_covariance_unicycle(
    motion: Unicycle, at: Array, u: Array, P: Array, n: int, Phi: Array, base: int
) -> None:
    """P (n, n) <- F P F' and Phi (n, base) <- F Phi, where F (3, 3) is the identity but for its last column."""
    fx, fy = unicycle_jacobian(at[2], u[0], u[1])
    _propagate_covariance(P, n, Phi, base, fx, fy)


@implement(propagate_covariance_by, Unicycle)
def propagate_covariance_unicycle_by(
    motion: Unicycle, dx: float, dy: float, P: Array, n: int, Phi: Array, base: int
) -> None:
    """F[0, 2] = -dy and F[1, 2] = dx: how the position turns with the heading."""
    _propagate_covariance(P, n, Phi, base, -dy, dx)


@inner
def _propagate_covariance(P: Array, n: int, Phi: Array, base: int, fx: float, fy: float) -> None:
    """P <- F P F' and Phi <- F Phi, F the identity but for F[0, 2] = fx and F[1, 2] = fy."""
    _move_rows(P, n, fx, fy)
    for i in range(3):
        P[i, 0] += fx * P[i, 2]
        P[i, 1] += fy * P[i, 2]
    _move_rows(Phi, base, fx, fy)


@inner
def _move_rows(P: Array, n: int, fx: float, fy: float) -> None:
    """Rows 0 and 1 of P (3, n) <- F P, where F (3, 3) is the identity but for F[0, 2] = fx and F[1, 2] = fy."""
    p0, p1, p2 = P[0], P[1], P[2]
    for j in range(n):
        p0[j] += fx * p2[j]
        p1[j] += fy * p2[j]


@implement(add_motion_noise, Unicycle)
def add_unicycle_noise(motion: Unicycle, at: Array, u: Array, P: Array) -> None:
    """P[:3, :3] += G diag(sigma_v^2, sigma_omega^2) G' with G (3, 2)."""
    dt = u[0]
    xx, xy, yy, hh = unicycle_noise(at[2], dt, motion.sigma_v, motion.sigma_omega)
    P[0, 0] += xx
    P[0, 1] += xy
    P[1, 0] += xy
    P[1, 1] += yy
    P[2, 2] += hh


@implement(noise_columns, Unicycle)
def unicycle_noise_columns(motion: Unicycle, at: Array, u: Array, G: Array) -> int:
    """G[:, :2] <- dt sigma_v along the heading ``at`` and dt sigma_omega in heading; returns 2."""
    dt, heading = u[0], at[2]
    along, turn = dt * motion.sigma_v, dt * motion.sigma_omega
    G[0, 0], G[1, 0], G[2, 0] = along * np.cos(heading), along * np.sin(heading), 0.0
    G[0, 1], G[1, 1], G[2, 1] = 0.0, 0.0, turn
    return 2


@implement(robot_frame, Unicycle)
def unicycle_frame(motion: Unicycle, pose: Array) -> Frame:
    """Position and heading of a pose (3,)."""
    return Frame(pose[0], pose[1], np.cos(pose[2]), np.sin(pose[2]))


@implement(propagate_covariance_root, Unicycle)
def propagate_covariance_unicycle_root(motion: Unicycle, P: Array, first: int, last: int, C: Array, F: Array) -> None:
    """P (3, n) <- F C^-1 P in columns first..last-1, by forward substitution."""
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
