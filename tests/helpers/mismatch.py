"""Stereo mismatches for tests: an effect of a scenario, and the same for a trial of any sensor."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field

from consistency.bench.scenario.observations import ListedEffect

RATE = 0.05


class WrongMatch(ListedEffect):
    """A share of the disparities is drawn anew, uniformly over the search range."""

    models: ClassVar[tuple[str, ...]] = ("uvd",)
    kind: Literal["wrong-match"] = "wrong-match"
    rate: Annotated[float, Field(ge=0, le=1)] = RATE

    def apply(self, observations, rng, context):
        hit = rng.random(len(observations.z)) < self.rate
        z = observations.z.copy()
        z[hit, 2] = rng.uniform(*context.sensor.disparity, hit.sum())
        return observations.with_z(z, np.where(hit, -1, observations.sources))


def corrupted(trial, rng, rate=RATE):
    """A trial of any sensor in which a share of the observations is that of another landmark of the trial."""
    hit, z = rng.random(len(trial.z)) < rate, np.array(trial.z)
    z[hit] = z[rng.integers(len(z), size=hit.sum())]
    return replace(trial, z=z, source=np.where(hit, -1, trial.landmark))
