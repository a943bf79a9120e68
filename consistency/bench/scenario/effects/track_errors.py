"""Errors that stay with a track: of a feature tracker, and of tracks that drift over the image."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field

from consistency.bench.scenario.effects.effect import UvdEffect, register_effect
from consistency.bench.scenario.effects.observations import NO_LANDMARK, Context, Observations
from consistency.bench.scenario.tables.toml_tables import NonNegative, Positive, Rate
from consistency.referee.types import Array, Indices


@register_effect
class TrackError(UvdEffect):
    """A first-order Gauss-Markov error along each track, stationary from its first step on.

    Herath et al. (2007) sec. 3.5 and 4.4.
    e_k = c e_k-1 + sqrt(1 - c^2) w_k with w ~ N(0, sigma^2) and c the ``correlation`` from step to step. After a gap
    in a track it restarts.
    """

    units: ClassVar[dict[str, str]] = {"sigma": "_px"}

    kind: Literal["track-error"] = "track-error"
    sigma: tuple[NonNegative, NonNegative, NonNegative]
    correlation: Annotated[float, Field(ge=0, lt=1, allow_inf_nan=False, strict=True)]

    def apply(self, observations: Observations, rng: np.random.Generator, context: Context) -> Observations:
        if not len(observations):
            return observations
        track, age = observations.tracks()
        error = rng.standard_normal((age.max() + 1, track.max() + 1, 3))
        fresh = np.sqrt(1.0 - self.correlation**2)
        for k in range(1, len(error)):
            error[k] = self.correlation * error[k - 1] + fresh * error[k]
        return observations.with_z(observations.z + error[age, track] * self.sigma)


@register_effect
class Drift(UvdEffect):
    """In each step of a track, with probability ``rate``, the tracker loses its feature and starts to slide.

    Herath et al. (2007) sec. 4.3.
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
