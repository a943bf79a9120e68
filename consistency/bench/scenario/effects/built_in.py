"""The effects of every sensor: field of view, independent Gaussian noise, and the disparities that stereo searches."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from consistency.bench.models import point, stereo
from consistency.bench.scenario.effects.node_tables import DisparityGrowth
from consistency.bench.scenario.effects.observations import Context, Observations
from consistency.referee.types import Array

BLOCK = 8192  # numbers in each array of a search for what is in view: they stay in the processor's cache


@dataclass(frozen=True)
class FieldOfView:
    """Keeps a landmark in a step if its true position is in range and its true projection in the image.

    The first effect of every sensor. A linear sensor looks from the planned path, because what is seen must not depend
    on the noise if the Kalman filter is to be exact.
    """

    label: ClassVar[str] = "field-of-view"
    draws: ClassVar[bool] = False

    def apply(self, observations: Observations, rng: np.random.Generator, context: Context) -> Observations:
        path = context.planned if context.linear else context.path
        x, y, heading = path[1:].T[..., None]
        c, s = np.cos(heading), np.sin(heading)
        mount = context.sensor.mount.packed()
        seen = np.empty(observations.step.shape, bool)
        rows = max(BLOCK // len(context.landmarks), 1)
        for k in range(0, len(seen), rows):
            here = slice(k, k + rows)
            body = point.turned_to_robot(x[here], y[here], c[here], s[here], *context.landmarks.T)
            seen[here] = _visible(context, *point.to_sensor(*body, mount))
        return observations.keep(seen)


def _visible(context: Context, x: Array, y: Array, z: Array) -> Array:
    """Which of the points in the sensor frame are in range and in the image."""
    sensor = context.sensor
    distance = np.sqrt(x * x + y * y + z * z)
    nearest, farthest = sensor.range
    seen: Array = (distance >= nearest) & (distance <= farthest)
    if sensor.image is None:
        return seen
    assert sensor.f is not None
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v, _ = stereo.project(x, y, z, sensor.f, 0.0)
    return np.asarray(seen & (x > 0) & context.in_image(u, v))


@dataclass(frozen=True)
class Noise:
    """Adds ``sigma`` times a standard normal number to each value; that of a disparity may grow with it."""

    label: ClassVar[str] = "noise"
    draws: ClassVar[bool] = True

    sigma: tuple[float, ...]  # px for uvd, m and rad for range-bearing, m otherwise
    growth: DisparityGrowth | None = None

    def apply(self, observations: Observations, rng: np.random.Generator, context: Context) -> Observations:
        z = rng.standard_normal((len(observations), len(self.sigma)))
        z *= self.sigma
        if self.growth is not None:
            z[:, 2] *= self.growth.ratio_at(observations.z[:, 2])
        z += observations.z
        return observations.with_z(z)


@dataclass(frozen=True)
class SearchRange:
    """Keeps a row if its measured disparity is in the search range. The last effect of a ``uvd`` sensor."""

    label: ClassVar[str] = "search-range"
    draws: ClassVar[bool] = False

    low: float  # px
    high: float  # px

    def apply(self, observations: Observations, rng: np.random.Generator, context: Context) -> Observations:
        d = observations.z[:, 2]
        return observations.keep((d >= self.low) & (d <= self.high))
