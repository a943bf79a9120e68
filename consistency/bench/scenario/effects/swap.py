"""False associations, Herath et al. (2007) sec. 4.2: the more features, the more alike they are."""

from __future__ import annotations

from typing import Literal

import numpy as np

from consistency.bench.scenario.effects.effect import ListedEffect, register
from consistency.bench.scenario.effects.observations import Context, Observations
from consistency.bench.scenario.toml_tables import Rate


@register
class Swap(ListedEffect):
    """With probability ``rate`` an observation carries what was measured of another id in the same step.

    In the trial the row is then of that other landmark (source). The other row stays as it is, and a step with a single
    observation has none to be taken for it.
    """

    kind: Literal["swap"] = "swap"
    rate: Rate

    def apply(self, observations: Observations, rng: np.random.Generator, context: Context) -> Observations:
        chance, pick = rng.random((2, len(observations)))
        first = np.searchsorted(observations.step, observations.step, side="left")
        seen = np.searchsorted(observations.step, observations.step, side="right") - first
        row = np.flatnonzero((chance < self.rate) & (seen > 1))
        other = first[row] + (pick[row] * (seen[row] - 1)).astype(np.int64)
        other += other >= row  # any row of the step but its own
        z, source = observations.z.copy(), observations.sources.copy()
        z[row], source[row] = observations.z[other], observations.sources[other]
        return observations.with_z(z, source)
