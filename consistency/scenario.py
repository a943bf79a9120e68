"""Scenarios: a TOML file becomes a frozen record of what is true and what the filter believes."""

from __future__ import annotations

import difflib
import hashlib
import json
import tomllib
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from consistency.errors import InputError
from consistency.geometry import rotation
from consistency.models.point import Mounting

T = TypeVar("T", bound="Table")

# units that a key may carry at its end: by key, and sigma's by the sensor's model
UNITS = {
    **dict.fromkeys(("heading", "sigma_omega", "turn_rate", "rotation"), "_deg"),
    **dict.fromkeys(("f", "image", "principal_point", "disparity"), "_px"),
    **dict.fromkeys(("start", "radius", "length", "width", "corner_radius", "turn_radius", "points"), "_m"),
    **dict.fromkeys(("x", "y", "z", "position", "range", "B"), "_m"),
    "dt": "_s",
}
SIGMA_UNITS = {"uvd": "_px", "xyz": "_m", "linear": "_m"}

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False, strict=True)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False, strict=True)]
Finite = Annotated[float, Field(allow_inf_nan=False, strict=True)]
Count = Annotated[int, Field(gt=0, strict=True)]
Triple = tuple[Finite, Finite, Finite]
Sigmas = tuple[Positive, Positive, Positive]
Interval = tuple[Finite, Finite]


def _scaled(value: Any, factor: float) -> Any:
    if isinstance(value, list | tuple):
        return [_scaled(item, factor) for item in value]
    return value * factor if isinstance(value, int | float) and factor != 1.0 else value


class Table(BaseModel):
    """A table of the file: unknown keys are refused, a key may end in its unit (``heading_deg``, ``f_px``…)."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    @model_validator(mode="before")
    @classmethod
    def _units(cls, data: Any) -> Any:
        if not isinstance(data, dict):
            return data
        out: dict[str, Any] = {}
        for key, value in data.items():
            stem, _, unit = key.rpartition("_")
            wanted = SIGMA_UNITS.get(str(data.get("model")), f"_{unit}") if stem == "sigma" else UNITS.get(stem)
            has_unit = key not in cls.model_fields and stem in cls.model_fields and f"_{unit}" == wanted
            bare, factor = (stem, np.pi / 180.0 if unit == "deg" else 1.0) if has_unit else (key, 1.0)
            if bare in out:
                raise ValueError(f"key '{bare}' is given twice, with and without its unit")
            out[bare] = _scaled(value, factor)
        return out


class Mount(Table):
    """Pose of the sensor in the robot frame; zero is the robot's origin, looking along +x."""

    position: Triple = (0.0, 0.0, 0.0)
    rotation: Triple = (0.0, 0.0, 0.0)  # roll, pitch, heading

    def packed(self) -> Mounting:
        """Position and rotation matrix, as the models take it."""
        return Mounting(*self.position, *(float(entry) for entry in rotation(*self.rotation).ravel()))


# --- the world -------------------------------------------------------------------------------


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
    count: Count
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


Landmarks_ = Annotated[UniformLandmarks | ListedLandmarks, Field(discriminator="layout")]


class TrueMotion(Table):
    """Eq. 18 with Gaussian noise on v and omega, or its first-order expansion (``linear``).

    ``noise_on = "odometry"``: the robot drives the path and is told noisy velocities.
    ``noise_on = "motion"``: it is told the planned velocities and drives noisy ones.
    """

    model: Literal["unicycle", "linear"]
    sigma_v: NonNegative
    sigma_omega: NonNegative
    noise_on: Literal["odometry", "motion"]


class _TrueSensor(Table):
    sigma: Sigmas
    range: Interval  # distance from the sensor
    image: tuple[Count, Count] | None = None  # width, height
    principal_point: tuple[Finite, Finite] | None = None  # column, row; the image centre if left out
    f: Positive | None = None
    mount: Mount = Mount()

    @model_validator(mode="after")
    def _consistent_view(self) -> _TrueSensor:
        if not 0 <= self.range[0] < self.range[1]:
            raise ValueError("range must be [low, high] with 0 <= low < high")
        if self.image is not None and self.f is None:
            raise ValueError("image needs f, the focal length in pixels")
        return self

    @property
    def centre(self) -> tuple[float, float]:
        """Principal point in image columns and rows."""
        if self.principal_point is not None:
            return self.principal_point
        assert self.image is not None
        return self.image[0] / 2.0, self.image[1] / 2.0


class XyzSensor(_TrueSensor):
    """Eq. 19: a point in the sensor frame with Gaussian noise in m."""

    model: Literal["xyz"]


class LinearSensor(_TrueSensor):
    """Eq. 19 to first order about the planned path; what is seen is decided on the planned path."""

    model: Literal["linear"]


class UvdSensor(_TrueSensor):
    """Eq. 20-22: stereo with Gaussian noise in px and a disparity search range."""

    model: Literal["uvd"]
    f: Positive
    B: Positive
    disparity: tuple[Positive, Positive]

    @model_validator(mode="after")
    def _search_range(self) -> UvdSensor:
        if self.disparity[0] >= self.disparity[1]:
            raise ValueError("disparity must be [low, high] with low < high")
        return self


Sensor_ = Annotated[XyzSensor | LinearSensor | UvdSensor, Field(discriminator="model")]


class Truth(Table):
    """What is the case."""

    dt: Positive
    steps: Count
    path: Path_
    landmarks: Landmarks_
    motion: TrueMotion
    sensor: Sensor_

    @model_validator(mode="after")
    def _one_linear_world(self) -> Truth:
        if (self.motion.model == "linear") != (self.sensor.model == "linear"):
            raise ValueError("motion.model and sensor.model must be 'linear' together")
        if self.motion.model == "linear" and self.motion.noise_on != "motion":
            raise ValueError("a linear world needs motion.noise_on = 'motion'")
        return self


# --- the belief ------------------------------------------------------------------------------


class BelievedMotion(Table):
    sigma_v: NonNegative
    sigma_omega: NonNegative


class BelievedSensor(Table):
    """Noise and calibration as the filter has them; f and B are needed for ``uvd``."""

    model: Literal["xyz", "uvd", "linear"]
    sigma: Sigmas
    f: Positive | None = None
    B: Positive | None = None
    mount: Mount = Mount()

    @model_validator(mode="after")
    def _rig(self) -> BelievedSensor:
        if self.model == "uvd" and (self.f is None or self.B is None):
            raise ValueError("a uvd sensor needs f (px) and B (m)")
        return self


class SigmaPoints(Table):
    """Scaled sigma points over the L variables that a transform involves (robot, or robot and seen).

    Spread alpha sqrt(L + kappa), weights after Merwe (2004). The default (1, 0, 0) is the cubature set of
    Arasaratnam & Haykin (2009): spread sqrt(L), no centre point, no weight negative, so that S stays
    positive definite however many landmarks are seen; it has no parameter to tune.
    """

    alpha: Positive = 1.0
    beta: NonNegative = 0.0
    kappa: Finite = 0.0


class Belief(Table):
    """What the filter takes to be the case."""

    motion: BelievedMotion
    sensor: BelievedSensor
    sigma_points: SigmaPoints = SigmaPoints()


class Scenario(Table):
    """One world and one belief about it."""

    name: str
    summary: str
    truth: Truth
    belief: Belief

    @model_validator(mode="after")
    def _same_units(self) -> Scenario:
        if self.truth.sensor.model != self.belief.sensor.model:
            raise ValueError(
                f"belief.sensor.model is '{self.belief.sensor.model}' but the sensor measures "
                f"'{self.truth.sensor.model}' (truth.sensor.model); they must be the same"
            )
        return self

    @property
    def hash(self) -> str:
        """SHA-256 (16 hex digits) of what is true and believed; the name and summary do not count."""
        content = self.model_dump(mode="json", include={"truth", "belief"})
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]

    def variant(self, name: str, **changes: Any) -> Scenario:
        """A copy under a new name with values changed, keyed by dotted path with ``__`` for the dot.

        Without a ``summary`` the copy's says what it is a variant of.

        >>> load_scenario("herath2007-stereo").variant("far", truth__sensor__range=(0.5, 8.0))  # doctest: +SKIP
        """
        changes.setdefault("summary", f"{self.name} with other {', '.join(changes) or 'name'}".replace("__", "."))
        data = self.model_dump()
        data["name"] = name
        for path, value in changes.items():
            table = data
            *parents, key = path.split("__")
            for parent in parents:
                table = table[parent]
            table[key] = value
        return Scenario.model_validate(data)


# --- reading ---------------------------------------------------------------------------------


def data_folder(name: str) -> Path:
    """Folder of shipped data (``scenarios``, ``experiments``): inside the wheel, else beside the package."""
    inside = Path(str(resources.files("consistency"))) / "_data" / name
    beside = Path(str(resources.files("consistency"))).parent / name
    return inside if inside.is_dir() else beside


def scenario_names() -> list[str]:
    """Names of the built-in scenarios."""
    return sorted(path.stem for path in data_folder("scenarios").glob("*.toml"))


def load_scenario(name: str | Path) -> Scenario:
    """Scenario by built-in name or by path to a ``.toml`` file.

    Raises
    ------
    InputError
        Unknown name, unreadable file, unknown key or a value that is not allowed.
    """
    path = Path(name)
    if str(name) in scenario_names():
        path = data_folder("scenarios") / f"{name}.toml"
    elif path.is_dir():
        raise InputError(f"{path}: a folder; give a .toml file in it, or to filter a log --log {path}")
    elif path.suffix != ".toml":
        near = difflib.get_close_matches(str(name), scenario_names(), n=1)
        hint = f" (did you mean '{near[0]}'?)" if near else ""
        known = ", ".join(scenario_names())
        raise InputError(f"unknown scenario '{name}'{hint}; known: {known}; or give the path of a .toml file")
    return read_table(path, Scenario, name=path.stem)


def read_table(path: Path, model: type[T], **extra: Any) -> T:
    """Read and validate one TOML file, raising :class:`InputError` that names file, key and remedy."""
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not valid TOML ({error})") from None
    if taken := sorted(set(data) & set(extra)):
        raise InputError(f"{path}: key '{taken[0]}': not allowed here, it follows from the file's name")
    try:
        return model.model_validate(data | extra)
    except ValidationError as error:
        raise InputError(f"{path}: {explain(error, model)}") from None


def explain(error: ValidationError, model: type[Table]) -> str:
    """One complaint of pydantic in one line: key, what is wrong, what is allowed; unknown keys first."""
    complaints = sorted(error.errors(), key=lambda complaint: complaint["type"] != "extra_forbidden")
    first, more = complaints[0], len(complaints) - 1
    # pydantic inserts the tag of a tagged union into the location: it is no key of the file
    keys = [str(part) for part in first["loc"]]
    tags = {"circle", "rounded-rectangle", "figure-of-eight", "corridor", "waypoints", "uniform", "listed"}
    tags |= {"xyz", "uvd", "linear"}
    keys = [key for key in keys if key not in tags]
    where = f"key '{'.'.join(keys)}': " if keys else ""
    if first["type"] == "extra_forbidden":
        allowed = _allowed(model, [str(part) for part in first["loc"][:-1]])
        text = f"unknown key; allowed here: {', '.join(allowed)}"
    elif first["type"] == "missing":
        text = "missing; it must be given"
    elif first["type"] == "union_tag_not_found":
        tag = first["ctx"]["discriminator"].strip("'")
        where = f"key '{'.'.join([*keys, tag])}': "
        text = "missing; it must be given"
    elif first["type"] == "union_tag_invalid":
        tag = first["ctx"]["discriminator"].strip("'")
        expected = first["ctx"]["expected_tags"]
        where = f"key '{'.'.join([*keys, tag])}': "
        text = f"'{first['ctx'].get('tag', '')}' is not one of {expected}"
    else:
        text = first["msg"].removeprefix("Value error, ")
        if first["type"] != "value_error":
            text += f" (got {first['input']!r})"
    return where + text + (f" (and {more} more)" if more > 0 else "")


def _allowed(model: type[Table], path: list[str]) -> list[str]:
    """Keys of the table at ``path``, following tagged unions by their tag."""
    current: list[type[Table]] = [model]
    for part in path:
        if part in current[0].model_fields:
            current = _tables(current[0].model_fields[part].annotation)
        else:
            current = [table for table in current if f"'{part}'" in str(table.model_fields)] or current
    return [name for name in current[0].model_fields if not (current[0] is Scenario and name == "name")]


def _tables(annotation: Any) -> list[type[Table]]:
    if isinstance(annotation, type) and issubclass(annotation, Table):
        return [annotation]
    return [table for part in getattr(annotation, "__args__", ()) for table in _tables(part)]
