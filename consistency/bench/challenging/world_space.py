"""The space of worlds around a base scenario: a few dimensions, each with bounds and the value of the base."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from consistency.bench.scenario import Scenario, UniformLandmarks, UvdSensor, misbelief
from consistency.bench.scenario.truth_and_belief import with_changes
from consistency.bench.simulation import (
    SHAPES,
    Changes,
    baseline_changes,
    course_of,
    height_changes,
    in_both,
    odometry_changes,
    range_changes,
    tilt_changes,
)
from consistency.referee.errors import InputError
from consistency.referee.parsing import read_toml
from consistency.referee.types import Array

Value = float | int | str
Point = tuple[Value, ...]  # a value of every dimension

SEEDS = 64  # sets of landmarks beside that of the base
DIGITS = 2  # significant ones of a value that is not the base's: a file is read by people
# bounds as factors of the base's value: twice the noise, three times the range; a denser world costs too much
FACTORS = {
    "odometry": (0.5, 2.0), "sensor": (0.5, 2.0), "density": (0.125, 1.0), "steps": (0.2, 2.0),
    "baseline": (1 / 3, 3.0), "range": (0.5, 3.0), "lap": (0.1, 1.0), "dt": (0.5, 5.0),
}  # fmt: skip
TILTS = (0.0, 20.0, 40.0, -20.0, -40.0)  # deg, positive looks down
HEIGHTS = (0.0, 0.5, 1.0)  # m


@dataclass(frozen=True)
class LogScale:
    """A number on a logarithmic scale."""

    name: str
    base: float  # value in the base scenario
    low: float
    high: float
    unit: str = ""
    whole: bool = False

    @property
    def plain(self) -> float:
        """The value of the base, or the nearest one within the bounds."""
        return self._number(min(max(self.base, self.low), self.high))

    def at(self, u: float) -> float:
        """Value at ``u`` in [0, 1], rounded to a few digits."""
        value = self.low * (self.high / self.low) ** u
        return self._number(min(max(float(f"{value:.{DIGITS}g}"), self.low), self.high))

    def where(self, value: Value) -> float:
        """Place of a value in [0, 1]."""
        width = np.log(self.high / self.low)
        return float(np.log(float(value) / self.low) / width) if width > 0 else 0.0

    def within(self, text: str) -> LogScale:
        """The dimension with the bounds ``LOW:HIGH``, or fixed at ``VALUE``."""
        try:
            low, high = (self._number(float(part)) for part in (text.split(":") if ":" in text else (text, text)))
        except (ValueError, OverflowError):
            raise self._refused(text) from None
        if not 0.0 < low <= high < np.inf:
            raise self._refused(text)
        return replace(self, low=low, high=high)

    def text(self, value: Value) -> str:
        """A value with its unit."""
        return f"{value:g}{self.unit}"

    def _number(self, value: float) -> float:
        return round(value) if self.whole else value

    def _refused(self, text: str) -> InputError:
        return InputError(
            f"--within {self.name}={text}: give bounds as {self.name}=LOW:HIGH, positive numbers with low <= high"
        )


@dataclass(frozen=True)
class Choice:
    """One of a few values that have no order."""

    name: str
    base: Value
    values: tuple[Value, ...]
    unit: str = ""

    @property
    def plain(self) -> Value:
        """The value of the base, or the first of those that are left."""
        return self.base if self.base in self.values else self.values[0]

    def at(self, u: float) -> Value:
        return self.values[min(int(u * len(self.values)), len(self.values) - 1)]

    def where(self, value: Value) -> float:
        return (self.values.index(value) + 0.5) / len(self.values)

    def within(self, text: str) -> Choice:
        """The dimension with fewer values, ``A,B``."""
        values_by_text = {_text(value): value for value in self.values}
        chosen_values = [part.strip() for part in text.split(",")]
        if unknown_values := [part for part in chosen_values if part not in values_by_text]:
            names = list(values_by_text)
            if len(names) > len(SHAPES) + 1:
                names = [*names[:3], "...", names[-1]]
            raise InputError(
                f"--within {self.name}={text}: '{unknown_values[0]}' is not one of its values; choose from "
                f"{', '.join(names)}"
            )
        return replace(self, values=tuple(values_by_text[part] for part in dict.fromkeys(chosen_values)))

    def text(self, value: Value) -> str:
        return f"{_text(value)}{self.unit}"


def _text(value: Value) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)


Dimension = LogScale | Choice


@dataclass(frozen=True)
class Space:
    """Worlds that differ from ``base`` in some of the ``dimensions``."""

    base: Scenario
    dimensions: tuple[Dimension, ...]

    @property
    def plain(self) -> Point:
        """The point of the base, or the one nearest to it within the bounds."""
        return tuple(d.plain for d in self.dimensions)

    def at(self, u: Array) -> Point:
        """Point at ``u`` (number of dimensions,) in [0, 1]."""
        return tuple(d.at(float(x)) for d, x in zip(self.dimensions, u, strict=True))

    def where(self, point: Point) -> Array:
        """Place of a point in the unit cube, (number of dimensions,)."""
        return np.array([d.where(value) for d, value in zip(self.dimensions, point, strict=True)])

    def world(self, point: Point, name: str = "world") -> Scenario:
        """The scenario of a point.

        Raises
        ------
        ValueError
            There is no such world: the scenario is refused.
        """
        values = {d.name: value for d, value in self._differences(point)}
        changes = _landmark_changes(self.base, values)
        for dimension, changes_of in CHANGES.items():
            if dimension in values:
                changes |= changes_of(self.base, values[dimension])
        return with_changes(self.base, name, self.text(point), changes)

    def text(self, point: Point) -> str:
        """What of a point differs from the base, in words."""
        parts = [f"{d.name} {d.text(value)} instead of {d.text(d.base)}" for d, value in self._differences(point)]
        return f"{self.base.name} with {', '.join(parts)}" if parts else f"{self.base.name} as it is"

    def _differences(self, point: Point) -> list[tuple[Dimension, Value]]:
        pairs = zip(self.dimensions, point, strict=True)
        return [(dimension, value) for dimension, value in pairs if value != dimension.base]

    def values(self, point: Point) -> dict[str, Value]:
        return {d.name: value for d, value in zip(self.dimensions, point, strict=True)}


def space_of(base: Scenario, within: Sequence[str] = ()) -> Space:
    """The worlds around a scenario.

    Parameters
    ----------
    within : bounds of some dimensions: ``NAME=LOW:HIGH``, ``NAME=A,B`` where values have no order, or ``NAME=VALUE``;
        or the path of a TOML file of such bounds, as ``range = [2.0, 8.0]``, ``path = "circle"``, ``tilt = 40``

    Raises
    ------
    InputError
        The belief of the base is not right, or bounds mean nothing.
    """
    require_right_belief(base)
    dimensions = {d.name: d for d in _dimensions(base)}
    bounds: list[str] = []
    for bound in within:
        bounds += _bounds_of_file(bound) if bound.endswith(".toml") else [bound]
    for bound in bounds:
        name, separator, values = bound.partition("=")
        if name not in dimensions or not separator:
            raise InputError(f"--within {bound}: give it as NAME=LOW:HIGH with a NAME out of {', '.join(dimensions)}")
        dimensions[name] = dimensions[name].within(values)
    return Space(base, tuple(dimensions.values()))


def _bounds_of_file(path: str) -> list[str]:
    """Bounds of a file as they are typed: an array of two numbers that are not a choice is LOW:HIGH."""
    bounds = []
    for name, value in read_toml(Path(path)).items():
        items = value if isinstance(value, list) else [value]
        if not items or not all(isinstance(each, int | float | str) for each in items):
            raise InputError(f"{path}: key '{name}': give a value, [LOW, HIGH], or an array of values")
        separator = ":" if name in FACTORS and len(items) == 2 else ","
        bounds.append(f"{name}={separator.join(map(_text, items))}")
    return bounds


def require_right_belief(base: Scenario) -> None:
    """Refuse a scenario whose belief is wrong: a filter that is told wrong noise may be overconfident by no fault.

    Raises
    ------
    InputError
        A key of the belief differs from that of the truth, or the sensor errs in a way that no belief holds.
    """
    if wrong := misbelief(base):
        raise InputError(f"scenario '{base.name}': {wrong}, for only the filter's own approximation is challenged")


def _dimensions(base: Scenario) -> list[Dimension]:
    """Return the dimensions in which a world may differ from the base."""
    truth = base.truth
    is_uniform, has_laps = isinstance(truth.landmarks, UniformLandmarks), truth.path.shape in SHAPES
    dimensions: list[Dimension] = []
    if isinstance(truth.landmarks, UniformLandmarks):
        dimensions.append(_choice("seed", truth.landmarks.seed, range(SEEDS)))
    dimensions.append(_scale("sensor", 1.0, "x"))
    if truth.motion.sigma_v > 0 or truth.motion.sigma_omega > 0:
        dimensions.append(_scale("odometry", 1.0, "x"))
    dimensions.append(_scale("steps", truth.steps, whole=True))
    if is_uniform:
        dimensions.append(_choice("path", truth.path.shape, SHAPES))
    if is_uniform and has_laps:
        dimensions.append(_scale("lap", 1.0, "x"))
    if is_uniform:
        dimensions.append(_scale("density", 1.0, "x"))
    dimensions.append(_scale("dt", truth.dt, " s"))
    if isinstance(truth.sensor, UvdSensor):
        (_, _, z), (_, pitch, _) = truth.sensor.mount.position, truth.sensor.mount.rotation
        dimensions.append(_choice("tilt", round(float(np.rad2deg(pitch)), 6), TILTS, " deg"))
        dimensions.append(_choice("height", z, HEIGHTS, " m"))
        dimensions.append(_scale("baseline", truth.sensor.B, " m"))
    dimensions.append(_scale("range", truth.sensor.range[1], " m"))
    return dimensions


def _scale(name: str, base: float, unit: str = "", whole: bool = False) -> LogScale:
    low, high = (float(f"{factor * base:.{DIGITS}g}") for factor in FACTORS[name])
    if whole:
        low, high = max(1, round(low)), round(high)
    return LogScale(name, base, low, high, unit, whole)


def _choice(name: str, base: Value, values: Sequence[Value], unit: str = "") -> Choice:
    return Choice(name, base, (base, *(value for value in values if value != base)), unit)


# --- from values to keys of a scenario -----------------------------------------------------------------


# what a value changes, in truth and belief alike; path, lap, density and seed change the landmarks together
CHANGES: dict[str, Callable[[Scenario, Any], Changes]] = {
    "odometry": odometry_changes,
    "sensor": lambda base, factor: in_both("sensor.sigma", tuple(factor * s for s in base.truth.sensor.sigma)),
    "steps": lambda base, steps: {"truth.steps": int(steps)},
    "dt": lambda base, dt: {"truth.dt": dt},
    "tilt": tilt_changes,
    "height": height_changes,
    "range": range_changes,
    "baseline": baseline_changes,
}


def _landmark_changes(base: Scenario, values: Mapping[str, Value]) -> Changes:
    """Path and landmarks: as dense as in the base times ``density``, as far beyond the path as there."""
    landmarks, changes = base.truth.landmarks, Changes()
    if not isinstance(landmarks, UniformLandmarks):
        return changes
    count: float = landmarks.count
    if "path" in values or "lap" in values:
        shape = str(values.get("path", base.truth.path.shape))
        path, x, y, count = course_of(base.truth, shape, float(values.get("lap", 1.0)))
        changes |= {"truth.path": path.model_dump(), "truth.landmarks.x": x, "truth.landmarks.y": y}
    changes["truth.landmarks.count"] = max(1, round(count * float(values.get("density", 1.0))))
    if "seed" in values:
        changes["truth.landmarks.seed"] = int(values["seed"])
    return changes
