"""Loss functions of a point's squared standardised residual s, Huber (1964) and Cauchy (Lorentzian).

rho(s) replaces s in the cost; rho'(s) is the weight a point keeps, rho''(s) what an exact second derivative needs.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from scipy import stats

from consistency.referee.errors import InputError
from consistency.referee.types import Array

Robust = Literal["huber", "cauchy"]
TAIL = 0.05  # share of points without fault that Huber's loss treats as outliers


def threshold(dof: int) -> float:
    """Standardised residual c, of ``dof`` dimensions, that a point without fault exceeds with probability 0.05."""
    return float(np.sqrt(stats.chi2.isf(TAIL, dof)))


def loss(robust: Robust | None, s: Array, c: float) -> tuple[Array, Array, Array]:
    """rho, rho' and rho'' at s (N,), all (N,); None is least squares.

    Raises
    ------
    InputError
        No such loss.
    """
    if robust is None:
        return s, np.ones_like(s), np.zeros_like(s)
    if robust == "huber":
        far = np.maximum(s, c**2)
        root = c / np.sqrt(far)
        return np.minimum(s, c**2) + 2.0 * c * (np.sqrt(far) - c), root, np.where(s > c**2, -0.5 * root / far, 0.0)
    if robust == "cauchy":
        weight = 1.0 / (1.0 + s / c**2)
        return c**2 * np.log1p(s / c**2), weight, -(weight**2) / c**2
    raise InputError(f"robust: {robust!r}, allowed are 'huber', 'cauchy' and None")
