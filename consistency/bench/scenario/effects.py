"""Effects of a sensor on an ideal observation, each with its keys in a scenario and its ``apply``.

Field of view, noise and search range are in every sensor; the others are those that a scenario may list.
docs/extending.md shows how to add one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field, model_validator

from consistency.bench.scenario import models
from consistency.bench.scenario.observations import (
    EFFECTS,
    NO_LANDMARK,
    BiasMap,
    Context,
    DisparityGrowth,
    ListedEffect,
    LocalBias,
    Observations,
    UvdEffect,
    register_effect,
    require_search_range,
)
from consistency.bench.scenario.toml_tables import Count, Finite, NonNegative, Positive, Rate
from consistency.referee.types import Array, Indices

BLOCK = 8192  # numbers in each array of a search for what is in view: they stay in the processor's cache
Coefficients = tuple[Finite, Finite]


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
            body = models.turned_to_robot(x[here], y[here], c[here], s[here], *context.landmarks.T)
            seen[here] = _visible(context, *models.to_sensor(*body, mount))
        return observations.keep(seen)


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


Effect = FieldOfView | Noise | SearchRange | ListedEffect
BUILT_IN = (FieldOfView.label, Noise.label, SearchRange.label)


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
        u, v, _ = models.project(x, y, z, sensor.f, 0.0)
    return np.asarray(seen & (x > 0) & context.in_image(u, v))


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


@register_effect
class Mismatch(UvdEffect):
    """With probability ``rate`` an observation has a disparity that says nothing of its landmark.

    Mismatches of the stereo correspondence, Herath et al. (2007) sec. 4.3 and fig. 9c.
    It is uniform over ``disparity``, or over the search range where that is left out; u and v stay. In the trial such
    a row is of no landmark (source -1).
    """

    kind: Literal["mismatch"] = "mismatch"
    rate: Rate
    disparity: tuple[Positive, Positive] | None = None  # px

    @model_validator(mode="after")
    def _is_a_range(self) -> Mismatch:
        if self.disparity is not None:
            require_search_range(self.disparity)
        return self

    def apply(self, observations: Observations, rng: np.random.Generator, context: Context) -> Observations:
        hit = np.flatnonzero(rng.random(len(observations)) < self.rate)
        searched = self.disparity or context.sensor.search_range
        assert searched is not None
        low, high = searched
        z, source = observations.z.copy(), observations.sources.copy()
        z[hit, 2], source[hit] = rng.uniform(low, high, len(hit)), NO_LANDMARK
        return observations.with_z(z, source)


@register_effect
class HeavyTails(UvdEffect):
    """A contaminated normal (Tukey 1960): some observations have a second Gaussian error beside their noise.

    The "various artefacts in the tails" of Herath et al. (2007) sec. 3.5 and fig. 6.
    With probability ``rate`` an observation gets an error of ``sigma`` (u, v, d). It is still of its landmark.
    """

    units: ClassVar[dict[str, str]] = {"sigma": "_px"}

    kind: Literal["heavy-tails"] = "heavy-tails"
    rate: Rate
    sigma: tuple[NonNegative, NonNegative, NonNegative]

    def apply(self, observations: Observations, rng: np.random.Generator, context: Context) -> Observations:
        hit = np.flatnonzero(rng.random(len(observations)) < self.rate)
        z = observations.z.copy()
        z[hit] += rng.standard_normal((len(hit), 3)) * self.sigma
        return observations.with_z(z)


@register_effect
class Swap(ListedEffect):
    """With probability ``rate`` an observation carries what was measured of another id in the same step.

    False associations, Herath et al. (2007) sec. 4.2: the more features, the more alike they are.
    In the trial the row is then of that other landmark (source). The other row stays as it is, and a step with a single
    observation has none to be taken for it.
    """

    kind: Literal["swap"] = "swap"
    rate: Rate

    def apply(self, observations: Observations, rng: np.random.Generator, context: Context) -> Observations:
        chance, pick = rng.random((2, len(observations)))
        first = np.searchsorted(observations.step, observations.step, side="left")
        seen = np.searchsorted(observations.step, observations.step, side="right") - first
        row = np.flatnonzero((chance < self.rate) & (seen > 1))
        other = first[row] + (pick[row] * (seen[row] - 1)).astype(np.int64)
        other += other >= row  # any row of the step but its own
        z, source = observations.z.copy(), observations.sources.copy()
        z[row], source[row] = observations.z[other], observations.sources[other]
        return observations.with_z(z, source)


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
        near = np.stack(models.to_world(x, y, heading, *models.from_sensor(ray[0], ray[1], ray[2], mount)), axis=1)
        camera = np.broadcast_arrays(*models.to_world(x, y, heading, *mount[:3]))
        sight = near - np.stack(camera, axis=1)
        across = np.hypot(sight[:, 0], sight[:, 1])
        far = near + (rng.uniform(*self.behind, J) / across)[:, None] * sight
        along = np.column_stack([-sight[:, 1], sight[:, 0]]) / across[:, None]
        return Crossings(near, far, along, rng.random(J) < self.far_share)

    def _seen(self, edges: Crossings, context: Context) -> tuple[Array, Array]:
        """(u, v, d) (T, J, 3) of the crossings in steps 1..T, and where they are observed (T, J)."""
        sensor, mount = context.sensor, context.sensor.mount.packed()
        x, y, heading = context.path[1:].T[..., None]
        cx, cy, cz = models.to_world(x, y, heading, *mount[:3])
        # camera + ratio (near - camera) = far + s along, seen from above; ratio > 1 where the far edge is behind
        a0, a1 = edges.near[:, 0] - cx, edges.near[:, 1] - cy
        w0, w1 = edges.far[:, 0] - cx, edges.far[:, 1] - cy
        e0, e1 = edges.along.T
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = (w0 * e1 - w1 * e0) / (a0 * e1 - a1 * e0)
            s = (w0 * a1 - w1 * a0) / (a0 * e1 - a1 * e0)
            height = cz + (edges.far[:, 2] - cz) / ratio
            body = models.to_robot(x, y, heading, *np.broadcast_arrays(edges.near[:, 0], edges.near[:, 1], height))
            at = models.to_sensor(*body, mount)
            assert sensor.rig is not None
            u, v, d = models.project(*at, *sensor.rig)
            distance, half = np.sqrt(at[0] ** 2 + at[1] ** 2 + at[2] ** 2), 0.5 * self.edge
            seen = (ratio > 1.0) & (np.abs(s) <= half) & (np.abs(height - edges.near[:, 2]) <= half)
            seen &= (at[0] > 0.0) & (distance >= sensor.range[0]) & (distance <= sensor.range[1])
            seen &= context.in_image(u, v)
            return np.stack([u, v, np.where(edges.by_far, d / ratio, d)], axis=-1), seen


@register_effect
class Selection(UvdEffect):
    """At most ``count`` tracks at a time. One that is chosen is kept until it is not seen for ``forget_steps``.

    Free places go, one after the other, to what is seen and has the highest rank, the sum of four numbers in [0, 1]
    times their weights:

    - ``strength``: how good a feature it is to track, a fixed random number of each id, drawn from ``seed``;
    - ``stereo``: confidence in its depth, its disparity over the greatest that is searched;
    - ``image``: 1 / (1 + tracks in its cell of an image of ``cells`` columns and rows);
    - ``depth``: the share of tracks on the other side of the disparity ``near``, from which on a feature is near; 1
      where there are none.

    It comes before the noise, so that what is chosen does not depend on errors: by measured disparities it would prefer
    those that are too large. It is then also the same in every run, and done once.
    """

    units: ClassVar[dict[str, str]] = {"near": "_px"}
    draws: ClassVar[bool] = False
    before_noise: ClassVar[bool] = True
    errs: ClassVar[bool] = False

    kind: Literal["selection"] = "selection"
    count: Count
    forget_steps: Count
    seed: Annotated[int, Field(ge=0, strict=True)]
    cells: tuple[Count, Count]
    near: Positive  # px
    strength: NonNegative
    stereo: NonNegative
    image: NonNegative
    depth: NonNegative

    def apply(self, observations: Observations, rng: np.random.Generator, context: Context) -> Observations:
        base, cell, is_near = self._ranked(observations, context)
        ends = np.searchsorted(observations.step, np.arange(1, context.steps + 2))
        last, is_kept = np.zeros(observations.ids, np.int64), np.zeros(observations.ids, bool)
        chosen = np.zeros(len(observations), bool)
        for k in range(context.steps):
            rows = slice(ends[k], ends[k + 1])
            seen = observations.landmark[rows]
            last[seen] = k
            is_kept &= k - last < self.forget_steps
            free = self.count - int(is_kept.sum())
            if free > 0:
                new = self._best(free, base[rows], cell[rows], is_near[rows], is_kept[seen])
                is_kept[seen[new]] = True
            chosen[rows] = is_kept[seen]
        return observations.keep(chosen)

    def _ranked(self, observations: Observations, context: Context) -> tuple[Array, Indices, Indices]:
        """Of each row the rank without what other tracks add to it, its cell, and whether it is near; (M,) each."""
        u, v, d = observations.z.T
        strength = np.random.default_rng(self.seed).random(observations.ids)[observations.landmark]
        most = (context.sensor.search_range or (0.0, np.inf))[1]
        rank = self.strength * strength + self.stereo * np.clip(d / most, 0.0, 1.0)
        if context.sensor.image is None:
            return rank, np.zeros(len(d), np.int64), (d >= self.near).astype(np.int64)
        (columns, rows), (width, height), centre = self.cells, context.sensor.image, context.sensor.centre
        column = np.clip((u + centre[0]) * columns / width, 0, columns - 1).astype(np.int64)
        row = np.clip((v + centre[1]) * rows / height, 0, rows - 1).astype(np.int64)
        return rank, row * columns + column, (d >= self.near).astype(np.int64)

    def _best(self, free: int, base: Array, cell: Indices, is_near: Indices, is_kept: Array) -> Indices:
        """Up to ``free`` rows of a step to be kept, beside those that are, in the order of choice."""
        in_cell = np.bincount(cell[is_kept], minlength=self.cells[0] * self.cells[1])
        by_depth = np.bincount(is_near[is_kept], minlength=2)
        left, new = np.flatnonzero(~is_kept), list[int]()
        while len(left) and len(new) < free:
            total = by_depth.sum()
            other = by_depth[1 - is_near[left]] / total if total else np.ones(len(left))
            rank = base[left] + self.image / (1.0 + in_cell[cell[left]]) + self.depth * other
            at = int(np.argmax(rank))
            new.append(left[at])
            in_cell[cell[left[at]]] += 1
            by_depth[is_near[left[at]]] += 1
            left = np.delete(left, at)
        return np.array(new, np.int64)


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


__all__ = [
    "BUILT_IN",
    "EFFECTS",
    "BiasMap",
    "Context",
    "DisparityGrowth",
    "Distortion",
    "Effect",
    "FieldOfView",
    "ListedEffect",
    "LocalBias",
    "Noise",
    "Observations",
    "SearchRange",
    "register_effect",
]
