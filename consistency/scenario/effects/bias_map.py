"""Constant error of a sensor by place in the image, Herath et al. (2007) sec. 4.1 and fig. 8."""

from __future__ import annotations

from itertools import pairwise
from typing import Annotated, ClassVar

import numpy as np
from pydantic import Field, model_validator

from consistency.scenario.tables import Finite, Table
from consistency.types import Array

Nodes = Annotated[tuple[Finite, ...], Field(min_length=1)]
Matrix = tuple[tuple[Finite, ...], ...]


class BiasMap(Table):
    """Bias of u, v and d at nodes of the image: L rows of K numbers each; one that is left out is zero."""

    units: ClassVar[dict[str, str]] = dict.fromkeys(("u", "v", "bias_u", "bias_v", "bias_d"), "_px")

    u: Nodes  # (K,), px from the principal point, increasing
    v: Nodes  # (L,)
    bias_u: Matrix | None = None  # (L, K), px
    bias_v: Matrix | None = None
    bias_d: Matrix | None = None

    @model_validator(mode="after")
    def _fits(self) -> BiasMap:
        for key in ("u", "v"):
            nodes = getattr(self, key)
            if any(a >= b for a, b in pairwise(nodes)):
                raise ValueError(f"{key}_px must increase")
        rows, columns = len(self.v), len(self.u)
        for key in ("bias_u", "bias_v", "bias_d"):
            matrix = getattr(self, key)
            if matrix is not None and [len(row) for row in matrix] != [columns] * rows:
                raise ValueError(f"{key}_px must have {rows} rows of {columns} numbers, as v_px and u_px say")
        return self

    def at(self, u: Array, v: Array) -> Array:
        """Bias (..., 3) of u, v, d at pixels ``u`` and ``v`` (...): bilinear, constant beyond the nodes."""
        i, s = _cell(np.asarray(u, float), np.array(self.u))
        j, t = _cell(np.asarray(v, float), np.array(self.v))
        out = np.zeros((*np.shape(i), 3))
        for k, matrix in enumerate((self.bias_u, self.bias_v, self.bias_d)):
            if matrix is not None:
                b = np.array(matrix)
                i1, j1 = np.minimum(i + 1, len(self.u) - 1), np.minimum(j + 1, len(self.v) - 1)
                out[..., k] = (1 - t) * ((1 - s) * b[j, i] + s * b[j, i1]) + t * ((1 - s) * b[j1, i] + s * b[j1, i1])
        return out


def _cell(x: Array, nodes: Array) -> tuple[Array, Array]:
    """Node to the left of each place, and how far it is to the next one, 0 to 1."""
    if len(nodes) == 1:
        return np.zeros(x.shape, int), np.zeros(x.shape)
    i = np.clip(np.searchsorted(nodes, x, side="right") - 1, 0, len(nodes) - 2)
    return i, np.clip((x - nodes[i]) / (nodes[i + 1] - nodes[i]), 0.0, 1.0)
