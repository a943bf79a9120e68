"""Right-invariant error of poses, T_true = Exp(xi) T, beside landmarks that are in no world frame."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from consistency.bench.filters.compiler.dispatch import implement, part
from consistency.bench.filters.compiler.jit import inner
from consistency.bench.filters.kernel.part_functions import pose_covariance, to_error
from consistency.referee.types import Array

ROUNDED = 1e-14  # of what cancels in a variance: less is rounding
FLAT = 1e-9  # determinant of a covariance of positions over its squared trace, up to which they are on a line


@inner
def exponential(angle: float) -> tuple[float, float, float, float]:
    """Cosine, sine, sin(a) / a and (1 - cos(a)) / a."""
    c, s = np.cos(angle), np.sin(angle)
    if abs(angle) < 1e-4:
        return c, s, 1.0 - angle * angle / 6.0, 0.5 * angle * (1.0 - angle * angle / 12.0)
    return c, s, s / angle, (1.0 - c) / angle


@inner
def shifted_covariance(x: Array, P: Array, out: Array) -> None:
    """``out`` (3, 3) <- covariance of the additive error of a pose from that of the right-invariant one, P."""
    t = (-x[1], x[0])  # what a turn moves
    for a in range(2):
        out[a, 2] = out[2, a] = P[a, 2] + t[a] * P[2, 2]
        for b in range(2):
            out[a, b] = P[a, b] + P[a, 2] * t[b] + t[a] * P[2, b] + t[a] * P[2, 2] * t[b]
    out[2, 2] = P[2, 2]
    for a in range(2):
        if out[a, a] < ROUNDED * (P[a, a] + t[a] * t[a] * P[2, 2]):  # a variance of zero, but for rounding
            for b in range(3):
                out[a, b] = out[b, a] = 0.0


@part(landmark="InverseRange")
class InvariantPose(NamedTuple):
    """``moments``: the covariance of the additive error is stated as it is, not as that of a linear one."""

    moments: bool


@implement(to_error, InvariantPose)
def to_invariant_pose(error: InvariantPose, pose: Array, values: Array, Hp: Array, Hl: Array) -> None:
    for a in range(len(Hp)):
        Hp[a, 2] += pose[0] * Hp[a, 1] - pose[1] * Hp[a, 0]


@implement(pose_covariance, InvariantPose)
def invariant_pose_covariance(error: InvariantPose, x: Array, P: Array, out: Array) -> None:
    shifted_covariance(x, P, out)
    if error.moments:
        bend(out)


@inner
def bend(C: Array) -> None:
    """``C`` (3, 3) <- second moments of Exp(xi) T about T, from the covariance of its additive error to first order.

    The equations are those of :func:`consistency.bench.filters.textbook.inverse_range.pose_moments`.
    """
    s = C[2, 2]
    if s <= 0.0:
        return
    kx, ky = C[0, 2] / s, C[1, 2] / s
    a, b, d = C[0, 0] - s * kx * kx, C[0, 1] - s * kx * ky, C[1, 1] - s * ky * ky
    if a * d - b * b <= FLAT * (a + d) ** 2:
        return
    sine, cosine = -0.5 * np.expm1(-2.0 * s), 0.5 * np.expm1(-s) ** 2 + np.expm1(-0.5 * s) ** 2
    straight, bent, kept = np.exp(-s / 3.0), 0.25 * s * np.exp(-0.5 * s), np.exp(-0.5 * s)
    C[0, 0] = sine * kx * kx + cosine * ky * ky + straight * a + bent * d
    C[1, 1] = sine * ky * ky + cosine * kx * kx + straight * d + bent * a
    C[0, 1] = C[1, 0] = (sine - cosine) * kx * ky + (straight - bent) * b
    C[0, 2] = C[2, 0] = kept * s * kx
    C[1, 2] = C[2, 1] = kept * s * ky


@inner
def move_pose(pose: Array, xi: Array, out: Array) -> None:
    """``out`` (3,) <- Exp(xi) T."""
    c, s, along, across = exponential(xi[2])
    x, y = pose[0], pose[1]
    out[0] = c * x - s * y + along * xi[0] - across * xi[1]
    out[1] = s * x + c * y + across * xi[0] + along * xi[1]
    out[2] = pose[2] + xi[2]


@inner
def left_jacobian(xi: Array, J: Array) -> None:
    """``J`` (3, 3) <- J_l of SE(2) to second order."""
    x, y, t = xi[0], xi[1], xi[2]
    J[0, 0] = J[1, 1] = 1.0 - t * t / 6.0
    J[0, 1], J[1, 0] = -0.5 * t, 0.5 * t
    J[0, 2], J[1, 2] = 0.5 * y + t * x / 6.0, -0.5 * x + t * y / 6.0
    J[2, 0] = J[2, 1] = 0.0
    J[2, 2] = 1.0
