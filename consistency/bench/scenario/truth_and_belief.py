"""A scenario as a record: what is the case, path, landmarks, motion and sensor, and one belief about it."""

from __future__ import annotations

import difflib
import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import tomli_w
from pydantic import Field, SerializerFunctionWrapHandler, model_serializer, model_validator

from consistency.bench.scenario.effects import LocalBias
from consistency.bench.scenario.sensor import BelievedSensor, TrueSensor_
from consistency.bench.scenario.toml_tables import (
    UNITS,
    Count,
    Finite,
    Interval,
    NonNegative,
    Positive,
    Table,
    Triple,
    read_table,
)
from consistency.referee.errors import InputError
from consistency.referee.parsing import is_folder, one_line
from consistency.referee.system import data_folder

Share = Annotated[float, Field(gt=0, lt=1, strict=True)]
# keys of both halves; of the second kind one half may have what the other leaves out
SHARED = (("motion", ("sigma_v", "sigma_omega")), ("sensor", ("sigma", "mount", "f", "B", "disparity")))
OPTIONAL = (("sensor", ("disparity_growth",)),)
ARRAYS = re.compile(r"\[\n((?: +[-+.\w]+,\n)+) *\]")  # an array of numbers, each on a line
MOST_STEPS = 1_000_000  # a trial of so many steps takes some hundred MiB
MOST_LANDMARKS = 1_000_000
MOST_LOOKS = 200_000_000  # landmarks times steps: each is one byte while what is in view is searched


class BelievedMotion(Table):
    sigma_v: NonNegative
    sigma_omega: NonNegative


class SigmaPoints(Table):
    """Scaled sigma points over the L variables that a transform involves (robot, or robot and seen).

    Spread alpha sqrt(L + kappa), weights after Merwe (2004). The default (1, 0, 0) is the cubature set of
    Arasaratnam & Haykin (2009): spread sqrt(L), no centre point, no weight negative, so that S stays
    positive definite however many landmarks are seen; it has no parameter to tune.
    """

    alpha: Positive = 1.0
    beta: NonNegative = 0.0
    kappa: Finite = 0.0


class GuardSettings(Table):
    """What a guarded filter takes for spurious; an unguarded one does not read it.

    ``confidence`` is the share of right observations that a gate lets pass. The default, 0.99, is that of Neira &
    Tardos (2001) and of Civera et al. (2010). ``threshold``, of ``ransac`` alone, is the distance in standard
    deviations up to which what is left of an innovation supports a hypothesis: 2, as in Civera et al. (2010).
    ``min_age`` is the number of sightings from which a track is used: with 1, the default, from the first on.
    ``forget_after`` is the number of observations of a landmark that are rejected one after the other until all later
    ones are refused; by default a landmark is never given up.
    """

    confidence: Share = 0.99
    threshold: Positive = 2.0
    min_age: Count = 1
    forget_after: Count | None = None


class Belief(Table):
    """What the filter takes to be the case."""

    motion: BelievedMotion
    sensor: BelievedSensor
    sigma_points: SigmaPoints = SigmaPoints()
    guard: GuardSettings | None = None  # None: the defaults

    @model_serializer(mode="wrap")
    def _without_guard(self, handler: SerializerFunctionWrapHandler) -> dict[str, Any]:
        """A belief without the table has the content, and so the hash, of one that knows of no guards."""
        content: dict[str, Any] = handler(self)
        if self.guard is None:
            content.pop("guard", None)
        return content


class Scenario(Table):
    """One world and one belief about it."""

    not_in_file: ClassVar[frozenset[str]] = frozenset({"name"})  # it follows from the file's name
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
        default = f"{self.name} with other {', '.join(changes) or 'name'}".replace("__", ".")
        summary = changes.pop("summary", default)
        return with_changes(self, name, summary, {path.replace("__", "."): value for path, value in changes.items()})


def with_changes(base: Scenario, name: str, summary: str, changes: Mapping[str, Any]) -> Scenario:
    """A copy of the scenario with values set by dotted key; raises pydantic's ValidationError."""
    data = base.model_dump() | {"name": name, "summary": summary}
    for path, value in changes.items():
        *parents, key = path.split(".")
        table = data
        for parent in parents:
            table = table[parent]
        stem, _, unit = key.rpartition("_")
        if key not in table and f"_{unit}" in UNITS.values():
            table.pop(stem, None)  # the value comes with its unit
        table[key] = value
    return Scenario.model_validate(data)


def unknown(what: str, name: str, known: Sequence[str]) -> str:
    """That there is no such scenario, sweep or filter, and what there is."""
    near = difflib.get_close_matches(name, known, n=1)
    hint = f" (did you mean '{near[0]}'?)" if near else ""
    return f"unknown {what} '{name}'{hint}; known: {', '.join(known)}"


def scenario_names() -> list[str]:
    """Names of the built-in scenarios."""
    return sorted(path.stem for path in data_folder("scenarios").glob("*.toml"))


def load_scenario(name: str | Path | Scenario) -> Scenario:
    """Scenario by built-in name or by path to a ``.toml`` file; a scenario is returned as it is.

    Raises
    ------
    InputError
        Unknown name, unreadable file, unknown key or a value that is not allowed.
    """
    if isinstance(name, Scenario):
        return name
    path = Path(name)
    if str(name) in scenario_names():
        path = data_folder("scenarios") / f"{name}.toml"
    elif is_folder(path):
        raise InputError(f"{path}: a folder; give a .toml file in it, or to filter a log --log {path}")
    elif path.suffix != ".toml":
        raise InputError(f"{unknown('scenario', one_line(name), scenario_names())}; or give the path of a .toml file")
    return read_table(path, Scenario, name=path.stem)


def misbelief(scenario: Scenario) -> str:
    """In what the belief differs from the truth, and the remedy, in one clause; empty where the belief is right.

    A bias map must be believed if it is the case. Other effects that make observations err are in no belief.
    """
    truth, belief = scenario.truth, scenario.belief
    for keys, may_lack in ((SHARED, True), (OPTIONAL, False)):
        for table, key in ((table, key) for table, names in keys for key in names):
            believed, true = (getattr(getattr(of, table), key, None) for of in (belief, truth))
            if believed != true and not (may_lack and None in (believed, true)):
                return f"key 'belief.{table}.{key}' is not what truth.{table}.{key} is; make them the same"
    effects = truth.sensor.effects
    maps = [effect.map() for effect in effects if isinstance(effect, LocalBias)]
    if maps != ([] if belief.sensor.bias is None else [belief.sensor.bias]):
        return "key 'belief.sensor.bias' is not the bias of the effect 'local-bias' in truth.sensor; make them the same"
    unknown = [effect.label for effect in effects if effect.errs and not isinstance(effect, LocalBias)]
    return f"no belief holds the effect '{unknown[0]}' (truth.sensor.effects); leave it out" if unknown else ""


def toml_text(data: Mapping[str, Any]) -> str:
    """Data as TOML, with arrays of numbers on one line."""
    return ARRAYS.sub(lambda array: f"[{', '.join(array[1].replace(',', ' ').split())}]", tomli_w.dumps(data))


def scenario_text(scenario: Scenario, comment: str = "") -> str:
    """The text of a file that :func:`load_scenario` reads as the same world and belief, in SI units and radians.

    The name is not in it, because it follows from the file's name. Each line of ``comment`` becomes one at the top.
    """
    text = toml_text(scenario.model_dump(mode="json", exclude_none=True, exclude={"name"}))
    return "".join(f"# {line}\n" for line in comment.splitlines()) + text


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
