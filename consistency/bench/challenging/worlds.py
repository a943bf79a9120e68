"""The space of worlds around a base scenario: a few dimensions, each with bounds and the value of the base."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from consistency.bench.scenario import Scenario, Truth, UniformLandmarks, UvdSensor, misbelief
from consistency.bench.simulation.variation import SHAPES, course_of, mount_of
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
        known = {_text(value): value for value in self.values}
        parts = [part.strip() for part in text.split(",")]
        if unknown := [part for part in parts if part not in known]:
            some = list(known) if len(known) <= len(SHAPES) + 1 else [*list(known)[:3], "...", list(known)[-1]]
            raise InputError(
                f"--within {self.name}={text}: '{unknown[0]}' is not one of its values; choose from {', '.join(some)}"
            )
        return replace(self, values=tuple(known[part] for part in dict.fromkeys(parts)))

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

    def world(self, point: Point, name: str = "world", summary: str = "") -> Scenario:
        """The scenario of a point.

        Raises
        ------
        ValueError
            There is no such world: the scenario is refused.
        """
        values = {d.name: value for d, value in zip(self.dimensions, point, strict=True) if value != d.base}
        return self.base.variant(name, summary=summary or self.text(point), **_changes(self.base, values))

    def text(self, point: Point) -> str:
        """What of a point differs from the base, in words."""
        parts = [
            f"{d.name} {d.text(value)} instead of {d.text(d.base)}"
            for d, value in zip(self.dimensions, point, strict=True)
            if value != d.base
        ]
        return f"{self.base.name} with {', '.join(parts)}" if parts else f"{self.base.name} as it is"

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
    for text in itertools.chain.from_iterable(_bounds_of(w) if w.endswith(".toml") else [w] for w in within):
        name, separator, bounds = text.partition("=")
        if name not in dimensions or not separator:
            raise InputError(f"--within {text}: give it as NAME=LOW:HIGH with a NAME out of {', '.join(dimensions)}")
        dimensions[name] = dimensions[name].within(bounds)
    return Space(base, tuple(dimensions.values()))


def _bounds_of(path: str) -> list[str]:
    """Bounds of a file as they are typed: an array of two numbers that are not a choice is LOW:HIGH."""
    bounds = []
    for name, value in read_toml(Path(path)).items():
        items = value if isinstance(value, list) else [value]
        if not items or not all(isinstance(each, int | float | str) for each in items):
            raise InputError(f"{path}: key '{name}': give a value, [LOW, HIGH], or an array of values")
        between = name in FACTORS and len(items) == 2
        bounds.append(f"{name}={(':' if between else ',').join(_text(each) for each in items)}")
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
    found: list[Dimension] = []
    if isinstance(truth.landmarks, UniformLandmarks):
        found += [_choice("seed", truth.landmarks.seed, range(SEEDS))]
    found += [_scale("sensor", 1.0, "x")]
    if truth.motion.sigma_v > 0 or truth.motion.sigma_omega > 0:
        found += [_scale("odometry", 1.0, "x")]
    found += [_scale("steps", truth.steps, whole=True)]
    if isinstance(truth.landmarks, UniformLandmarks):
        own = truth.path.shape
        found += [_choice("path", own, SHAPES)]
        found += [_scale("lap", 1.0, "x")] if own in SHAPES else []
        found += [_scale("density", 1.0, "x")]
    found += [_scale("dt", truth.dt, " s")]
    if isinstance(truth.sensor, UvdSensor):
        (_, _, z), (_, pitch, _) = truth.sensor.mount.position, truth.sensor.mount.rotation
        pitch = round(float(np.rad2deg(pitch)), 6)
        found += [_choice("tilt", pitch, TILTS, " deg"), _choice("height", z, HEIGHTS, " m")]
        found += [_scale("baseline", truth.sensor.B, " m")]
    return [*found, _scale("range", truth.sensor.range[1], " m")]


def _scale(name: str, base: float, unit: str = "", whole: bool = False) -> LogScale:
    low, high = (float(f"{factor * base:.{DIGITS}g}") for factor in FACTORS[name])
    return LogScale(name, base, max(1, round(low)) if whole else low, round(high) if whole else high, unit, whole)


def _choice(name: str, base: Value, values: Sequence[Value], unit: str = "") -> Choice:
    return Choice(name, base, (base, *(value for value in values if value != base)), unit)


# --- from values to keys of a scenario -----------------------------------------------------------------


def _changes(base: Scenario, values: Mapping[str, Value]) -> dict[str, Any]:
    """Keys of the scenario that change, in truth and belief alike."""
    truth, changes = base.truth, _landmarks(base.truth, values)
    for key in ("sigma_v", "sigma_omega") if "odometry" in values else ():
        sigma = float(values["odometry"]) * getattr(truth.motion, key)
        changes |= {f"{half}__motion__{key}": sigma for half in ("truth", "belief")}
    if "sensor" in values:
        sigmas = tuple(float(values["sensor"]) * sigma for sigma in truth.sensor.sigma)
        changes |= {f"{half}__sensor__sigma": sigmas for half in ("truth", "belief")}
    if "steps" in values:
        changes["truth__steps"] = int(values["steps"])
    if "dt" in values:
        changes["truth__dt"] = float(values["dt"])
    if "tilt" in values or "height" in values:
        tilt, height = (float(values[name]) if name in values else None for name in ("tilt", "height"))
        mount = mount_of(truth.sensor, tilt, height)
        changes |= {f"{half}__sensor__mount": mount for half in ("truth", "belief")}
    if "range" in values:
        changes["truth__sensor__range"] = (truth.sensor.range[0], float(values["range"]))
    if "baseline" in values and isinstance(truth.sensor, UvdSensor):
        B = float(values["baseline"])
        low, high = truth.sensor.disparity
        search = (low, round(high * B / truth.sensor.B, 1))  # the nearest depth stays
        changes |= {f"{half}__sensor__B": B for half in ("truth", "belief")}
        halves = ("truth",) if base.belief.sensor.disparity is None else ("truth", "belief")
        changes |= {f"{half}__sensor__disparity": search for half in halves}
    return changes


def _landmarks(truth: Truth, values: Mapping[str, Value]) -> dict[str, Any]:
    """Path and landmarks: as dense as in the base times ``density``, as far beyond the path as there."""
    landmarks, changes = truth.landmarks, dict[str, Any]()
    if not isinstance(landmarks, UniformLandmarks):
        return changes
    count: float = landmarks.count
    if "path" in values or "lap" in values:
        shape = str(values.get("path", truth.path.shape))
        path, x, y, count = course_of(truth, shape, float(values.get("lap", 1.0)))
        changes |= {"truth__path": path.model_dump(), "truth__landmarks__x": x, "truth__landmarks__y": y}
    count = max(1, round(count * float(values.get("density", 1.0))))
    changes |= {"truth__landmarks__count": count} if count != landmarks.count else {}
    return changes | ({"truth__landmarks__seed": int(values["seed"])} if "seed" in values else {})
