"""Noise of a disparity that depends on the disparity, Herath et al. (2007) eq. 20, sec. 3.4 and fig. 5c."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field, model_validator

from consistency.bench.scenario.effects.node_tables import require_increasing
from consistency.bench.scenario.toml_tables import Positive, Table
from consistency.referee.types import Array

Curve = Annotated[tuple[Positive, ...], Field(min_length=1)]


class DisparityGrowth(Table):
    """The standard deviation of a disparity d is ``sigma[2]`` times ``ratio`` at d.

    Linear between the nodes and constant beyond them. In the world d is the disparity without noise, to a filter it is
    the measured one, because it knows no other.
    """

    disparity: Curve  # (K,), px, increasing
    ratio: Curve  # (K,)

    @model_validator(mode="after")
    def _is_a_curve(self) -> DisparityGrowth:
        if len(self.disparity) != len(self.ratio):
            raise ValueError(
                f"ratio must have a number for each of disparity: got {len(self.ratio)} for {len(self.disparity)}"
            )
        require_increasing("disparity", self.disparity)
        return self

    def ratio_at(self, d: Array) -> Array:
        """Ratio of the standard deviation at disparities ``d`` (...), px, to ``sigma[2]``; of the shape of ``d``."""
        return np.asarray(np.interp(d, self.disparity, self.ratio))
