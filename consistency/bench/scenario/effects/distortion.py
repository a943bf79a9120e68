"""Radial distortion that a rectification leaves, Herath et al. (2007) sec. 4.1 and fig. 7 and 8."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, Literal

import numpy as np

from consistency.bench.scenario.effects.effect import UvdEffect, register_effect
from consistency.bench.scenario.effects.node_tables import BiasMap
from consistency.bench.scenario.effects.observations import Context, Observations
from consistency.bench.scenario.tables.toml_tables import Finite
from consistency.referee.types import Array

Coefficients = tuple[Finite, Finite]


@register_effect
class Distortion(UvdEffect):
    """What is left of the radial distortion of both cameras, k1 and k2 of each.

    A point of a rectified image at (x, y) = (u, v) / f from the principal point is seen at
    (x, y) (1 + k1 r^2 + k2 r^4), r^2 = x^2 + y^2 (Brown 1971). The left camera measures (u, v), the right one
    (u - d, v); d is the difference of the distorted columns. That the rows then differ too is left to the matcher.
    """

    draws: ClassVar[bool] = False
    before_noise: ClassVar[bool] = True

    kind: Literal["distortion"] = "distortion"
    left: Coefficients
    right: Coefficients

    def apply(self, observations: Observations, rng: np.random.Generator, context: Context) -> Observations:
        assert context.sensor.f is not None
        return observations.with_z(self.distorted(observations.z, context.sensor.f))

    def distorted(self, z: Array, f: float) -> Array:
        """(u, v, d) (..., 3) in px as they are measured, without noise; ``f`` in px."""
        u, v, d = z[..., 0], z[..., 1], z[..., 2]
        left, right = _stretch(u, v, f, self.left), _stretch(u - d, v, f, self.right)
        return np.stack([left * u, left * v, left * u - right * (u - d)], axis=-1)

    def bias_map(self, u: Sequence[float], v: Sequence[float], disparity: float, f: float) -> BiasMap:
        """Biases at nodes ``u`` (K,), ``v`` (L,), for a belief: exact there, and at one ``disparity``; all in px."""
        columns, rows = np.meshgrid(np.asarray(u, float), np.asarray(v, float))
        ideal = np.stack([columns, rows, np.full(columns.shape, disparity)], axis=-1)
        bias = self.distorted(ideal, f) - ideal
        matrices = {f"bias_{name}": bias[..., i].tolist() for i, name in enumerate("uvd")}
        return BiasMap.model_validate({"u": [float(x) for x in u], "v": [float(y) for y in v], **matrices})


def _stretch(u: Array, v: Array, f: float, k: Coefficients) -> Array:
    """1 + k1 r^2 + k2 r^4 at pixels ``u``, ``v`` (...)."""
    r2 = (u * u + v * v) / f**2
    factor: Array = 1.0 + r2 * (k[0] + r2 * k[1])
    return factor
