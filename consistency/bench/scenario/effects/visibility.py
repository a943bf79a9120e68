"""What is not seen: landmarks behind walls, and all of them in steps without an image."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field

from consistency.bench.scenario.effects.effect import ListedEffect, register_effect
from consistency.bench.scenario.effects.observations import Context, Observations
from consistency.bench.scenario.tables.toml_tables import Count, Finite
from consistency.referee.types import Array


@register_effect
class Occlusion(ListedEffect):
    """``walls``, [x0, y0, x1, y1] in m, are upright and of any height; a landmark is hidden where one stands before it.

    The line of sight begins at the sensor. That it crosses a wall is decided in the plane.
    """

    units: ClassVar[dict[str, str]] = {"walls": "_m"}
    draws: ClassVar[bool] = False
    before_noise: ClassVar[bool] = True
    errs: ClassVar[bool] = False

    kind: Literal["occlusion"] = "occlusion"
    walls: Annotated[list[tuple[Finite, Finite, Finite, Finite]], Field(min_length=1)]

    def apply(self, observations: Observations, rng: np.random.Generator, context: Context) -> Observations:
        x, y, heading = context.path[observations.step].T
        dx, dy, _ = context.sensor.mount.position
        c, s = np.cos(heading), np.sin(heading)
        sensor = np.stack([x + c * dx - s * dy, y + s * dx + c * dy])
        point = context.landmarks[observations.sources].T[:2]
        hidden = np.zeros(len(observations), bool)
        for x0, y0, x1, y1 in self.walls:
            near, far = np.array([x0, y0])[:, None], np.array([x1, y1])[:, None]
            hidden |= (_side(near, far, sensor) != _side(near, far, point)) & (
                _side(sensor, point, near) != _side(sensor, point, far)
            )
        return observations.keep(~hidden)


def _side(a: Array, b: Array, p: Array) -> Array:
    """Whether points (2, M) are to the left of the line from ``a`` to ``b``, (2, M) or (2, 1)."""
    left: Array = (b[0] - a[0]) * (p[1] - a[1]) > (b[1] - a[1]) * (p[0] - a[0])
    return left


@register_effect
class Frames(ListedEffect):
    """Images come after ``every`` steps, whose numbers are taken in turn; in the steps between nothing is seen.

    A camera that is slower than the odometry, or whose images are lost.
    """

    draws: ClassVar[bool] = False
    before_noise: ClassVar[bool] = True
    errs: ClassVar[bool] = False

    kind: Literal["frames"] = "frames"
    every: Annotated[list[Count], Field(min_length=1)]

    def apply(self, observations: Observations, rng: np.random.Generator, context: Context) -> Observations:
        images = np.cumsum(np.resize(self.every, context.steps))
        return observations.keep(np.isin(observations.step, images))
