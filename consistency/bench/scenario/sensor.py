"""The one definition of a sensor: what its truth, a filter's belief and the file of a log say of it.

Each key is declared once. ``view`` has the keys that effects read, ``StereoSensor`` adds the baseline.
``BelievedSensor`` is what a filter is told, ``PicturedSensor`` what ``sensor.toml`` of a log says,
``TrueSensor`` what the world has: it adds the effects.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, SerializeAsAny, field_validator, model_validator

from consistency.bench.scenario.effects import BUILT_IN, BiasMap, DisparityGrowth, ListedEffect
from consistency.bench.scenario.observations import ImageSensor, SeeingSensor, Sensor, require_search_range
from consistency.bench.scenario.toml_tables import Positive


class StereoSensor(Sensor):
    """A sensor that may have a baseline."""

    B: Positive | None = None  # m
    disparity_growth: DisparityGrowth | None = None  # how the noise of a disparity grows with it

    @model_validator(mode="after")
    def _has_disparities(self) -> StereoSensor:
        if self.disparity_growth is not None and self.model != "uvd":
            raise ValueError(f"disparity_growth is of a sensor 'uvd', not '{self.model}'; leave it out")
        return self


class BelievedSensor(StereoSensor):
    """Noise and calibration as the filter has them; f and B are needed for ``uvd``."""

    disparity: tuple[Positive, Positive] | None = None  # px, the search range, for filters that allow for it
    bias: BiasMap | None = None  # subtracted from what is measured, at the measured pixel

    @model_validator(mode="after")
    def _rig(self) -> BelievedSensor:
        if self.model == "uvd" and (self.f is None or self.B is None):
            raise ValueError("a uvd sensor needs f (px) and B (m)")
        if self.disparity is not None:
            require_search_range(self.disparity)
        if self.bias is not None and self.model != "uvd":
            raise ValueError(f"bias is of a sensor 'uvd', not '{self.model}'; leave it out")
        return self

    @property
    def rig(self) -> tuple[float, float]:
        """Focal length (px) and baseline (m) of a sensor ``uvd``."""
        assert self.f is not None
        assert self.B is not None
        return self.f, self.B


class PicturedSensor(BelievedSensor, ImageSensor):
    """A believed sensor with the image that its observations come from, as a log says it."""

    def belief(self) -> BelievedSensor:
        return BelievedSensor.model_validate(self.model_dump(include=set(BelievedSensor.model_fields)))


class TrueSensor(SeeingSensor):
    """A sensor as it is.

    Its effects are, in this order: field of view, noise, the listed ``effects``, search range (``uvd``). A listed
    effect whose class says ``before_noise`` is applied before the noise.
    """

    effects: tuple[SerializeAsAny[ListedEffect], ...] = ()  # in the order in which they are applied

    @field_validator("effects", mode="before")
    @classmethod
    def _is_a_list(cls, data: Any) -> Any:
        if not isinstance(data, list | tuple):
            raise ValueError("a list of tables, each of which begins with [[truth.sensor.effects]]")
        return data

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

    @property
    def search_range(self) -> tuple[float, float]:
        return self.disparity

    @model_validator(mode="after")
    def _search_range(self) -> UvdSensor:
        require_search_range(self.disparity)
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
