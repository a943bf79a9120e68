"""Tables over nodes: linear between the nodes and constant beyond them."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from consistency.referee.types import Array


def require_increasing(key: str, nodes: tuple[float, ...]) -> None:
    """Refuse nodes of a table that are not in increasing order; raises ValueError."""
    if not all(a < b for a, b in pairwise(nodes)):
        raise ValueError(f"{key} must increase from each number to the next, got {list(nodes)}")


def hats(x: Array, nodes: Array) -> Array:
    """Weights (N, K) with which values at increasing ``nodes`` (K,) are interpolated at ``x`` (N,)."""
    place = np.interp(x, nodes, np.arange(len(nodes)))
    return np.maximum(0.0, 1.0 - np.abs(place[:, None] - np.arange(len(nodes))))


def bilinear(u: Array, v: Array, u_nodes: Array, v_nodes: Array) -> Array:
    """Weights (N, L K) of nodes, row by row of v, at pixels (N,), (N,)."""
    across, down = hats(u, u_nodes), hats(v, v_nodes)
    return np.asarray((down[:, :, None] * across[:, None, :]).reshape(len(u), -1))
