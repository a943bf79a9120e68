"""The one definition of a sensor: what its truth, a filter's belief and the file of a log say of it.

Each key is declared once. ``Sensor`` has what all of them share, ``StereoSensor`` adds the baseline and ``ImageSensor``
the image. ``BelievedSensor`` is what a filter is told, ``PicturedSensor`` what ``sensor.toml`` of a log says,
``TrueSensor`` what the world has: it adds how far the sensor sees, and its effects.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import (
    Field,
    SerializeAsAny,
    SerializerFunctionWrapHandler,
    ValidationInfo,
    field_validator,
    model_serializer,
    model_validator,
)

from consistency.bench.models.point import Mounting
from consistency.bench.scenario.effects import BUILT_IN, BiasMap, DisparityGrowth, ListedEffect
from consistency.bench.scenario.tables import Count, Finite, Interval, Positive, Sigmas, Table, Triple
from consistency.referee.geometry import rotation

PLANAR_SENSORS = ("relative-xy", "range-bearing")  # of landmarks in the plane, with two values each
# without one of these keys a sensor is as if it were unknown
LEFT_OUT = ("effects", "disparity", "disparity_growth", "bias")


def _size(model: str | None) -> int:
    """Values in an observation of a sensor."""
    return 2 if model in PLANAR_SENSORS else 3


class Mount(Table):
    """Pose of the sensor in the robot frame; zero is the robot's origin, looking along +x."""

    position: Triple = (0.0, 0.0, 0.0)
    rotation: Triple = (0.0, 0.0, 0.0)  # roll, pitch, heading

    def packed(self) -> Mounting:
        """Position and rotation matrix, as the models take it."""
        return Mounting(*self.position, *(float(entry) for entry in rotation(*self.rotation).ravel()))


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


class StereoSensor(Sensor):
    """A sensor that may have a baseline."""

    B: Positive | None = None  # m
    disparity_growth: DisparityGrowth | None = None  # how the noise of a disparity grows with it

    @model_validator(mode="after")
    def _has_disparities(self) -> StereoSensor:
        if self.disparity_growth is not None and self.model != "uvd":
            raise ValueError(f"disparity_growth is of a sensor 'uvd', not '{self.model}'; leave it out")
        return self


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


class BelievedSensor(StereoSensor):
    """Noise and calibration as the filter has them; f and B are needed for ``uvd``."""

    disparity: tuple[Positive, Positive] | None = None  # px, the search range, for filters that allow for it
    bias: BiasMap | None = None  # subtracted from what is measured, at the measured pixel

    @model_validator(mode="after")
    def _rig(self) -> BelievedSensor:
        if self.model == "uvd" and (self.f is None or self.B is None):
            raise ValueError("a uvd sensor needs f (px) and B (m)")
        if self.disparity is not None:
            _require_search_range(self.disparity)
        if self.bias is not None and self.model != "uvd":
            raise ValueError(f"bias is of a sensor 'uvd', not '{self.model}'; leave it out")
        return self


def _require_search_range(disparity: tuple[float, float]) -> None:
    if disparity[0] >= disparity[1]:
        raise ValueError("disparity must be [low, high] with low < high")


class PicturedSensor(BelievedSensor, ImageSensor):
    """A believed sensor with the image that its observations come from, as a log says it."""

    def belief(self) -> BelievedSensor:
        """What a filter believes of this sensor."""
        return BelievedSensor.model_validate(self.model_dump(include=set(BelievedSensor.model_fields)))


class TrueSensor(ImageSensor):
    """A sensor as it is.

    Its effects are, in this order: field of view, noise, the listed ``effects``, search range (``uvd``). A listed
    effect whose class says ``before_noise`` is applied before the noise.
    """

    range: Interval  # m, distance from the sensor
    effects: tuple[SerializeAsAny[ListedEffect], ...] = ()  # in the order in which they are applied

    @field_validator("effects", mode="before")
    @classmethod
    def _is_a_list(cls, data: Any) -> Any:
        if not isinstance(data, list | tuple):
            raise ValueError("a list of tables, each of which begins with [[truth.sensor.effects]]")
        return data

    @property
    def rig(self) -> tuple[float, float] | None:
        """Focal length (px) and baseline (m) of a sensor that measures disparities."""
        return None

    @model_validator(mode="after")
    def _consistent_view(self) -> TrueSensor:
        low, high = self.range
        if not 0 <= low < high:
            raise ValueError("range must be [low, high] with 0 <= low < high")
        if self.image is not None and self.f is None:
            raise ValueError("image needs f, the focal length in pixels")
        return self

    @model_validator(mode="after")
    def _effects_fit(self) -> TrueSensor:
        taken = set(BUILT_IN)
        for effect in self.effects:
            if self.model not in effect.models:
                raise ValueError(
                    f"the effect '{effect.kind}' works on a sensor {' or '.join(effect.models)}, not '{self.model}'"
                )
            if effect.label in taken:
                raise ValueError(
                    f"the name '{effect.label}' of an effect is taken; give each a 'name' of its own, "
                    "on which its random numbers depend"
                )
            taken.add(effect.label)
        return self


class XyzSensor(TrueSensor):
    """Eq. 19: a point in the sensor frame with Gaussian noise in m."""

    model: Literal["xyz"]


class LinearSensor(TrueSensor):
    """Eq. 19 to first order about the planned path; what is seen is decided on the planned path."""

    model: Literal["linear"]


class UvdSensor(TrueSensor, StereoSensor):
    """Eq. 20-22: stereo with Gaussian noise in px and a disparity search range."""

    model: Literal["uvd"]
    f: Positive
    B: Positive
    disparity: tuple[Positive, Positive]

    @property
    def rig(self) -> tuple[float, float]:
        return self.f, self.B

    @model_validator(mode="after")
    def _search_range(self) -> UvdSensor:
        _require_search_range(self.disparity)
        return self


class RelativeXySensor(TrueSensor):
    """Position of landmarks of the plane in the sensor frame, dx and dy, with Gaussian noise in m."""

    model: Literal["relative-xy"]


class RangeBearingSensor(TrueSensor):
    """Range (m) and bearing (rad, counter-clockwise) of landmarks of the plane with Gaussian noise."""

    model: Literal["range-bearing"]


TrueSensor_ = Annotated[
    XyzSensor | LinearSensor | UvdSensor | RelativeXySensor | RangeBearingSensor, Field(discriminator="model")
]
