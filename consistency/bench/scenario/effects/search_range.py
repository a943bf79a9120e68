"""The disparities that a stereo sensor searches."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from consistency.bench.scenario.effects.observations import Context, Observations


@dataclass(frozen=True)
class SearchRange:
    """Keeps a row if its measured disparity is in the search range. The last effect of a ``uvd`` sensor."""

    label: ClassVar[str] = "search-range"
    draws: ClassVar[bool] = False

    low: float  # px
    high: float  # px

    def apply(self, observations: Observations, rng: np.random.Generator, context: Context) -> Observations:
        d = observations.z[:, 2]
        return observations.keep((d >= self.low) & (d <= self.high))
