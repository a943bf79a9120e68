"""Local biases that a rectification leaves, Herath et al. (2007) sec. 4.1 and fig. 8."""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np

from consistency.bench.scenario.effects.bias_map import BiasMap
from consistency.bench.scenario.effects.effect import ListedEffect, register
from consistency.bench.scenario.effects.observations import Context, Observations


@register
class LocalBias(ListedEffect, BiasMap):
    """Adds the bias of a :class:`BiasMap` at the ideal (u, v) to each observation.

    It comes before the noise, so that the bias is that of the true pixel and the same in every run.
    """

    models: ClassVar[tuple[str, ...]] = ("uvd",)
    draws: ClassVar[bool] = False
    before_noise: ClassVar[bool] = True

    kind: Literal["local-bias"] = "local-bias"

    def apply(self, observations: Observations, rng: np.random.Generator, context: Context) -> Observations:
        z = observations.z
        return observations.with_z(z + self.at(z[:, 0], z[:, 1]))

    def map(self) -> BiasMap:
        """The map alone, as a belief holds it."""
        return BiasMap.model_validate(self.model_dump(include=set(BiasMap.model_fields)))
