"""What changes in a scenario where its sensor, noise, path or landmarks are others: values by dotted key."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from consistency.bench.scenario import (
    Circle,
    FigureOfEight,
    Path_,
    RoundedRectangle,
    Scenario,
    Truth,
    UniformLandmarks,
    UvdSensor,
)
from consistency.bench.simulation.path import lap_length, planned_path
from consistency.referee.types import Array

Changes = dict[str, Any]  # dotted key of the scenario -> value
HALVES = ("truth", "belief")
SHAPES = ("circle", "rounded-rectangle", "figure-of-eight")


class Course(NamedTuple):
    """A path, and the box of landmarks about it."""

    path: Path_
    x: tuple[float, float]  # m
    y: tuple[float, float]  # m
    landmarks: float  # number of them that are as dense as before


def course_of(truth: Truth, shape: str, lap: float = 1.0) -> Course:
    """A path of one of :data:`SHAPES` about the same centre, its lap ``lap`` times as long.

    Raises
    ------
    ValueError
        The landmarks are not spread evenly over a box, or there is no such shape.
    """
    landmarks = truth.landmarks
    if not isinstance(landmarks, UniformLandmarks):
        raise ValueError("needs truth.landmarks.layout = 'uniform', whose box follows the path")
    if shape not in SHAPES:
        raise ValueError(f"a path of shape '{shape}' has no laps; use {', '.join(SHAPES)}")
    path, box = _path(shape, truth, lap), np.array([landmarks.x, landmarks.y])
    margin = box - _extent(truth)
    x, y = np.round(_extent(truth.model_copy(update={"path": path})) + margin.mean(axis=0), 1).tolist()
    area = float((x[1] - x[0]) * (y[1] - y[0]) / np.prod(box[:, 1] - box[:, 0]))
    return Course(path, (x[0], x[1]), (y[0], y[1]), landmarks.count * area)


def in_both(key: str, value: Any) -> Changes:
    """A key of truth and belief alike."""
    return {f"{half}.{key}": value for half in HALVES}


def baseline_changes(base: Scenario, baseline: float) -> Changes:
    """Another baseline (m); the largest disparity of the search grows with it, so that the nearest depth stays."""
    if base.truth.sensor.rig is None:
        raise ValueError(f"a sensor '{base.truth.sensor.model}' has no baseline")
    ratio = baseline / base.truth.sensor.rig[1]
    changes = in_both("sensor.B", baseline)
    for half in HALVES:
        disparity = getattr(getattr(base, half).sensor, "disparity", None)
        if disparity is not None:
            changes[f"{half}.sensor.disparity"] = (disparity[0], disparity[1] * ratio)
    return changes


def odometry_changes(base: Scenario, factor: float) -> Changes:
    """Noise of the odometry times a factor."""
    changes: Changes = {}
    for half in HALVES:
        motion = getattr(base, half).motion
        changes[f"{half}.motion.sigma_v"] = factor * motion.sigma_v
        changes[f"{half}.motion.sigma_omega"] = factor * motion.sigma_omega
    return changes


def range_changes(base: Scenario, far: float) -> Changes:
    """The longest range of the sensor, m."""
    return {"truth.sensor.range": (base.truth.sensor.range[0], far)}


def tilt_changes(base: Scenario, tilt: float) -> Changes:
    """A camera turned to a tilt (deg, positive looks down)."""
    roll, _, heading = _stereo_camera(base).mount.rotation
    return in_both("sensor.mount.rotation", (roll, float(np.deg2rad(tilt)), heading))


def height_changes(base: Scenario, height: float) -> Changes:
    """A camera moved to a height (m)."""
    x, y, _ = _stereo_camera(base).mount.position
    return in_both("sensor.mount.position", (x, y, height))


def _stereo_camera(base: Scenario) -> UvdSensor:
    sensor = base.truth.sensor
    if not isinstance(sensor, UvdSensor):
        raise ValueError(f"a sensor '{sensor.model}' has no tilt or height")
    return sensor


def _path(shape: str, truth: Truth, lap: float) -> Path_:
    """A path of another shape about the centre of the base, ``lap`` times as long, with sides of 8 to 5."""
    length, (x, y) = lap * lap_length(truth.path), np.round(_extent(truth).mean(axis=1), 1)
    speed = truth.path.speed
    if shape == "circle":
        radius = round(length / (2 * np.pi), 2)
        return Circle(shape="circle", radius=radius, start=(x + radius, y), heading=np.pi / 2, speed=speed)
    if shape == "figure-of-eight":
        radius = round(length / (4 * np.pi), 2)
        return FigureOfEight(shape="figure-of-eight", radius=radius, start=(x, y), heading=0.0, speed=speed)
    corner = round(length / 25, 2)
    long, wide = (round((length + (8 - 2 * np.pi) * corner) * side / 26, 2) for side in (8, 5))
    return RoundedRectangle(
        shape="rounded-rectangle", length=long, width=wide, corner_radius=corner, start=(x, y - wide / 2), heading=0.0,
        speed=speed,
    )  # fmt: skip


def _extent(truth: Truth) -> Array:
    """Smallest and largest x and y of one lap of the path, (2, 2)."""
    steps = int(np.ceil(lap_length(truth.path) / truth.path.speed / truth.dt))
    path = planned_path(truth.model_copy(update={"steps": steps}))
    return np.column_stack([path[:, :2].min(axis=0), path[:, :2].max(axis=0)])
