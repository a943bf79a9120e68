"""Growth of the standard deviation of disparity with disparity, Herath et al. (2007) fig. 5c."""

from __future__ import annotations

from itertools import pairwise
from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field, model_validator

from consistency.scenario.tables import Positive, Table
from consistency.types import Array


class DisparityGrowth(Table):
    """The standard deviation of disparity is ``sigma[2] * ratio(d)``."""

    units: ClassVar[dict[str, str]] = {"disparity": "_px"}

    disparity: Annotated[tuple[Positive, ...], Field(min_length=1)]  # px, increasing
    ratio: Annotated[tuple[Positive, ...], Field(min_length=1)]

    @model_validator(mode="after")
    def _a_ratio_a_node(self) -> DisparityGrowth:
        if len(self.disparity) != len(self.ratio):
            raise ValueError(f"{len(self.disparity)} numbers in disparity_px but {len(self.ratio)} in ratio")
        if any(a >= b for a, b in pairwise(self.disparity)):
            raise ValueError("disparity_px must increase")
        return self

    def ratio_at(self, d: Array) -> Array:
        """Ratio at disparities ``d`` (...), px: linear between the nodes and constant beyond them."""
        return np.asarray(np.interp(d, self.disparity, self.ratio))
