"""Piecewise linear functions: of disparity for the growth of a noise, of the place in the image for a bias."""

from __future__ import annotations

import numpy as np

from consistency.bench.scenario.effects.node_tables import hats
from consistency.referee.types import Array

APART = 1.25  # factor between neighbouring nodes of disparity at least
FEW = 30  # rows that a node takes
ENDS = 0.005  # of the data lies beyond the first and beyond the last node of disparity


def octaves(d: Array) -> Array:
    """Nodes (m,) of disparity: the ends of the data and the powers of two between them, px.

    Powers of two are left out until each node has ``FEW`` rows around it; a node by itself is the median.
    """
    low, high = np.quantile(d, [ENDS, 1.0 - ENDS])
    if high < APART * low:
        return np.array([float(np.median(d))])
    powers = 2.0 ** np.arange(np.ceil(np.log2(low * APART)), np.floor(np.log2(high / APART)) + 1)
    nodes = np.array([low, *powers, high])
    while len(nodes) > 2 and (rows := hats(d, nodes).sum(axis=0)).min() < FEW:
        nodes = np.delete(nodes, np.clip(rows.argmin(), 1, len(nodes) - 2))
    return nodes if hats(d, nodes).sum(axis=0).min() >= FEW else np.array([float(np.median(d))])
