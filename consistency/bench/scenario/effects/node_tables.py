"""Tables over nodes: linear between the nodes and constant beyond them."""

from __future__ import annotations

from itertools import pairwise
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field, model_validator

from consistency.bench.scenario.effects.effect import UvdEffect, register_effect
from consistency.bench.scenario.effects.observations import Context, Observations
from consistency.bench.scenario.tables.toml_tables import Finite, Positive, Table
from consistency.referee.types import Array

Nodes = Annotated[tuple[Finite, ...], Field(min_length=1)]
Matrix = tuple[tuple[Finite, ...], ...]
MATRICES = ("bias_u", "bias_v", "bias_d")
Curve = Annotated[tuple[Positive, ...], Field(min_length=1)]


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


class BiasMap(Table):
    """Constant errors of u, v and d as tables over the image: bilinear between the nodes, constant beyond them.

    Herath et al. (2007) sec. 4.1 and fig. 8.

    A matrix has a row for each of ``v`` and a column for each of ``u``; one that is left out is zero.
    """

    units: ClassVar[dict[str, str]] = dict.fromkeys(("u", "v", *MATRICES), "_px")

    u: Nodes  # (K,), px from the principal point, increasing
    v: Nodes  # (L,), likewise
    bias_u: Matrix = ()  # (L, K), px
    bias_v: Matrix = ()
    bias_d: Matrix = ()

    @model_validator(mode="after")
    def _is_a_grid(self) -> BiasMap:
        for key in ("u", "v"):
            require_increasing(key, getattr(self, key))
        rows, columns = len(self.v), len(self.u)
        for key in MATRICES:
            matrix = getattr(self, key)
            if matrix and [len(row) for row in matrix] != [columns] * rows:
                widths = " and ".join(str(width) for width in sorted({len(row) for row in matrix}))
                raise ValueError(
                    f"{key} must have {rows} rows, one for each of v, of {columns} numbers, one for each of u; "
                    f"got {len(matrix)} of {widths}"
                )
        if not any(getattr(self, key) for key in MATRICES):
            raise ValueError(f"give at least one of {', '.join(MATRICES)}")
        return self

    def at(self, u: Array, v: Array) -> Array:
        """Biases (..., 3) of u, v and d at pixels ``u``, ``v`` (...) from the principal point, all in px."""
        left, right, across = _between(np.asarray(u, float), self.u)
        low, high, down = _between(np.asarray(v, float), self.v)
        table = self._table()
        near = table[low, left] + across * (table[low, right] - table[low, left])
        far = table[high, left] + across * (table[high, right] - table[high, left])
        bias: Array = near + down * (far - near)
        return bias

    def _table(self) -> Array:
        """All three matrices, (L, K, 3)."""
        zero = np.zeros((len(self.v), len(self.u)))
        return np.stack([np.array(getattr(self, key)) if getattr(self, key) else zero for key in MATRICES], axis=-1)


def _between(x: Array, nodes: tuple[float, ...]) -> tuple[Array, Array, Array]:
    """Indices of the nodes on both sides of x (...), and how far x is from the one to the other, (..., 1)."""
    place = np.interp(x, nodes, np.arange(len(nodes)))
    before = np.minimum(place.astype(np.int64), max(len(nodes) - 2, 0))
    return before, np.minimum(before + 1, len(nodes) - 1), (place - before)[..., None]


@register_effect
class LocalBias(UvdEffect, BiasMap):
    """Adds the bias of a :class:`BiasMap` at the ideal (u, v) to each observation.

    It comes before the noise, so that the bias is that of the true pixel and the same in every run.
    """

    draws: ClassVar[bool] = False
    before_noise: ClassVar[bool] = True

    kind: Literal["local-bias"] = "local-bias"

    def apply(self, observations: Observations, rng: np.random.Generator, context: Context) -> Observations:
        z = observations.z
        return observations.with_z(z + self.at(z[:, 0], z[:, 1]))

    def map(self) -> BiasMap:
        """The map alone, as a belief holds it."""
        return BiasMap.model_validate(self.model_dump(include=set(BiasMap.model_fields)))


class DisparityGrowth(Table):
    """The standard deviation of a disparity d is ``sigma[2]`` times ``ratio`` at d.

    Herath et al. (2007) eq. 20, sec. 3.4 and fig. 5c.
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
