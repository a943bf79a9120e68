"""Headings in degrees where radians are needed, told by what no heading in radians does."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence

import numpy as np

from consistency.referee.errors import InputError
from consistency.referee.geometry import wrap
from consistency.referee.readers.truth_matching import Poses
from consistency.referee.types import Array

JUMP, SMOOTH = 180.0, 60.0  # between two rows, and what is left of a jump less a whole turn, in degrees
TURNING, ALONG = 0.15, 0.2  # rad, spread of a course; the part of it that headings in degrees do not explain, at most
STANDING = 1e-6  # m between two rows
FEWEST = 10  # steps along a path
OFTEN = 3  # jumps: no heading in radians turns back and forth by 28 turns
FITTING = (0.05, 4.0)  # median of squared errors over variances, of which chi-square has 0.45
REMEDY = "write headings in rad (multiply by pi / 180), and variances in rad^2 (by its square)"


def require_radians(file: str, runs: Sequence[Poses]) -> None:
    """Refuse planar poses whose headings are in degrees; a heading beyond 2 pi alone may be unwrapped radians.

    Headings in degrees jump by a whole turn of 360, change by 57 times the turn of the path, or lie beyond 2 pi beside
    variances that no heading in radians has.

    Raises
    ------
    InputError
        Headings of the truth or of the estimates are in degrees.
    """
    if not runs or runs[0].manifold != "planar":
        return
    sides: dict[str, Callable[[Poses], Array]] = {"truth": lambda p: p.truth, "estimates": lambda p: p.estimate}
    for side, values in sides.items():
        poses = [values(p)[np.isfinite(values(p)).all(axis=1)] for p in runs]
        beyond = max((float(np.abs(each[:, 2]).max(initial=0.0)) for each in poses), default=0.0) > 2.0 * np.pi + 0.1
        why = ""
        if beyond and jumps(poses):
            why = "jump by a whole turn of 360"
        elif follow_in_degrees(poses):
            why = "change by 57 times the turn of the path"
        elif beyond and fit_in_degrees(runs):
            why = "lie beyond 2 pi, and their errors fit variances beyond pi^2, which those in rad cannot"
        if why:
            raise InputError(f"{file}: the headings of the {side} {why}, so that they seem to be in degrees; {REMEDY}")


def jumps(poses: Iterable[Array]) -> bool:
    """Whether headings of poses (N, 3) that lie in a turn of 360 jump by one: where all else is smooth, or often."""
    found, smooth = 0, True
    for each in poses:
        heading = each[:, 2]
        if len(heading) and np.ptp(heading) > 360.0:
            return False
        step = np.abs(np.diff(heading))
        far = step > JUMP
        smooth &= bool((np.where(far, 360.0 - step, step) <= SMOOTH).all())
        found += int(far.sum())
    return found >= (1 if smooth else OFTEN)


def follow_in_degrees(poses: Iterable[Array]) -> bool:
    """Whether headings of poses (N, 3), read as degrees, explain how the direction of the path turns."""
    turning, unexplained, steps = 0.0, 0.0, 0
    for each in poses:
        way = np.diff(each[:, :2], axis=0)
        size = np.hypot(*way.T)
        if len(size) < 3:
            continue
        some = size > max(0.1 * float(np.median(size)), STANDING)
        course = np.unwrap(np.arctan2(way[some, 1], way[some, 0]))
        apart = np.unwrap(wrap(np.deg2rad(each[:-1, 2][some]) - course))
        if len(course):
            turning += course.var() * len(course)
            unexplained += apart.var() * len(course)
            steps += len(course)
    return steps >= FEWEST and turning > TURNING**2 * steps and unexplained < ALONG**2 * turning


def fit_in_degrees(runs: Iterable[Poses]) -> bool:
    """Whether errors of headings, read as degrees, are of the size of variances that are beyond pi^2."""
    squares, variances = [], []
    for p in runs:
        known = p.known()
        gap = known.truth[:, 2] - p.estimate[known.rows, 2]
        squares.append(np.square(gap - 360.0 * np.round(gap / 360.0)))
        variances.append(p.covariance[known.rows, 2, 2])
    square, variance = np.concatenate(squares), np.concatenate(variances)
    some = np.isfinite(square) & (variance > np.pi**2)
    if 2 * some.sum() < len(square):
        return False
    return bool(FITTING[0] < np.median(square[some] / variance[some]) < FITTING[1])
