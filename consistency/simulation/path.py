"""Named trajectories: each is a cycle of (duration, v, omega) pieces, sampled without losing any turn."""

from __future__ import annotations

import numpy as np

from consistency.models.motion import dead_reckoning
from consistency.scenario import (
    Circle,
    Corridor,
    FigureOfEight,
    Path_,
    RoundedRectangle,
    Truth,
    Waypoints,
)
from consistency.types import Array


def planned_controls(truth: Truth) -> Array:
    """Velocities along the scenario's path, shape (steps, 3): dt (s), v (m/s), omega (rad/s).

    A step holds the mean of v and omega over it, so that every turn is made in full.
    """
    pieces = np.array(_pieces(truth.path))
    ends = np.concatenate([[0.0], np.cumsum(pieces[:, 0])])
    travelled = np.concatenate([[0.0], np.cumsum(pieces[:, 0] * pieces[:, 1])])
    turned = np.concatenate([[0.0], np.cumsum(pieces[:, 0] * pieces[:, 2])])
    time = truth.dt * np.arange(truth.steps + 1)
    laps, phase = np.divmod(time, ends[-1])
    distance = laps * travelled[-1] + np.interp(phase, ends, travelled)
    angle = laps * turned[-1] + np.interp(phase, ends, turned)
    dt = np.full(truth.steps, truth.dt)
    return np.column_stack([dt, np.diff(distance) / truth.dt, np.diff(angle) / truth.dt])


def start_pose(truth: Truth) -> Array:
    """Pose at step 0, shape (3,)."""
    return np.array([*truth.path.start, truth.path.heading])


def planned_path(truth: Truth) -> Array:
    """Poses 0..steps of the path without any noise, shape (steps + 1, 3)."""
    return dead_reckoning(start_pose(truth), planned_controls(truth))


def _pieces(path: Path_) -> list[tuple[float, float, float]]:
    """One cycle of the path as (duration, v, omega), all counter-clockwise."""
    v = path.speed
    match path:
        case Circle():
            return [_arc(v, path.radius, 2 * np.pi)]
        case FigureOfEight():
            return [_arc(v, path.radius, 2 * np.pi), _arc(v, path.radius, -2 * np.pi)]
        case RoundedRectangle():
            corner = _arc(v, path.corner_radius, np.pi / 2)
            long = (path.length - 2 * path.corner_radius) / v
            wide = (path.width - 2 * path.corner_radius) / v
            half = [(long / 2, v, 0.0), corner, (wide, v, 0.0), corner, (long / 2, v, 0.0)]
            return [piece for piece in half * 2 if piece[0] > 0]
        case Corridor():
            straight, turn = (path.length / v, v, 0.0), _arc(v, path.turn_radius, np.pi)
            return [straight, turn, straight, turn]
        case Waypoints():
            return _legs(path)


def _arc(v: float, radius: float, angle: float) -> tuple[float, float, float]:
    duration = abs(angle) * radius / v
    return duration, v, angle / duration


def _legs(path: Waypoints) -> list[tuple[float, float, float]]:
    """Turn on the spot towards each point, drive there; at the end back to the start and its heading."""
    pieces: list[tuple[float, float, float]] = []
    position, heading = np.array(path.start), path.heading

    def turn_to(target: float) -> None:
        angle = (target - heading + np.pi) % (2 * np.pi) - np.pi
        if abs(angle) > 1e-12:
            pieces.append((abs(angle) / path.turn_rate, 0.0, np.sign(angle) * path.turn_rate))

    for point in [*path.points, path.start]:
        leg = np.array(point) - position
        length = float(np.hypot(*leg))
        if length == 0.0:
            continue
        target = float(np.arctan2(leg[1], leg[0]))
        turn_to(target)
        pieces.append((length / path.speed, path.speed, 0.0))
        position, heading = np.array(point), target
    turn_to(path.heading)
    return pieces
