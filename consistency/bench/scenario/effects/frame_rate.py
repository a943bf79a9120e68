"""Images at a rate that varies: a camera that is slower than the odometry, or whose images are lost."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field

from consistency.bench.scenario.effects.effect import ListedEffect, register
from consistency.bench.scenario.effects.observations import Context, Observations
from consistency.bench.scenario.toml_tables import Count


@register
class Frames(ListedEffect):
    """Images come after ``every`` steps, whose numbers are taken in turn; in the steps between nothing is seen."""

    draws: ClassVar[bool] = False
    before_noise: ClassVar[bool] = True
    errs: ClassVar[bool] = False

    kind: Literal["frames"] = "frames"
    every: Annotated[list[Count], Field(min_length=1)]

    def apply(self, observations: Observations, rng: np.random.Generator, context: Context) -> Observations:
        images = np.cumsum(np.resize(self.every, context.steps))
        return observations.keep(np.isin(observations.step, images))
