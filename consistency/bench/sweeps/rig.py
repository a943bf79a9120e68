"""The rig that advice is asked for: a scenario, or a sensor's file put into the world of a map; and its place there."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from consistency.bench.scenario import ListedEffect, LocalBias, Scenario, UvdSensor, explain, load_scenario, read_table
from consistency.bench.scenario.scenario import with_changes
from consistency.bench.store.log import SensorFile
from consistency.bench.sweeps.axes import QUANTITIES, Axis, Changes, density_of, leaves, say_value
from consistency.bench.sweeps.plan import Cell, Sweep
from consistency.referee.errors import InputError
from consistency.referee.parsing import read_toml

AT = 0.05  # of a grid step: nearer to a value of the grid than that is at it
ALIKE = 0.02  # relative: an end of the map, or a baseline, that differs less is the same


@dataclass(frozen=True)
class Request:
    """What is asked: a rig, and what is not said there."""

    rig: str  # scenario by name or path, or path of a sensor.toml
    range: float | None = None  # m
    speed: float | None = None  # m/s
    density: float | None = None  # landmarks a square metre
    dt: float | None = None  # s from step to step


@dataclass(frozen=True)
class Rig:
    name: str
    scenario: Scenario
    assumed: tuple[str, ...]  # what was taken from the map's world


def read_rig(request: Request, base: Scenario) -> Rig:
    """The rig that a request names; what a sensor's file does not say is that of ``base``.

    Raises
    ------
    InputError
        Unreadable, of another sensor than the map's, or an option that cannot be.
    """
    path = Path(request.rig)
    sensor = path.suffix == ".toml" and _is_sensor(path)
    rig = _from_sensor(path, base, request) if sensor else Rig(request.rig, load_scenario(request.rig), ())
    model, known = rig.scenario.truth.sensor.model, base.truth.sensor.model
    if model != known:
        raise InputError(
            f"{request.rig}: measures '{model}', the map is of sensors '{known}'; judge it by itself with "
            f"'consistency run {request.rig} --filter F --until-decided', or give another --map"
        )
    return Rig(rig.name, _with_options(rig.scenario, request), rig.assumed)


def _is_sensor(path: Path) -> bool:
    """A file that says a sensor's model at its top; what cannot be read is left to who reads it."""
    try:
        return "model" in read_toml(path)
    except InputError:
        return False


def _from_sensor(path: Path, base: Scenario, request: Request) -> Rig:
    """The sensor of a log in the map's world; truth and belief are alike."""
    file, camera = read_table(path, SensorFile), base.truth.sensor
    if file.model != camera.model or not isinstance(camera, UvdSensor):
        raise InputError(f"{path}: key 'model' is '{file.model}', the map is of sensors '{camera.model}'")
    assert file.f is not None
    assert file.B is not None
    f, B = camera.rig
    assumed = [f"path and landmarks of {base.name}"]
    image, disparity, motion = file.image, file.disparity, file.motion or base.belief.motion
    if file.motion is None:
        assumed.append(f"odometry noise of {base.name}")
    if image is None and camera.image is not None:
        width, height = (round(pixels * file.f / f) for pixels in camera.image)
        image = (width, height)
        assumed.append(f"image {width} x {height} px")
    if disparity is None:
        low, high = camera.disparity
        disparity = (low, high * file.f * file.B / (f * B))
        assumed.append(f"disparities {low:g} to {disparity[1]:.0f} px")
    texts = {
        "range": f"landmarks up to {camera.range[1]:g} m", "speed": f"speed {base.truth.path.speed:g} m/s",
        "density": f"{density_of(base):.2g} landmarks a square metre", "dt": f"time of a step {base.truth.dt:g} s",
    }  # fmt: skip
    assumed += [f"{text} (--{option})" for option, text in texts.items() if getattr(request, option) is None]
    changes: Changes = {
        f"truth.sensor.{key}": value
        for key, value in {"sigma": file.sigma, "f": file.f, "B": file.B, "image": image, "disparity": disparity,
                           "principal_point": file.principal_point, "mount": file.mount.model_dump(),
                           "disparity_growth": file.disparity_growth, "effects": _with_bias(camera, file)}.items()
    } | {
        "belief.sensor": file.belief().model_dump() | {"disparity": disparity},
        "belief.motion": motion.model_dump(),
        "belief.sigma_points": file.sigma_points.model_dump(),
        "truth.motion.sigma_v": motion.sigma_v,
        "truth.motion.sigma_omega": motion.sigma_omega,
    }  # fmt: skip
    try:
        scenario = with_changes(base, path.stem, f"{path} in the world of {base.name}", changes)
    except ValidationError as error:
        raise InputError(f"{path}: {explain(error, Scenario)}") from None
    return Rig(str(path), scenario, tuple(assumed))


def _with_bias(camera: UvdSensor, file: SensorFile) -> list[ListedEffect]:
    """The effects of the map's world, and the biases that the file tells of: what it subtracts is the case."""
    effects = [effect for effect in camera.effects if not isinstance(effect, LocalBias)]
    return effects if file.bias is None else [*effects, LocalBias.model_validate(file.bias.model_dump())]


def _with_options(scenario: Scenario, request: Request) -> Scenario:
    for option in ("range", "speed", "density", "dt"):
        value = getattr(request, option)
        if value is None:
            continue
        if not 0.0 < value < np.inf:
            raise InputError(f"--{option} {value:g}: must be a positive number")
        factor = 1.0 / density_of(scenario) if option == "density" else 1.0
        try:
            changes = QUANTITIES[option].changes(scenario, value * factor)
            scenario = with_changes(scenario, scenario.name, scenario.summary, changes)
        except ValueError as error:
            raise InputError(f"--{option} {value:g}: {explain(error, Scenario)}") from None
    return scenario


# --- its place in the grid --------------------------------------------------------------------------


@dataclass(frozen=True)
class AxisPlace:
    """Where a rig lies on one axis of a map."""

    axis: Axis
    value: Any  # of the rig; NaN or None where it has none
    position: float  # in grid steps from the first value
    inside: bool
    around: tuple[int, ...]  # one or two values of the axis

    @property
    def nearest(self) -> int:
        return int(np.floor(self.position + 0.5))

    @property
    def text(self) -> str:
        """The value, and what the map has if it lies beyond."""
        value = "unknown"
        if is_known(self.value):
            value = say_value(self.axis.unit, float(self.value) if self.axis.numeric else self.value)
        ends = f"{self.axis.say(0)} to {self.axis.say(len(self.axis.values) - 1)}"
        values = ends if self.axis.numeric else ", ".join(map(self.axis.say, range(len(self.axis.values))))
        return f"{self.axis.text} {value}" + ("" if self.inside else f", beyond the map's {values}")


def is_known(value: Any) -> bool:
    return value is not None and bool(value == value)


def place_on(axis: Axis, value: Any) -> AxisPlace:
    """Where a value lies on an axis, by its logarithm where all values are positive."""
    last = len(axis.values) - 1
    if not axis.numeric or not isinstance(value, int | float) or not np.isfinite(value):
        known = list(axis.values).index(value) if value in axis.values else None
        return AxisPlace(axis, value, float(known or 0), known is not None, (known or 0,))
    if axis.log and value <= 0.0:
        return AxisPlace(axis, value, 0.0, False, (0,))
    of = np.log if axis.log else np.asarray
    grid = np.asarray(of(np.array(axis.values, float)), float)
    at = float(of(np.array(float(value))))
    slack = ALIKE if axis.log else ALIKE * max(abs(grid).max(), 1e-12)
    inside = bool(grid[0] - slack <= at <= grid[-1] + slack)
    position = float(np.interp(at, grid, np.arange(last + 1)))
    near = round(position)
    around = (near,) if abs(position - near) < AT else (int(np.floor(position)), int(np.ceil(position)))
    return AxisPlace(axis, value, position, inside, around)


def distance(places: tuple[AxisPlace, ...], cell: Cell) -> float:
    """Grid steps from a rig to a cell."""
    return float(np.linalg.norm([i - place.position for i, place in zip(cell.indices, places, strict=True)]))


def differences(rig: Scenario, sweep: Sweep) -> list[str]:
    """What the rig has otherwise than every cell of the map, for no axis on which it has a value changes it."""
    base = sweep.base
    axes = [axis for axis in sweep.axes if is_known(axis.of(rig, base))]
    varied = {key for axis in axes for key in axis.changes(base, axis.values[0])}
    if any(axis.key == "density" for axis in sweep.axes):
        varied |= {f"truth.landmarks.{key}" for key in ("layout", "count", "seed", "x", "y", "z", "points")}
    theirs, ours = dict(leaves(base.model_dump())), dict(leaves(rig.model_dump()))
    keys = [key for key in dict.fromkeys((*ours, *theirs)) if key.startswith(("truth.", "belief."))]
    other = [key for key in keys if key not in varied and not _alike(ours.get(key), theirs.get(key))]
    mistold = [key for key in told_otherwise(rig) if key not in told_otherwise(base) and key not in other]
    return [*other, *mistold]


def told_otherwise(scenario: Scenario) -> list[str]:
    """Keys of the belief whose value is not the true one."""
    truth = dict(leaves(scenario.truth.model_dump(), "belief."))
    belief = dict(leaves(scenario.belief.model_dump(), "belief."))
    for key in truth:
        if key.startswith("belief.sensor.disparity"):
            belief.setdefault(key, None)
    return [key for key, value in belief.items() if key in truth and not _alike(value, truth[key])]


def _alike(a: Any, b: Any) -> bool:
    if isinstance(a, int | float) and isinstance(b, int | float):
        return bool(np.isclose(a, b, rtol=1e-6, atol=0.0))
    if isinstance(a, list | tuple) and isinstance(b, list | tuple):
        return len(a) == len(b) and all(map(_alike, a, b))
    return bool(a == b)
