"""Errors of a feature tracker that stay with a track, Herath et al. (2007) sec. 3.5 and 4.4."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field

from consistency.bench.scenario.effects.effect import UvdEffect, register
from consistency.bench.scenario.effects.observations import Context, Observations
from consistency.bench.scenario.toml_tables import NonNegative


@register
class TrackError(UvdEffect):
    """A first-order Gauss-Markov error along each track, stationary from its first step on.

    e_k = c e_k-1 + sqrt(1 - c^2) w_k with w ~ N(0, sigma^2) and c the ``correlation`` from step to step. After a gap
    in a track it starts anew.
    """

    units: ClassVar[dict[str, str]] = {"sigma": "_px"}

    kind: Literal["track-error"] = "track-error"
    sigma: tuple[NonNegative, NonNegative, NonNegative]
    correlation: Annotated[float, Field(ge=0, lt=1, allow_inf_nan=False, strict=True)]

    def apply(self, observations: Observations, rng: np.random.Generator, context: Context) -> Observations:
        if not len(observations):
            return observations
        track, age = observations.tracks()
        error = rng.standard_normal((age.max() + 1, track.max() + 1, 3))
        fresh = np.sqrt(1.0 - self.correlation**2)
        for k in range(1, len(error)):
            error[k] = self.correlation * error[k - 1] + fresh * error[k]
        return observations.with_z(observations.z + error[age, track] * self.sigma)
