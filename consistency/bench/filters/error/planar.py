"""What errors in SE(2) share."""

from __future__ import annotations

import numpy as np

from consistency.bench.filters.compiler.jit import inner
from consistency.referee.types import Array

ROUNDED = 1e-14  # of what cancels in a variance: less is rounding


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
