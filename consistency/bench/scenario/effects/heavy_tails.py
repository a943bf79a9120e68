"""Heavy tails: the "various artefacts in the tails" of Herath et al. (2007) sec. 3.5 and fig. 6."""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np

from consistency.bench.scenario.effects.effect import UvdEffect, register
from consistency.bench.scenario.effects.observations import Context, Observations
from consistency.bench.scenario.toml_tables import NonNegative, Rate


@register
class HeavyTails(UvdEffect):
    """A contaminated normal (Tukey 1960): some observations have a second Gaussian error beside their noise.

    With probability ``rate`` an observation gets an error of ``sigma`` (u, v, d). It is still of its landmark.
    """

    units: ClassVar[dict[str, str]] = {"sigma": "_px"}

    kind: Literal["heavy-tails"] = "heavy-tails"
    rate: Rate
    sigma: tuple[NonNegative, NonNegative, NonNegative]

    def apply(self, observations: Observations, rng: np.random.Generator, context: Context) -> Observations:
        hit = np.flatnonzero(rng.random(len(observations)) < self.rate)
        z = observations.z.copy()
        z[hit] += rng.standard_normal((len(hit), 3)) * self.sigma
        return observations.with_z(z)
