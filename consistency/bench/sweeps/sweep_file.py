"""A sweep's file: the world it starts from, the axes of its grid, the filters and the rule; expanded to cells."""

from __future__ import annotations

import hashlib
import itertools
import json
import math
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field, field_validator

from consistency.bench.filters.run_filter import resolve_filters
from consistency.bench.runs.montecarlo import plan_of
from consistency.bench.scenario import (
    Count,
    Positive,
    Scenario,
    Table,
    UniformLandmarks,
    UvdSensor,
    data_folder,
    explain,
    load_scenario,
    read_table,
)
from consistency.bench.scenario.truth_and_belief import unknown, with_changes
from consistency.bench.simulation import (
    Changes,
    baseline_changes,
    course_of,
    height_changes,
    in_both,
    odometry_changes,
    range_changes,
    tilt_changes,
)
from consistency.referee.column_names import POSE
from consistency.referee.defaults import DETECT, POWER
from consistency.referee.errors import InputError
from consistency.referee.parsing import HUGE

MOST_CELLS = 20_000  # each is a scenario in memory, and a folder
LONGEST = 150  # characters of a folder's name
REFERENCE = {"uvd": "ekf-uvd", "xyz": "ekf-xyz", "linear": "kf"}  # filter whose step costs 1, by the sensor's model
BOTH = ("sensor", "motion")  # tables that truth and belief both have: a key of one is set in both


class StoppingRule(Table):
    """When a cell is decided; the keys are those of ``consistency run --until-decided``."""

    false_alarm: Positive = 0.01
    detect: Positive = DETECT
    power: Positive = POWER
    max_runs: Count = 192


class SweepFile(Table):
    summary: str
    base: str  # name or path of a scenario
    filters: Annotated[list[str], Field(min_length=1)]
    seed: Annotated[int, Field(ge=0, strict=True)] = 0
    rule: StoppingRule = StoppingRule()
    grid: dict[str, Any] = Field(default_factory=dict)
    alone: dict[str, Any] = Field(default_factory=dict)  # each from the base's value, at every point of the grid

    @field_validator("grid", "alone")
    @classmethod
    def _flat(cls, grid: dict[str, Any]) -> dict[str, Any]:
        """``truth.path.speed = [...]`` may stand with or without quotes."""
        return dict(leaves(grid))


@dataclass(frozen=True)
class Cell:
    number: int  # 0, 1, ... in the order of :func:`grid_points`
    indices: tuple[int, ...]  # place on each axis
    name: str  # of its folder
    text: str  # "baseline 0.09 m, range 4 m"
    scenario: Scenario


@dataclass(frozen=True)
class Sweep:
    """Scenarios, filters, and the rule by which each filter is judged in each of them.

    The scenarios are those of a grid, and at each of its points those in which one more axis has another value.
    """

    name: str
    summary: str
    base: Scenario
    axes: tuple[Axis, ...]
    filters: tuple[str, ...]
    seed: int
    rule: StoppingRule

    @property
    def grid(self) -> tuple[Axis, ...]:
        """Axes whose values are combined."""
        return tuple(axis for axis in self.axes if axis.home is None)

    @property
    def alone(self) -> tuple[Axis, ...]:
        """Axes that vary one at a time."""
        return tuple(axis for axis in self.axes if axis.home is not None)

    @cached_property
    def cells(self) -> tuple[Cell, ...]:
        """Every cell, in the order of :func:`grid_points`; raises ValueError where a scenario is refused."""
        cells = []
        for number, at in enumerate(grid_points(self.axes)):
            changes: dict[str, Any] = {}
            for axis, i in _changed(self.axes, at):
                changes |= axis.changes(self.base, axis.values[i])
            name, text = _folder_name(self.axes, at), text_of(self.axes, at)
            scenario = with_changes(self.base, name, f"{self.base.name}, {text}", changes)
            cells.append(Cell(number, at, name, text, scenario))
        return tuple(cells)

    @property
    def reference(self) -> str:
        """The filter whose step costs 1."""
        return REFERENCE[self.base.belief.sensor.model]

    def seed_of(self, cell: Cell) -> int:
        """The cell's own seed: its trials depend on its scenario, not on its place or on other cells."""
        digest = hashlib.sha256(f"{self.seed} {cell.scenario.hash}".encode()).digest()
        return int.from_bytes(digest[:4], "big")


def grid_points(axes: Sequence[Axis]) -> Iterator[tuple[int, ...]]:
    """Places on all axes: those of the grid, the last axis fastest, each with the values of one more axis alone."""
    choices = [range(len(axis.values)) if axis.home is None else (axis.home,) for axis in axes]
    for grid_point in itertools.product(*choices):
        yield grid_point
        for k, axis in enumerate(axes):
            for i in range(len(axis.values)):
                if axis.home not in (None, i):
                    yield (*grid_point[:k], i, *grid_point[k + 1 :])


def number_of_points(axes: Sequence[Axis]) -> int:
    grid_points, values_alone = 1, 0
    for axis in axes:
        if axis.home is None:
            grid_points *= len(axis.values)
        else:
            values_alone += len(axis.values) - 1
    return grid_points * (1 + values_alone)


def values_of(sweep: Sweep, axes: Sequence[Axis], cell: Cell) -> list[str]:
    """A cell's values on some axes, and in a sweep with axes that vary alone what of the cell does."""
    axis_places = [cell.indices[sweep.axes.index(axis)] for axis in (*axes, *sweep.alone)]
    alone_text = [text_of(sweep.alone, axis_places[len(axes) :])] if sweep.alone else []
    return [*map(Axis.say, axes, axis_places), *alone_text]


def _changed(axes: Sequence[Axis], at: Sequence[int]) -> list[tuple[Axis, int]]:
    """Axes at which a cell is not the base by definition, with its place there."""
    return [(axis, i) for axis, i in zip(axes, at, strict=True) if i != axis.home]


def text_of(axes: Sequence[Axis], at: Sequence[int]) -> str:
    """A place in words, without axes on which it is that of the base."""
    return ", ".join(f"{axis.text} {axis.say(i)}" for axis, i in _changed(axes, at)) or "the base"


def _folder_name(axes: Sequence[Axis], at: Sequence[int]) -> str:
    folder_parts = []
    for axis, i in _changed(axes, at):
        value = axis.values[i]
        value_text = f"{value:.12g}" if isinstance(value, float) else str(value)
        folder_parts.append(f"{axis.key}-{re.sub(r'[^A-Za-z0-9.+-]+', '_', value_text).strip('_')}")
    name = "_".join(folder_parts) or "base"
    return name if len(name) <= LONGEST else f"{name[:LONGEST]}-{hashlib.sha256(name.encode()).hexdigest()[:8]}"


# --- reading ----------------------------------------------------------------------------------------


def _shipped() -> Path:
    return data_folder("experiments") / "sweeps"


def sweep_names() -> list[str]:
    return sorted(path.stem for path in _shipped().glob("*.toml"))


def load_sweep(name: str | Path, filters: Sequence[str] | None = None) -> Sweep:
    """A sweep by built-in name or by path to a ``.toml`` file, every cell checked.

    Parameters
    ----------
    filters : in place of those of the file

    Raises
    ------
    InputError
        Unknown name, unreadable file, unknown key, a value that a cell may not have, a filter that does not fit.
    """
    path = Path(name)
    if str(name) in sweep_names():
        path = _shipped() / f"{name}.toml"
    elif path.suffix != ".toml":
        raise InputError(f"{unknown('sweep', str(name), sweep_names())}; or give a .toml file or a folder of 'sweep'")
    file = read_table(path, SweepFile)
    try:
        beside = path.parent / file.base
        base = load_scenario(beside if file.base.endswith(".toml") else file.base)
        if filters:
            file = file.model_copy(update={"filters": list(filters)})
        sweep = sweep_of(path.stem, file, base)
        plan_of(sweep.rule.model_dump() | {"dof": len(POSE)})
        resolve_filters(sweep.filters, sweep.base.belief)
        _require_cells(sweep)
    except InputError as error:
        raise InputError(f"{path}: {str(error).removeprefix(f'{path}: ')}") from None
    return sweep


def sweep_of(name: str, file: SweepFile, base: Scenario) -> Sweep:
    """Expand the content of a sweep's file; the cells are made when they are asked for.

    Raises
    ------
    InputError
        A key of no scenario, a value that may not be, or too many cells.
    """
    if not (file.grid or file.alone):
        raise InputError("key 'grid': missing; give it axes, or a table 'alone' of axes that vary one at a time")
    if both := [key for key in file.grid if key in file.alone]:
        raise InputError(f"key 'alone.{both[0]}': stands in 'grid', too; leave one of them out")
    axes = [_axis("grid", key, values, base) for key, values in file.grid.items()]
    axes += [_axis("alone", key, values, base) for key, values in file.alone.items()]
    count = number_of_points(axes)
    if count > MOST_CELLS:
        raise InputError(f"key 'grid': makes {count} cells; at most {MOST_CELLS}, so take fewer values, or two sweeps")
    return Sweep(name, file.summary, base, tuple(axes), tuple(file.filters), file.seed, file.rule)


def _axis(table: str, key: str, values: Any, base: Scenario) -> Axis:
    name = f"key '{table}.{key}'"
    if not isinstance(values, list) or not values:
        raise InputError(f"{name}: must be a list of one value or more, got {values!r}")
    if any(values.count(value) > 1 for value in values):
        raise InputError(f"{name}: a value is given twice; each may stand once")
    for value in values:
        if key in QUANTITIES:
            low, kind = (0.0, "positive numbers") if QUANTITIES[key].positive else (-math.inf, "numbers")
            if not is_number(value) or not low < value < math.inf:
                raise InputError(f"{name}: values must be {kind}, got {value!r}")
        if is_number(value) and not -HUGE <= value <= HUGE:
            raise InputError(f"{name}: numbers must be finite, and {HUGE:g} at most")
    if all(map(is_number, values)):
        is_whole = all(isinstance(value, int) for value in values)
        values = sorted(values if is_whole else map(float, values))
    axis = Axis(key, tuple(values), None if table == "grid" else 0)
    require_key(axis, base)
    return axis if table == "grid" else alone(axis, base)


def alone(axis: Axis, base: Scenario) -> Axis:
    """The axis with the base's own value among its values, from which it varies.

    Raises
    ------
    InputError
        The base has no such value.
    """
    base_value = axis.own(base)
    if base_value is None or base_value != base_value:
        raise InputError(f"key 'alone.{axis.key}': {base.name} has no value there to start from; use 'grid'")
    values = axis.values if base_value in axis.values else (base_value, *axis.values)
    if all(map(is_number, values)):
        values = tuple(sorted(values))
    return Axis(axis.key, values, values.index(base_value))


def _require_cells(sweep: Sweep) -> None:
    """Check every value alone, so that the message names its key; then every cell, and a folder's name for each."""
    axis_by_key: dict[str, str] = {}
    for axis in sweep.axes:
        keys = _keys_of(axis, sweep.base)
        for key in keys:
            if key in axis_by_key:
                both = f"'grid.{axis_by_key[key]}' and '{axis.table}.{axis.key}'"
                raise InputError(f"keys {both} both set {key}; leave one of them out")
        if axis.home is None:  # axes that vary alone never meet
            axis_by_key |= dict.fromkeys(keys, axis.key)
    try:
        names = Counter(cell.name for cell in sweep.cells)
    except ValueError as error:
        raise InputError(f"key 'grid': some values do not go together: {explain(error, Scenario)}") from None
    name, cells_of_name = names.most_common(1)[0]
    if cells_of_name > 1:
        raise InputError(f"key 'grid': two values are too much alike to be told apart ({name})")


def _keys_of(axis: Axis, base: Scenario) -> list[str]:
    """Keys of the scenario that an axis sets; each of its values is tried in the base."""
    scenario_keys: list[str] = []
    for value in axis.values:
        try:
            changes = axis.changes(base, value)
            with_changes(base, base.name, "", changes)
        except ValueError as error:
            text = explain(error, Scenario)
            raise InputError(f"key '{axis.table}.{axis.key}', value {value!r}: {text}") from None
        scenario_keys = list(changes)
    return scenario_keys


@dataclass(frozen=True)
class Quantity:
    """A named axis, which changes several keys of a scenario together; its values are numbers."""

    text: str
    unit: str  # m, m/s; × for a multiple of what the base has
    changes: Callable[[Scenario, float], Changes]
    own: Callable[[Scenario], float] = lambda base: 1.0  # value of the base; NaN where it has none
    positive: bool = True  # whether values must be


def _density_changes(base: Scenario, value: float) -> Changes:
    landmarks = base.truth.landmarks
    if not isinstance(landmarks, UniformLandmarks):
        raise ValueError("needs truth.landmarks.layout = 'uniform', whose count it multiplies")
    return {"truth.landmarks.count": max(1, round(landmarks.count * value))}


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
    "baseline": Quantity("baseline", "m", baseline_changes, lambda base: (base.truth.sensor.rig or (0.0, np.nan))[1]),
    "range": Quantity("range of landmarks", "m", range_changes, lambda base: float(base.truth.sensor.range[1])),
    "density": Quantity("density of landmarks", "×", _density_changes),
    "odometry": Quantity("noise of the odometry", "×", odometry_changes),
    "speed": Quantity("speed", "m/s", lambda _, value: {"truth.path.speed": value}, lambda base: base.truth.path.speed),
    "dt": Quantity(
        "time of a step",
        "s",
        # fewer steps where each is longer, so that the drive stays
        lambda base, dt: {"truth.dt": dt, "truth.steps": max(1, round(base.truth.steps * base.truth.dt / dt))},
        lambda base: base.truth.dt,
    ),
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
    def short(self) -> str:
        """Last part of the key."""
        return self.key.rpartition(".")[2]

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
