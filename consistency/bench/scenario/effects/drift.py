"""Tracks that drift over the image, Herath et al. (2007) sec. 4.3."""

from __future__ import annotations

from typing import ClassVar, Literal

import numpy as np

from consistency.bench.scenario.effects.effect import UvdEffect, register
from consistency.bench.scenario.effects.observations import NO_LANDMARK, Context, Observations
from consistency.bench.scenario.toml_tables import Positive, Rate
from consistency.referee.types import Array, Indices


@register
class Drift(UvdEffect):
    """In each step of a track, with probability ``rate``, the tracker loses its feature and starts to slide.

    From then on u and v move by ``speed`` (px a step) in a direction of the track's own, on top of the motion of the
    landmark; d stays that of the landmark. It slides until the track ends or leaves the image. In the trial the row is
    of no landmark (source -1) from the first such step on.
    """

    units: ClassVar[dict[str, str]] = {"speed": "_px"}

    kind: Literal["drift"] = "drift"
    rate: Rate
    speed: Positive

    def apply(self, observations: Observations, rng: np.random.Generator, context: Context) -> Observations:
        """The rows, without those of tracks that have slid out of the image."""
        track, age = observations.tracks()
        number = int(track.max(initial=-1)) + 1
        starts = rng.random(len(observations)) < self.rate
        angle = rng.uniform(0.0, 2.0 * np.pi, number)[track]
        slid = age - _earliest(starts, track, age, number) + 1
        drifting = slid > 0
        z = observations.z.copy()
        z[:, :2] += np.where(drifting, self.speed * slid, 0.0)[:, None] * np.column_stack(
            [np.cos(angle), np.sin(angle)]
        )
        outside = drifting & ~context.in_image(z[:, 0], z[:, 1])
        gone = age >= _earliest(outside, track, age, number)
        return observations.with_z(z, np.where(drifting, NO_LANDMARK, observations.sources)).keep(~gone)


def _earliest(chosen: Array, track: Indices, age: Indices, number: int) -> Indices:
    """For each row (M,) the first age in its track at which ``chosen`` (M,) is true; beyond all ages if it never is."""
    first = np.full(number, len(age), np.int64)
    np.minimum.at(first, track[chosen], age[chosen])
    return first[track]
