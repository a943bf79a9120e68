"""What effects of a sensor work on.

These are the observations of a trial, what the sensor is and sees, and tables over nodes; and what an effect is.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated, Any, ClassVar, Literal, TypeVar

import numpy as np
from pydantic import (
    Field,
    ModelWrapValidatorHandler,
    SerializerFunctionWrapHandler,
    TypeAdapter,
    ValidationInfo,
    field_validator,
    model_serializer,
    model_validator,
)
from pydantic_core import PydanticCustomError

from consistency.bench.scenario import models
from consistency.bench.scenario.toml_tables import Count, Finite, Interval, Positive, Sigmas, Table, Triple
from consistency.referee.geometry import rotation
from consistency.referee.types import Array, Indices

NO_LANDMARK = -1  # source of an observation that is of no landmark
E = TypeVar("E", bound="ListedEffect")
EFFECTS: dict[str, type[ListedEffect]] = {}  # by kind
Nodes = Annotated[tuple[Finite, ...], Field(min_length=1)]
Matrix = tuple[tuple[Finite, ...], ...]
MATRICES = ("bias_u", "bias_v", "bias_d")
Curve = Annotated[tuple[Positive, ...], Field(min_length=1)]
PLANAR_SENSORS = ("relative-xy", "range-bearing")  # of landmarks in the plane, with two values each
# without one of these keys a sensor is as if it were unknown
LEFT_OUT = ("effects", "disparity", "disparity_growth", "bias")


class Observations:
    """Observations of a trial, row by row, in order of step and then of landmark. Methods give new ones.

    Parameters
    ----------
    step : (M,)
        Steps 1..T.
    landmark : (M,)
        Ids as a filter is told them: 0..N-1 are the landmarks of the world, those from N on are things that are
        not landmarks.
    z : (M, s), or what gives it for (step, landmark)
        (x, y, z) in m, (u, v, d) in px, (dx, dy) in m, or range in m and bearing in rad.
    ids : int
        Ids in use so far: 0..ids-1.
    source : (M,), optional
        Landmark that a row is really of, -1 if it is of none. None: each row is of its ``landmark``.
    """

    __slots__ = ("_z", "ids", "landmark", "source", "step")

    def __init__(
        self,
        step: Indices,
        landmark: Indices,
        z: Array | Callable[[Indices, Indices], Array],
        ids: int,
        source: Indices | None = None,
    ) -> None:
        self.step, self.landmark, self._z, self.ids, self.source = step, landmark, z, ids, source

    def __len__(self) -> int:
        return len(self.step)

    @property
    def z(self) -> Array:
        """Measured values, shape (M, s); those of the ideal observation are worked out when first asked for."""
        if callable(self._z):
            self._z = self._z(self.step, self.landmark)
        return self._z

    @property
    def sources(self) -> Indices:
        """Landmark that each row is really of, shape (M,); -1 where it is of none."""
        return self.landmark if self.source is None else self.source

    def tracks(self) -> tuple[Indices, Indices]:
        """Number of the track of each row from 0 on, and how many rows of it come before; both (M,).

        A track is what is seen of one id in consecutive steps; after a gap a new one begins.
        """
        order = np.argsort(self.landmark, kind="stable")
        landmark, step = self.landmark[order], self.step[order]
        begins = np.ones(len(order), bool)
        begins[1:] = (landmark[1:] != landmark[:-1]) | (step[1:] != step[:-1] + 1)
        track, age = np.empty(len(order), np.int64), np.empty(len(order), np.int64)
        track[order] = number = np.cumsum(begins) - 1
        age[order] = np.arange(len(order)) - np.flatnonzero(begins)[number]
        return track, age

    def keep(self, chosen: Array) -> Observations:
        """The rows for which ``chosen``, of the shape of ``step``, is true."""
        z = self._z if callable(self._z) else self._z[chosen]
        source = None if self.source is None else self.source[chosen]
        return Observations(self.step[chosen], self.landmark[chosen], z, self.ids, source)

    def with_z(self, z: Array, source: Indices | None = None) -> Observations:
        """A copy of the rows with other values ``z`` (M, s), and another ``source`` (M,) where one is given."""
        return Observations(self.step, self.landmark, z, self.ids, self.source if source is None else source)

    def add(self, step: Indices, thing: Indices, z: Array) -> Observations:
        """With K rows more, of things that are not landmarks.

        Parameters
        ----------
        step : (K,)
            Steps 1..T.
        thing : (K,)
            Number of the thing, from 0: rows of one number are a track, one landmark to a filter.
        z : (K, s)
            What is measured of it.
        """
        if len(step) == 0:
            return self
        landmark = np.concatenate([self.landmark, self.ids + np.asarray(thing, np.int64)])
        steps = np.concatenate([self.step, np.asarray(step, np.int64)])
        source = np.concatenate([self.sources, np.full(len(step), NO_LANDMARK)])
        order = np.lexsort((landmark, steps))
        values = np.concatenate([self.z, z])[order]
        return Observations(steps[order], landmark[order], values, int(landmark.max()) + 1, source[order])


@dataclass(frozen=True)
class Context:
    """What an effect may know of a trial: the sensor, the landmarks and the path. Numbers of runs are not there.

    Attributes
    ----------
    sensor : SeeingSensor
    landmarks : (N, 3)
        True positions in the world, m.
    path : (T + 1, 3)
        True x, y (m) and heading (rad, not wrapped) of steps 0..T.
    planned : (T + 1, 3)
        The path without any noise.
    """

    sensor: SeeingSensor
    landmarks: Array
    path: Array
    planned: Array

    @property
    def linear(self) -> bool:
        """Whether the world is linear: to first order about the planned path."""
        return self.sensor.model == "linear"

    @property
    def steps(self) -> int:
        """T, the number of the last step."""
        return len(self.path) - 1

    def ideal(self) -> Observations:
        """Every landmark in every step, without limit and without error.

        ``step`` and ``landmark`` have the shape (T, N) and take no memory; the field of view makes rows of them.
        """
        shape = self.steps, len(self.landmarks)
        step = np.broadcast_to(np.arange(1, shape[0] + 1)[:, None], shape)
        return Observations(step, np.broadcast_to(np.arange(shape[1]), shape), self.measure, shape[1])

    def at(self, step: Indices, landmark: Indices) -> Observations:
        """Ideal observations of landmarks in steps, shapes (M,)."""
        return Observations(step, landmark, self.measure, len(self.landmarks))

    def measure(self, step: Indices, landmark: Indices) -> Array:
        """Ideal measurements (M, s) of landmarks in steps 1..T, in the units of the sensor.

        Herath et al. (2007) eq. 19 and 22, or eq. 19 to first order about the planned path.
        """
        points = self._linearised(step, landmark) if self.linear else self.points(step, landmark)
        if self.sensor.rig is not None:
            points = models.project(*points, *self.sensor.rig)
        if self.sensor.model == "range-bearing":
            return np.stack(models.range_bearing(*points[:2]), axis=-1)
        return np.stack(points[: self.sensor.size], axis=-1)

    def in_image(self, u: Array, v: Array) -> Array:
        """Which pixels, in px from the principal point, are in the image; all of them where it has no bounds."""
        if self.sensor.image is None:
            return np.ones(np.shape(u), bool)
        (width, height), (column, row) = self.sensor.image, self.sensor.centre
        return np.asarray((u >= -column) & (u < width - column) & (v >= -row) & (v < height - row))

    def points(self, step: Indices, landmark: Indices) -> tuple[Array, Array, Array]:
        """True x, y, z of landmarks in the sensor frame in steps 1..T, m, each (M,)."""
        body = models.to_robot(*self.path[step].T, *self.landmarks[landmark].T)
        return models.to_sensor(*body, self.sensor.mount.packed())

    def _linearised(self, step: Indices, landmark: Indices) -> tuple[Array, Array, Array]:
        pose, reference = self.path[step], self.planned[step]
        x, y, z = models.to_robot(*reference.T, *self.landmarks[landmark].T)
        c, s = np.cos(reference[:, 2]), np.sin(reference[:, 2])
        dx, dy, dh = (pose - reference).T
        body = x - c * dx - s * dy + y * dh, y + s * dx - c * dy - x * dh, z
        return models.to_sensor(*body, self.sensor.mount.packed())


class ListedEffect(Table):
    """An effect that a scenario lists: its fields are the keys of its table.

    A subclass gives ``kind`` a value, adds keys of its own and defines :meth:`apply`. Two effects of one kind need
    different names, because the random numbers of an effect depend on seed, run and name, and on nothing else.
    """

    models: ClassVar[tuple[str, ...]] = ("xyz", "uvd", "linear", "relative-xy", "range-bearing")  # that it works on
    draws: ClassVar[bool] = True  # whether it needs random numbers
    before_noise: ClassVar[bool] = False  # whether it is applied before the sensor's noise or after it
    errs: ClassVar[bool] = True  # whether what is measured then differs from what a belief without it expects

    kind: str
    name: Annotated[str, Field(min_length=1)] | None = None

    @property
    def label(self) -> str:
        return self.name or self.kind

    @abstractmethod
    def apply(self, observations: Observations, rng: np.random.Generator, context: Context) -> Observations:
        """What becomes of ``observations``; ``rng`` is this effect's own in this run."""

    @classmethod
    def kinds(cls) -> list[type[Table]]:
        return list(EFFECTS.values())

    @model_validator(mode="wrap")
    @classmethod
    def _by_kind(cls, data: Any, handler: ModelWrapValidatorHandler[ListedEffect]) -> ListedEffect:
        """The effect that ``kind`` names, in the place of this base."""
        if cls is not ListedEffect or isinstance(data, ListedEffect):
            return handler(data)
        if not isinstance(data, dict):
            raise ValueError("an effect is a table that begins with [[truth.sensor.effects]]")
        context = {"discriminator": "'kind'", "tag": data.get("kind")}
        if "kind" not in data:
            raise PydanticCustomError("union_tag_not_found", "kind is missing", context)
        effect = EFFECTS.get(str(data["kind"]))
        if effect is None:
            known_kinds = ", ".join(f"'{kind}'" for kind in sorted(EFFECTS)) or "the known kinds: there are none yet"
            context["expected_tags"] = known_kinds
            raise PydanticCustomError("union_tag_invalid", "'{tag}' is not one of {expected_tags}", context)
        # as a tagged union would, with the kind in the location of an error
        effects = TypeAdapter[dict[str, ListedEffect]](dict[str, effect])  # type: ignore[valid-type]
        return effects.validate_python({str(data["kind"]): data})[str(data["kind"])]


class UvdEffect(ListedEffect):
    """An effect on the pixels of a stereo sensor."""

    models: ClassVar[tuple[str, ...]] = ("uvd",)


def register_effect(effect: type[E]) -> type[E]:
    """Decorator that makes the kind of an effect known to scenarios."""
    EFFECTS[effect.model_fields["kind"].default] = effect
    return effect


def require_search_range(disparity: tuple[float, float]) -> None:
    """Refuse a range of disparities whose ends are not in order."""
    if disparity[0] >= disparity[1]:
        raise ValueError("disparity must be [low, high] with low < high")


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
        zero = np.zeros((len(self.v), len(self.u)))
        table = np.stack(
            [np.array(getattr(self, key)) if getattr(self, key) else zero for key in MATRICES], axis=-1
        )  # (L, K, 3)
        near = table[low, left] + across * (table[low, right] - table[low, left])
        far = table[high, left] + across * (table[high, right] - table[high, left])
        bias: Array = near + down * (far - near)
        return bias


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


def _size(model: str | None) -> int:
    """Values in an observation of a sensor."""
    return 2 if model in PLANAR_SENSORS else 3


class Mount(Table):
    """Pose of the sensor in the robot frame; zero is the robot's origin, looking along +x."""

    position: Triple = (0.0, 0.0, 0.0)
    rotation: Triple = (0.0, 0.0, 0.0)  # roll, pitch, heading

    def packed(self) -> models.Mounting:
        """Position and rotation matrix, as the models take it."""
        return models.Mounting(*self.position, *(float(entry) for entry in rotation(*self.rotation).ravel()))


class Sensor(Table):
    """What is measured, with which noise and focal length, and from where on the robot."""

    model: Literal["xyz", "uvd", "linear", "relative-xy", "range-bearing"]
    sigma: Sigmas  # px for uvd, m and rad for range-bearing, m otherwise
    f: Positive | None = None  # px
    mount: Mount = Mount()

    @property
    def planar(self) -> bool:
        """Whether it sees landmarks in the plane of the robot, and measures two values of each."""
        return self.model in PLANAR_SENSORS

    @property
    def size(self) -> int:
        """Values in an observation."""
        return _size(self.model)

    @field_validator("sigma")
    @classmethod
    def _one_sigma_a_value(cls, sigma: tuple[float, ...], info: ValidationInfo) -> tuple[float, ...]:
        model = info.data.get("model")
        size = _size(model)
        if model is not None and len(sigma) != size:
            raise ValueError(f"sigma must have {size} numbers for a sensor '{model}', got {len(sigma)}")
        return sigma

    @model_validator(mode="after")
    def _level(self) -> Sensor:
        roll, pitch, _ = self.mount.rotation
        if self.planar and (self.mount.position[2], roll, pitch) != (0.0, 0.0, 0.0):
            raise ValueError(
                f"a sensor '{self.model}' is level in the plane of the robot: mount.position must end in 0 and "
                "mount.rotation begin with 0, 0"
            )
        return self

    @model_serializer(mode="wrap")
    def _without_what_is_left_out(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """A sensor without an optional key has the content, and so the hash, of one that knows of none."""
        content: dict[str, Any] = handler(self)
        return {key: value for key, value in content.items() if value or key not in LEFT_OUT}


class ImageSensor(Sensor):
    """A sensor that may have an image."""

    image: tuple[Count, Count] | None = None  # width, height in px
    principal_point: tuple[Finite, Finite] | None = None  # column, row in px; the image centre if left out

    @property
    def centre(self) -> tuple[float, float]:
        """Principal point in image columns and rows."""
        if self.principal_point is not None:
            return self.principal_point
        assert self.image is not None
        width, height = self.image
        return width / 2.0, height / 2.0


class SeeingSensor(ImageSensor):
    """A sensor with the distances at which it sees, as effects are told of it."""

    range: Interval  # m, distance from the sensor

    @property
    def rig(self) -> tuple[float, float] | None:
        """Focal length (px) and baseline (m) of a sensor that measures disparities."""
        return None

    @property
    def search_range(self) -> tuple[float, float] | None:
        """Least and greatest disparity (px) that such a sensor reports."""
        return None

    @model_validator(mode="after")
    def _consistent_view(self) -> SeeingSensor:
        low, high = self.range
        if not 0 <= low < high:
            raise ValueError("range must be [low, high] with 0 <= low < high")
        if self.image is not None and self.f is None:
            raise ValueError("image needs f, the focal length in pixels")
        return self
