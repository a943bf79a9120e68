"""A constant error of a sensor."""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np

from consistency.bench.scenario.observations import Context, ListedEffect, Observations, register_effect
from consistency.bench.scenario.toml_tables import Triple


@register_effect
class Bias(ListedEffect):
    """Adds ``bias`` (u, v, d) in px to each observation."""

    models: ClassVar[tuple[str, ...]] = ("uvd",)
    units: ClassVar[dict[str, str]] = {"bias": "_px"}
    draws: ClassVar[bool] = False

    kind: Literal["bias"] = "bias"
    bias: Triple

    def apply(self, observations: Observations, rng: np.random.Generator, context: Context) -> Observations:
        """All observations, shifted."""
        return observations.with_z(observations.z + np.array(self.bias))
