"""Gross errors of single observations: heavy tails, mismatches and false associations."""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np
from pydantic import model_validator

from consistency.bench.scenario.effects.effect import ListedEffect, UvdEffect, register_effect
from consistency.bench.scenario.effects.observations import NO_LANDMARK, Context, Observations
from consistency.bench.scenario.tables.toml_tables import NonNegative, Positive, Rate


@register_effect
class Mismatch(UvdEffect):
    """With probability ``rate`` an observation has a disparity that says nothing of its landmark.

    Mismatches of the stereo correspondence, Herath et al. (2007) sec. 4.3 and fig. 9c.
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


@register_effect
class HeavyTails(UvdEffect):
    """A contaminated normal (Tukey 1960): some observations have a second Gaussian error beside their noise.

    The "various artefacts in the tails" of Herath et al. (2007) sec. 3.5 and fig. 6.
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


@register_effect
class Swap(ListedEffect):
    """With probability ``rate`` an observation carries what was measured of another id in the same step.

    False associations, Herath et al. (2007) sec. 4.2: the more features, the more alike they are.
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
