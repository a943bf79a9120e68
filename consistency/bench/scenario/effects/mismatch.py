"""Mismatches of the stereo correspondence, Herath et al. (2007) sec. 4.3 and fig. 9c."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import model_validator

from consistency.bench.scenario.effects.effect import UvdEffect, register
from consistency.bench.scenario.effects.observations import NO_LANDMARK, Context, Observations
from consistency.bench.scenario.toml_tables import Positive, Rate


@register
class Mismatch(UvdEffect):
    """With probability ``rate`` an observation has a disparity that says nothing of its landmark.

    It is uniform over ``disparity``, or over the search range where that is left out; u and v stay. In the trial such
    a row is of no landmark (source -1).
    """

    kind: Literal["mismatch"] = "mismatch"
    rate: Rate
    disparity: tuple[Positive, Positive] | None = None  # px

    @model_validator(mode="after")
    def _is_a_range(self) -> Mismatch:
        if self.disparity is not None and self.disparity[0] >= self.disparity[1]:
            raise ValueError("disparity must be [low, high] with low < high")
        return self

    def apply(self, observations: Observations, rng: np.random.Generator, context: Context) -> Observations:
        hit = np.flatnonzero(rng.random(len(observations)) < self.rate)
        searched = self.disparity or context.sensor.search_range
        assert searched is not None
        low, high = searched
        z, source = observations.z.copy(), observations.sources.copy()
        z[hit, 2], source[hit] = rng.uniform(low, high, len(hit)), NO_LANDMARK
        return observations.with_z(z, source)
