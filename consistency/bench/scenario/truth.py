"""What is the case: path, landmarks, motion and sensor of a world."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from consistency.bench.scenario.sensor import TrueSensor_
from consistency.bench.scenario.tables.toml_tables import Count, Finite, Interval, NonNegative, Positive, Table, Triple

MOST_STEPS = 1_000_000  # a trial of so many steps takes some hundred MiB
MOST_LANDMARKS = 1_000_000
MOST_LOOKS = 200_000_000  # landmarks times steps: each is one byte while what is in view is searched


class _Path(Table):
    """Where the robot drives: it starts at ``start`` and repeats the shape until the steps are done."""

    start: tuple[Finite, Finite]
    heading: Finite
    speed: Positive


class Circle(_Path):
    shape: Literal["circle"]
    radius: Positive


class RoundedRectangle(_Path):
    shape: Literal["rounded-rectangle"]
    length: Positive
    width: Positive
    corner_radius: Positive

    @model_validator(mode="after")
    def _fits(self) -> RoundedRectangle:
        if 2 * self.corner_radius > min(self.length, self.width):
            raise ValueError("corner_radius must be at most half of length and of width")
        return self


class FigureOfEight(_Path):
    shape: Literal["figure-of-eight"]
    radius: Positive


class Corridor(_Path):
    """Out along a straight line, a half turn of ``turn_radius``, and back."""

    shape: Literal["corridor"]
    length: Positive
    turn_radius: Positive


class Waypoints(_Path):
    """Straight lines between points, turning on the spot; the last point leads back to ``start``."""

    shape: Literal["waypoints"]
    points: Annotated[list[tuple[Finite, Finite]], Field(min_length=1)]
    turn_rate: Positive

    @model_validator(mode="after")
    def _leads_somewhere(self) -> Waypoints:
        if all(point == self.start for point in self.points):
            raise ValueError("points must hold a point other than start")
        return self


Path_ = Annotated[Circle | RoundedRectangle | FigureOfEight | Corridor | Waypoints, Field(discriminator="shape")]


class UniformLandmarks(Table):
    """``count`` landmarks drawn once, uniformly in a box, from ``seed``."""

    layout: Literal["uniform"]
    count: Annotated[Count, Field(le=MOST_LANDMARKS)]
    seed: Annotated[int, Field(ge=0, strict=True)]
    x: Interval
    y: Interval
    z: Interval

    @model_validator(mode="after")
    def _ordered(self) -> UniformLandmarks:
        for key in ("x", "y", "z"):
            low, high = getattr(self, key)
            if low > high:
                raise ValueError(f"{key} must be [low, high] with low <= high")
        return self


class ListedLandmarks(Table):
    layout: Literal["listed"]
    points: Annotated[list[Triple], Field(min_length=1)]


class CircularLandmarks(Table):
    """``count`` landmarks at equal distances on a circle at height 0, the first in the direction of x."""

    layout: Literal["circular"]
    count: Annotated[Count, Field(le=MOST_LANDMARKS)]
    centre: tuple[Finite, Finite]
    radius: Positive


class AnnularLandmarks(Table):
    """``count`` landmarks drawn once in each of some rings at height 0, uniformly in radius and direction."""

    layout: Literal["annular"]
    count: Annotated[Count, Field(le=MOST_LANDMARKS)]
    seed: Annotated[int, Field(ge=0, strict=True)]
    centre: tuple[Finite, Finite]
    rings: Annotated[list[Interval], Field(min_length=1)]

    @model_validator(mode="after")
    def _ordered(self) -> AnnularLandmarks:
        if not all(0 <= low <= high for low, high in self.rings):
            raise ValueError("rings must be a list of [low, high] with 0 <= low <= high")
        return self


Landmarks_ = Annotated[
    UniformLandmarks | ListedLandmarks | CircularLandmarks | AnnularLandmarks, Field(discriminator="layout")
]


class TrueMotion(Table):
    """Eq. 18 with Gaussian noise on v and omega, or its first-order expansion (``linear``).

    ``noise_on = "odometry"``: the robot drives the path and is told noisy velocities.
    ``noise_on = "motion"``: it is told the planned velocities and drives noisy ones.
    """

    model: Literal["unicycle", "linear"]
    sigma_v: NonNegative
    sigma_omega: NonNegative
    noise_on: Literal["odometry", "motion"]


class Truth(Table):
    """What is the case."""

    dt: Positive
    steps: Annotated[Count, Field(le=MOST_STEPS)]
    path: Path_
    landmarks: Landmarks_
    motion: TrueMotion
    sensor: TrueSensor_

    @model_validator(mode="after")
    def _one_linear_world(self) -> Truth:
        if (self.motion.model == "linear") != (self.sensor.model == "linear"):
            raise ValueError("motion.model and sensor.model must be 'linear' together")
        if self.motion.model == "linear" and self.motion.noise_on != "motion":
            raise ValueError("a linear world needs motion.noise_on = 'motion'")
        return self

    @model_validator(mode="after")
    def _fits_in_memory(self) -> Truth:
        layout = self.landmarks
        rings = len(layout.rings) if isinstance(layout, AnnularLandmarks) else 1
        count = len(layout.points) if isinstance(layout, ListedLandmarks) else layout.count * rings
        if count > MOST_LANDMARKS or count * self.steps > MOST_LOOKS:
            raise ValueError(
                f"steps times landmarks must be at most {MOST_LOOKS}, got {self.steps} times {count}; take fewer"
            )
        return self

    @model_validator(mode="after")
    def _landmarks_in_the_plane(self) -> Truth:
        layout = self.landmarks
        heights: set[float] = set()
        if isinstance(layout, UniformLandmarks):
            heights = set(layout.z)
        elif isinstance(layout, ListedLandmarks):
            heights = {z for _, _, z in layout.points}
        if self.sensor.planar and not heights <= {0.0}:
            raise ValueError(f"a sensor '{self.sensor.model}' measures no heights; give every landmark z = 0")
        return self
