"""The kinds of guards, and what a guard of a kind takes for spurious."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import numpy as np
from scipy import special

from consistency.referee.types import Array

if TYPE_CHECKING:
    from consistency.bench.scenario import GuardSettings

KINDS = {
    "gate": "chi-square gate of each observation by its own innovation",
    "joint": "largest set of observations that is jointly compatible",
    "ransac": "one-point RANSAC: the observations that agree with the best hypothesis from one of them",
}


@dataclass(frozen=True)
class Limits:
    """Squared Mahalanobis distances up to which observations of s values are accepted."""

    joint: Array  # (m + 1,), of 0, 1, ... m observations together
    support: float  # of what a hypothesis leaves of an observation

    @property
    def own(self) -> float:
        """Of an observation alone."""
        return float(self.joint[1])


def limits_of(settings: GuardSettings, s: int, m: int) -> Limits:
    """Limits of up to ``m`` observations of ``s`` values in a step."""
    return Limits(np.array(_quantiles(settings.confidence, s, max(m, 1))), settings.threshold**2)


@cache
def _quantiles(confidence: float, s: int, m: int) -> tuple[float, ...]:
    """Of chi-square with 0, s, ... s m degrees of freedom; asked in every trial, or in every step by a plain filter."""
    return 0.0, *map(float, 2.0 * special.gammaincinv(0.5 * s * np.arange(1, m + 1), confidence))
