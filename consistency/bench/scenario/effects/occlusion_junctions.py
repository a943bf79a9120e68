"""Occlusion junctions, Herath et al. (2007) sec. 4.3 and fig. 9a: features where edges only seem to cross."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field, model_validator

from consistency.bench.models import point, stereo
from consistency.bench.scenario.effects.effect import UvdEffect, register_effect
from consistency.bench.scenario.effects.observations import Context, Observations
from consistency.bench.scenario.tables.toml_tables import Count, Positive, Rate
from consistency.referee.types import Array


@dataclass(frozen=True)
class Crossings:
    """J pairs of edges in the world: a vertical one, and behind it, seen from somewhere, a horizontal one."""

    near: Array  # (J, 3), m, middle of the vertical edge
    far: Array  # (J, 3), m, middle of the horizontal edge
    along: Array  # (J, 2), unit vector of the horizontal edge
    by_far: Array  # (J,), whether the matcher takes the disparity of the far edge


@register_effect
class Junction(UvdEffect):
    """``count`` apparent crossings of a near vertical and a far horizontal edge, each of which is tracked as a corner.

    The crossing is on the ray that meets both edges. While the robot moves, it slides along both, as no rigid point
    does: for a level camera u is that of the near edge and v that of the far one. d is that of the far
    edge with probability ``far_share``, chosen once for each crossing, or else of the near one.

    The edges have the length ``edge``; each crossing can be seen from a step of the planned path that is drawn from
    ``seed``, at any distance in the sensor's range, with the far edge ``behind`` the near one by a length from that
    interval. They are the same in every run, and stand beside the landmarks with ids of their own. It is observed
    while it is in the image, on both edges, and the near edge is in range.
    """

    units: ClassVar[dict[str, str]] = {"edge": "_m", "behind": "_m"}
    draws: ClassVar[bool] = False
    before_noise: ClassVar[bool] = True

    kind: Literal["junction"] = "junction"
    count: Count
    seed: Annotated[int, Field(ge=0, strict=True)]
    behind: tuple[Positive, Positive]  # m
    edge: Positive  # m
    far_share: Rate

    @model_validator(mode="after")
    def _is_behind(self) -> Junction:
        if self.behind[0] > self.behind[1]:
            raise ValueError("behind must be [low, high] with low <= high")
        return self

    def apply(self, observations: Observations, rng: np.random.Generator, context: Context) -> Observations:
        z, seen = self._seen(self.drawn(context), context)
        step, thing = np.nonzero(seen)
        return observations.add(step + 1, thing, z[seen])

    def drawn(self, context: Context) -> Crossings:
        """The edges, the same in every run."""
        rng, J, sensor = np.random.default_rng(self.seed), self.count, context.sensor
        assert sensor.f is not None
        x, y, heading = context.planned[rng.integers(1, context.steps + 1, J)].T
        width, height = sensor.image or (2.0 * sensor.f, 2.0 * sensor.f)
        column, row = sensor.centre if sensor.image is not None else (sensor.f, sensor.f)
        # in the middle half of the rows, so that it stays in view while it is approached
        u, v = rng.uniform(0.0, width, J) - column, rng.uniform(0.25 * height, 0.75 * height, J) - row
        ray = np.array([np.full(J, sensor.f), -u, -v])
        ray *= rng.uniform(*sensor.range, J) / np.linalg.norm(ray, axis=0)
        mount = sensor.mount.packed()
        near = np.stack(point.to_world(x, y, heading, *point.from_sensor(ray[0], ray[1], ray[2], mount)), axis=1)
        camera = np.broadcast_arrays(*point.to_world(x, y, heading, *mount[:3]))
        sight = near - np.stack(camera, axis=1)
        across = np.hypot(sight[:, 0], sight[:, 1])
        far = near + (rng.uniform(*self.behind, J) / across)[:, None] * sight
        along = np.column_stack([-sight[:, 1], sight[:, 0]]) / across[:, None]
        return Crossings(near, far, along, rng.random(J) < self.far_share)

    def _seen(self, edges: Crossings, context: Context) -> tuple[Array, Array]:
        """(u, v, d) (T, J, 3) of the crossings in steps 1..T, and where they are observed (T, J)."""
        sensor, mount = context.sensor, context.sensor.mount.packed()
        x, y, heading = context.path[1:].T[..., None]
        cx, cy, cz = point.to_world(x, y, heading, *mount[:3])
        # camera + ratio (near - camera) = far + s along, seen from above; ratio > 1 where the far edge is behind
        a0, a1 = edges.near[:, 0] - cx, edges.near[:, 1] - cy
        w0, w1 = edges.far[:, 0] - cx, edges.far[:, 1] - cy
        e0, e1 = edges.along.T
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = (w0 * e1 - w1 * e0) / (a0 * e1 - a1 * e0)
            s = (w0 * a1 - w1 * a0) / (a0 * e1 - a1 * e0)
            height = cz + (edges.far[:, 2] - cz) / ratio
            body = point.to_robot(x, y, heading, *np.broadcast_arrays(edges.near[:, 0], edges.near[:, 1], height))
            at = point.to_sensor(*body, mount)
            assert sensor.rig is not None
            u, v, d = stereo.project(*at, *sensor.rig)
            distance, half = np.sqrt(at[0] ** 2 + at[1] ** 2 + at[2] ** 2), 0.5 * self.edge
            seen = (ratio > 1.0) & (np.abs(s) <= half) & (np.abs(height - edges.near[:, 2]) <= half)
            seen &= (at[0] > 0.0) & (distance >= sensor.range[0]) & (distance <= sensor.range[1])
            seen &= context.in_image(u, v)
            return np.stack([u, v, np.where(edges.by_far, d / ratio, d)], axis=-1), seen
