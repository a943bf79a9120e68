"""Axes of a grid: what a value of each changes in a scenario, and where another scenario lies on it."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from consistency.bench.scenario import Scenario, UniformLandmarks, UvdSensor
from consistency.bench.simulation import draw_landmarks
from consistency.bench.simulation.path import lap_length
from consistency.bench.simulation.variation import course_of, mount_of
from consistency.referee.errors import InputError

Changes = dict[str, Any]  # dotted key of the scenario -> value
SAME_TIME = 0.05  # relative: a drive that takes longer or less long is another one
BOTH = ("sensor", "motion")  # tables that truth and belief both have: a key of one is set in both


@dataclass(frozen=True)
class Quantity:
    """A named axis, which changes several keys of a scenario together; its values are numbers."""

    text: str
    unit: str  # m, m/s; × for a multiple of what the base has
    changes: Callable[[Scenario, float], Changes]
    measure: Callable[[Scenario, Scenario], float]  # of a scenario beside the base; NaN where it has none
    positive: bool = True  # whether values must be


def _baseline(base: Scenario, value: float) -> Changes:
    """The largest disparity of the search grows with the baseline, so that the nearest depth stays."""
    truth, belief = base.truth.sensor, base.belief.sensor
    if truth.rig is None:
        raise ValueError(f"a sensor '{truth.model}' has no baseline")
    ratio = value / truth.rig[1]
    changes: Changes = {"truth.sensor.B": value, "belief.sensor.B": value}
    for half, sensor in (("truth", truth), ("belief", belief)):
        if (disparity := getattr(sensor, "disparity", None)) is not None:
            changes[f"{half}.sensor.disparity"] = (disparity[0], disparity[1] * ratio)
    return changes


def equivalent_baseline(scenario: Scenario, base: Scenario) -> float:
    """Baseline (m) that makes depths with the base's camera as exact as the scenario's are.

    sigma_depth = z^2 sigma_d / (f B), so that B counts with f over sigma_d; a sigma_d that grows with the disparity is
    taken in the middle of the range.
    """
    (f, B), (f_base, _) = scenario.truth.sensor.rig or (np.nan, np.nan), base.truth.sensor.rig or (np.nan, np.nan)
    return float(B * (f / _disparity_noise(scenario)) / (f_base / _disparity_noise(base)))


def _disparity_noise(scenario: Scenario) -> float:
    """Standard deviation of a disparity in px."""
    sensor = scenario.truth.sensor
    if not isinstance(sensor, UvdSensor) or sensor.disparity_growth is None:
        return sensor.sigma[2]
    middle = sensor.f * sensor.B / np.mean(sensor.range)
    return float(sensor.sigma[2] * sensor.disparity_growth.ratio_at(np.array(middle)))


def _count(base: Scenario, value: float) -> Changes:
    landmarks = base.truth.landmarks
    if not isinstance(landmarks, UniformLandmarks):
        raise ValueError("needs truth.landmarks.layout = 'uniform', whose count it multiplies")
    return {"truth.landmarks.count": max(1, round(landmarks.count * value))}


def density_of(scenario: Scenario) -> float:
    """Landmarks on a square metre of the box in which they lie."""
    landmarks = scenario.truth.landmarks
    if isinstance(landmarks, UniformLandmarks):
        area = float(np.prod([high - low for low, high in (landmarks.x, landmarks.y)]))
        return landmarks.count / area if area > 0.0 else np.nan
    points = draw_landmarks(scenario.truth)
    area = float(np.prod(np.ptp(points[:, :2], axis=0)))
    return len(points) / area if area > 0.0 else np.nan


def _odometry(base: Scenario, value: float) -> Changes:
    halves = (("truth", base.truth.motion), ("belief", base.belief.motion))
    return {
        f"{half}.motion.{key}": getattr(motion, key) * value
        for half, motion in halves
        for key in ("sigma_v", "sigma_omega")
    }


def _noise_ratio(scenario: Scenario, base: Scenario) -> float:
    """Geometric mean of both ratios of the true noise of the odometry."""
    pairs = [
        (getattr(scenario.truth.motion, key), getattr(base.truth.motion, key)) for key in ("sigma_v", "sigma_omega")
    ]
    return float(np.sqrt(np.prod([a / b if b else np.nan for a, b in pairs])))


def _mounted(base: Scenario, **place: float) -> Changes:
    """The key of the mount that a tilt or a height changes, in truth and belief."""
    key = "rotation" if "tilt" in place else "position"
    if not isinstance(base.truth.sensor, UvdSensor):
        raise ValueError(f"a sensor '{base.truth.sensor.model}' has no tilt or height")
    value = mount_of(base.truth.sensor, **place)[key]
    return {f"{half}.sensor.mount.{key}": value for half in ("truth", "belief")}


def _on_mount(key: str, index: int, scenario: Scenario, base: Scenario) -> float:
    """One number of the mount; NaN where another of the same key is not that of the base."""
    sensors = scenario.truth.sensor, base.truth.sensor
    if not all(isinstance(sensor, UvdSensor) for sensor in sensors):
        return np.nan
    own, known = ([*getattr(sensor.mount, key)] for sensor in sensors)
    value = own.pop(index)
    known.pop(index)
    return value if own == known else np.nan


def _interval(base: Scenario, value: float) -> Changes:
    """Fewer steps where each is longer, so that the way stays."""
    return {"truth.dt": value, "truth.steps": max(1, round(base.truth.steps * base.truth.dt / value))}


def _interval_of(scenario: Scenario, base: Scenario) -> float:
    """Time of a step (s), if all of them take as long as those of the base."""
    whole, known = (s.truth.steps * s.truth.dt for s in (scenario, base))
    return scenario.truth.dt if abs(whole / known - 1.0) <= SAME_TIME else np.nan


def _loops(base: Scenario, value: float) -> Changes:
    """A shorter lap of the same shape, of which the same steps make more."""
    course = course_of(base.truth, base.truth.path.shape, 1.0 / value)
    path = course.path.model_dump(exclude={"shape", "speed"})
    return {f"truth.path.{key}": value for key, value in path.items()} | {
        "truth.landmarks.x": course.x, "truth.landmarks.y": course.y,
        "truth.landmarks.count": max(1, round(course.landmarks)),
    }  # fmt: skip


def _loops_of(scenario: Scenario, base: Scenario) -> float:
    """How many laps one of the base's length holds, if they have its shape."""
    path, known = scenario.truth.path, base.truth.path
    return lap_length(known) / lap_length(path) if path.shape == known.shape else np.nan


QUANTITIES: dict[str, Quantity] = {
    "baseline": Quantity("baseline", "m", _baseline, equivalent_baseline),
    "range": Quantity(
        "range of landmarks",
        "m",
        lambda base, value: {"truth.sensor.range": (base.truth.sensor.range[0], value)},
        lambda scenario, _: float(scenario.truth.sensor.range[1]),
    ),
    "density": Quantity(
        "density of landmarks", "×", _count, lambda scenario, base: density_of(scenario) / density_of(base)
    ),
    "odometry": Quantity("noise of the odometry", "×", _odometry, _noise_ratio),
    "speed": Quantity(
        "speed", "m/s", lambda _, value: {"truth.path.speed": value}, lambda scenario, _: scenario.truth.path.speed
    ),
    "dt": Quantity("time of a step", "s", _interval, _interval_of),
    "tilt": Quantity(
        "tilt",
        "deg",
        lambda base, value: _mounted(base, tilt=value),
        lambda *both: float(np.rad2deg(_on_mount("rotation", 1, *both))),
        positive=False,
    ),
    "height": Quantity(
        "height",
        "m",
        lambda base, value: _mounted(base, height=value),
        partial(_on_mount, "position", 2),
        positive=False,
    ),
    "loops": Quantity("number of loops", "×", _loops, _loops_of),
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
        return all(isinstance(value, int | float) and not isinstance(value, bool) for value in self.values)

    @property
    def log(self) -> bool:
        """Whether distances are those of logarithms."""
        return self.numeric and min(self.values) > 0

    def say(self, index: int) -> str:
        """One value with its unit, as "0.09 m" or "x0.5"."""
        return say_value(self.unit, self.values[index])

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
        return (
            {f"{half}.{self.key}": value for half in ("truth", "belief")}
            if table in BOTH and rest
            else {self.key: value}
        )

    def of(self, scenario: Scenario, base: Scenario) -> Any:
        """The value that another scenario has; NaN or None where it has none."""
        if self.key in QUANTITIES:
            return QUANTITIES[self.key].measure(scenario, base)
        value: Any = scenario.model_dump(mode="json")
        for part in next(iter(self.changes(base, None))).split("."):
            value = value.get(part) if isinstance(value, Mapping) else None
        return value


def say_value(unit: str, value: Any) -> str:
    text = f"{value:.3g}" if isinstance(value, float) else value if isinstance(value, str) else json.dumps(value)
    return f"×{text}" if unit == "×" else f"{text} {unit}".rstrip()


def require_key(axis: Axis, base: Scenario) -> None:
    """Refuse a key that no scenario has, and say what is allowed in its place."""
    if axis.key in QUANTITIES:
        return
    for key in axis.changes(base, None):
        table: Any = base.model_dump()
        for part in key.split("."):
            stem = part.rpartition("_")[0]  # a key may end in its unit
            if not isinstance(table, Mapping) or (part not in table and stem not in table):
                known = sorted(table) if isinstance(table, Mapping) else []
                allowed = f"{', '.join(QUANTITIES)}, or a key of the scenario"
                beside = f", where '{part}' could be {', '.join(known)}" if known and part != key.split(".")[0] else ""
                raise InputError(f"key '{axis.table}.{axis.key}': unknown; allowed: {allowed}{beside}")
            table = table.get(part, table.get(stem))


def leaves(table: Mapping[str, Any], path: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted key and value of all that nested tables hold."""
    for key, value in table.items():
        if isinstance(value, Mapping):
            yield from leaves(value, f"{path}{key}.")
        else:
            yield path + key, value
