"""Innovations over the largest ones that a gate lets pass, as some filters log them in place of their variances.

They are no NIS: how large the stated variance is cannot be told from them, and neither can a fault. What can be told is
how often a filter whose variances are right exceeds a ratio at most.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import special

from consistency.referee.types import Array

RARE = 0.05  # share of the innovations of a right filter that is called unusual


@dataclass(frozen=True)
class GateRatios:
    """Ratios of one sensor over time."""

    sensor: str
    t: Array  # (N,), s, not decreasing
    ratio: Array  # (N,), |innovation| / (gate sigma); rejected above 1
    gate: float  # sigma; NaN where it is not known
    components: int  # at most, of which the ratio is the largest or the root of a mean

    @property
    def unusual(self) -> float:
        """The ratio that a right filter exceeds in at most ``RARE`` of its innovations; NaN without the gate.

        By Bonferroni's bound over the components, sqrt(2) erfcinv(RARE / components) sigma. It also holds for the root
        of sum e^2 / sum S: of all weights, all on one component gives the heaviest tail (Szekely & Bakirov 2003,
        "Extremal probabilities for Gaussian quadratic forms").
        """
        return float(np.sqrt(2.0) * special.erfcinv(RARE / self.components) / self.gate)

    @property
    def rejected(self) -> float:
        """The share above 1 that a right filter has at most; NaN without the gate."""
        return float(np.minimum(1.0, self.components * special.erfc(self.gate / np.sqrt(2.0))))

    def above(self, limit: float) -> float:
        """Share of the ratios above a limit; NaN where the limit is."""
        return float("nan") if np.isnan(limit) else float(np.mean(self.ratio > limit))

    def over_time(self, limit: float, pieces: int = 10) -> tuple[Array, Array]:
        """Beginnings, s, of equal pieces of time, and the share above a limit in each, NaN where it is empty."""
        edges = np.linspace(self.t[0], self.t[-1], pieces + 1)
        piece = np.clip(np.searchsorted(edges, self.t, side="right") - 1, 0, pieces - 1)
        count = np.bincount(piece, minlength=pieces)
        over = np.bincount(piece, self.ratio > limit, minlength=pieces)
        share = np.where((count > 0) & ~np.isnan(limit), over / np.maximum(count, 1), np.nan)
        return edges[:-1], share
