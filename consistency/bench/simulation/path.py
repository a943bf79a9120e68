"""Named trajectories: each is a cycle of pieces with constant velocities, sampled without losing any turn."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from consistency.bench.models.motion import dead_reckoning
from consistency.bench.scenario import (
    Circle,
    Corridor,
    FigureOfEight,
    Path_,
    RoundedRectangle,
    Truth,
    Waypoints,
)
from consistency.referee.types import Array


class Piece(NamedTuple):
    """A part of a path that is driven with constant velocities."""

    duration: float  # s
    v: float  # m/s
    omega: float  # rad/s


def planned_controls(truth: Truth) -> Array:
    """Velocities along the scenario's path, shape (steps, 3): dt (s), v (m/s), omega (rad/s).

    A step holds the mean of v and omega over it, so that every turn is made in full.
    """
    duration, v, omega = np.array(_pieces(truth.path)).T
    ends = np.concatenate([[0.0], np.cumsum(duration)])
    travelled = np.concatenate([[0.0], np.cumsum(duration * v)])
    turned = np.concatenate([[0.0], np.cumsum(duration * omega)])
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


def lap_length(path: Path_) -> float:
    """Length in m of the path until it is back at its start; turns on the spot have none."""
    return sum(piece.duration * piece.v for piece in _pieces(path))


def _pieces(path: Path_) -> list[Piece]:
    """One cycle of the path, all counter-clockwise."""
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
            half = [Piece(long / 2, v, 0.0), corner, Piece(wide, v, 0.0), corner, Piece(long / 2, v, 0.0)]
            return [piece for piece in half * 2 if piece.duration > 0]
        case Corridor():
            straight, turn = Piece(path.length / v, v, 0.0), _arc(v, path.turn_radius, np.pi)
            return [straight, turn, straight, turn]
        case Waypoints():
            return _legs(path)


def _arc(v: float, radius: float, angle: float) -> Piece:
    duration = abs(angle) * radius / v
    return Piece(duration, v, angle / duration)


def _legs(path: Waypoints) -> list[Piece]:
    """Turn on the spot towards each point, drive there; at the end back to the start and its heading."""
    pieces: list[Piece] = []
    position, heading = np.array(path.start), path.heading

    def turn_to(target: float) -> None:
        angle = (target - heading + np.pi) % (2 * np.pi) - np.pi
        if abs(angle) > 1e-12:
            pieces.append(Piece(abs(angle) / path.turn_rate, 0.0, np.sign(angle) * path.turn_rate))

    for point in [*path.points, path.start]:
        dx, dy = np.array(point) - position
        length = float(np.hypot(dx, dy))
        if length == 0.0:
            continue
        target = float(np.arctan2(dy, dx))
        turn_to(target)
        pieces.append(Piece(length / path.speed, path.speed, 0.0))
        position, heading = np.array(point), target
    turn_to(path.heading)
    return pieces
