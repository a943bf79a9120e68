"""Axes of a grid: what a value of each changes in a scenario, and the value that the base has."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from consistency.bench.scenario import Scenario, UniformLandmarks, UvdSensor
from consistency.bench.simulation.scenario_changes import (
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

BOTH = ("sensor", "motion")  # tables that truth and belief both have: a key of one is set in both


@dataclass(frozen=True)
class Quantity:
    """A named axis, which changes several keys of a scenario together; its values are numbers."""

    text: str
    unit: str  # m, m/s; × for a multiple of what the base has
    changes: Callable[[Scenario, float], Changes]
    own: Callable[[Scenario], float] = lambda base: 1.0  # value of the base; NaN where it has none
    positive: bool = True  # whether values must be


def _baseline(base: Scenario) -> float:
    return np.nan if base.truth.sensor.rig is None else base.truth.sensor.rig[1]


def _density_changes(base: Scenario, value: float) -> Changes:
    landmarks = base.truth.landmarks
    if not isinstance(landmarks, UniformLandmarks):
        raise ValueError("needs truth.landmarks.layout = 'uniform', whose count it multiplies")
    return {"truth.landmarks.count": max(1, round(landmarks.count * value))}


def _interval_changes(base: Scenario, value: float) -> Changes:
    """Fewer steps where each is longer, so that the drive stays."""
    return {"truth.dt": value, "truth.steps": max(1, round(base.truth.steps * base.truth.dt / value))}


def _tilt(base: Scenario) -> float:
    sensor = base.truth.sensor
    return float(np.rad2deg(sensor.mount.rotation[1])) if isinstance(sensor, UvdSensor) else np.nan


def _height(base: Scenario) -> float:
    sensor = base.truth.sensor
    return sensor.mount.position[2] if isinstance(sensor, UvdSensor) else np.nan


def _loops_changes(base: Scenario, value: float) -> Changes:
    """A shorter lap of the same shape, of which the same steps make more."""
    course = course_of(base.truth, base.truth.path.shape, 1.0 / value)
    changes: Changes = {}
    for key, part in course.path.model_dump(exclude={"shape", "speed"}).items():
        changes[f"truth.path.{key}"] = part
    changes["truth.landmarks.x"], changes["truth.landmarks.y"] = course.x, course.y
    changes["truth.landmarks.count"] = max(1, round(course.landmarks))
    return changes


QUANTITIES: dict[str, Quantity] = {
    "baseline": Quantity("baseline", "m", baseline_changes, _baseline),
    "range": Quantity("range of landmarks", "m", range_changes, lambda base: float(base.truth.sensor.range[1])),
    "density": Quantity("density of landmarks", "×", _density_changes),
    "odometry": Quantity("noise of the odometry", "×", odometry_changes),
    "speed": Quantity("speed", "m/s", lambda _, value: {"truth.path.speed": value}, lambda base: base.truth.path.speed),
    "dt": Quantity("time of a step", "s", _interval_changes, lambda base: base.truth.dt),
    "tilt": Quantity("tilt", "deg", tilt_changes, _tilt, positive=False),
    "height": Quantity("height", "m", height_changes, _height, positive=False),
    "loops": Quantity("number of loops", "×", _loops_changes),
}


@dataclass(frozen=True)
class Axis:
    """One axis of a sweep: a named quantity or a key of the scenario, with its values in order."""

    key: str
    values: tuple[Any, ...]
    home: int | None = None  # index of the base's value, where the axis varies alone; None in a grid

    @property
    def table(self) -> str:
        """Table of the sweep's file in which it stands."""
        return "grid" if self.home is None else "alone"

    @property
    def text(self) -> str:
        return QUANTITIES[self.key].text if self.key in QUANTITIES else self.key

    @property
    def unit(self) -> str:
        return QUANTITIES[self.key].unit if self.key in QUANTITIES else ""

    @property
    def label(self) -> str:
        """For the axis of a figure or the head of a column."""
        return f"{self.text} ({self.unit})" if self.unit else self.text

    @property
    def numeric(self) -> bool:
        return all(map(is_number, self.values))

    @property
    def log(self) -> bool:
        """Whether distances are those of logarithms."""
        return self.numeric and min(self.values) > 0

    def say(self, index: int) -> str:
        """One value with its unit, as "0.09 m" or "×0.5"."""
        value_text = value = self.values[index]
        if isinstance(value, float):
            value_text = f"{value:.3g}"
        elif not isinstance(value, str):
            value_text = json.dumps(value)
        return f"×{value_text}" if self.unit == "×" else f"{value_text} {self.unit}".rstrip()

    def changes(self, base: Scenario, value: Any) -> Changes:
        """Keys of the scenario that a value sets.

        Raises
        ------
        ValueError
            The base has no such thing.
        """
        if self.key in QUANTITIES:
            return QUANTITIES[self.key].changes(base, value)
        table, _, rest = self.key.partition(".")
        return in_both(self.key, value) if table in BOTH and rest else {self.key: value}

    def own(self, base: Scenario) -> Any:
        """The value that the base has; NaN or None where it has none."""
        if self.key in QUANTITIES:
            return QUANTITIES[self.key].own(base)
        value: Any = base.model_dump(mode="json")
        for part in next(iter(self.changes(base, None))).split("."):
            value = value.get(part) if isinstance(value, Mapping) else None
        return value


def is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def require_key(axis: Axis, base: Scenario) -> None:
    """Refuse a key that no scenario has, and say what is allowed in its place."""
    if axis.key in QUANTITIES:
        return
    for key in axis.changes(base, None):
        table: Any = base.model_dump()
        for part in key.split("."):
            stem = part.rpartition("_")[0]  # a key may end in its unit
            scenario_keys = sorted(table) if isinstance(table, Mapping) else []
            if part not in scenario_keys and stem not in scenario_keys:
                allowed = f"{', '.join(QUANTITIES)}, or a key of the scenario"
                if scenario_keys and part != key.split(".")[0]:
                    allowed += f", where '{part}' could be {', '.join(scenario_keys)}"
                raise InputError(f"key '{axis.table}.{axis.key}': unknown; allowed: {allowed}")
            table = table.get(part, table.get(stem))


def leaves(table: Mapping[str, Any], path: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted key and value of all that nested tables hold."""
    for key, value in table.items():
        if isinstance(value, Mapping):
            yield from leaves(value, f"{path}{key}.")
        else:
            yield path + key, value
