"""How the noise of a disparity grows with the disparity, for parts that take it where they predict."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from consistency.bench.filters.compiler.jit import inner
from consistency.bench.scenario import BelievedSensor
from consistency.referee.types import Array


class Growth(NamedTuple):
    """Ratio of a standard deviation to its sigma, linear between nodes and constant beyond them."""

    disparity: Array  # (K,), px, increasing
    ratio: Array  # (K,)


def growth_of(sensor: BelievedSensor) -> Growth:
    """The growth that a belief holds; 1 everywhere if it holds none."""
    growth = sensor.disparity_growth
    if growth is None:
        return Growth(np.ones(1), np.ones(1))
    return Growth(np.array(growth.disparity), np.array(growth.ratio))


@inner
def ratio_at(growth: Growth, d: float) -> float:
    """The ratio at a disparity d in px."""
    nodes, ratio = growth.disparity, growth.ratio
    value: float = ratio[len(nodes) - 1]
    for i in range(len(nodes) - 1, 0, -1):
        if d < nodes[i]:
            value = ratio[i - 1] + (ratio[i] - ratio[i - 1]) / (nodes[i] - nodes[i - 1]) * (d - nodes[i - 1])
    if d <= nodes[0]:
        value = ratio[0]
    return value
