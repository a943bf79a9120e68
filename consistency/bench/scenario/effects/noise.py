"""The noise of a sensor: Gaussian and independent, of one standard deviation for each value."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from consistency.bench.scenario.effects.disparity_growth import DisparityGrowth
from consistency.bench.scenario.effects.observations import Context, Observations


@dataclass(frozen=True)
class Noise:
    """Adds ``sigma`` times a standard normal number to each value; that of a disparity may grow with it."""

    label: ClassVar[str] = "noise"
    draws: ClassVar[bool] = True

    sigma: tuple[float, ...]  # px for uvd, m and rad for range-bearing, m otherwise
    growth: DisparityGrowth | None = None

    def apply(self, observations: Observations, rng: np.random.Generator, context: Context) -> Observations:
        z = rng.standard_normal((len(observations), len(self.sigma)))
        z *= self.sigma
        if self.growth is not None:
            z[:, 2] *= self.growth.ratio_at(observations.z[:, 2])
        z += observations.z
        return observations.with_z(z)
