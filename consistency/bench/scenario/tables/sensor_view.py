"""What a sensor is and sees, apart from its effects: pose on the robot, image, range."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import SerializerFunctionWrapHandler, ValidationInfo, field_validator, model_serializer, model_validator

from consistency.bench.models.point import Mounting
from consistency.bench.scenario.tables.toml_tables import Count, Finite, Interval, Positive, Sigmas, Table, Triple
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
