"""Headings in degrees where radians are needed, told by what no heading in radians does."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from consistency.referee.errors import InputError
from consistency.referee.geometry import wrap
from consistency.referee.readers.truth_matching import Poses, finite_rows
from consistency.referee.types import Array

JUMP = 180.0  # degrees between two rows
SMOOTH = 60.0  # degrees that are left of a jump less a whole turn
OFTEN = 3  # jumps: headings in rad do not jump as often
TURNING = 0.15  # rad, spread of a course
ALONG = 0.2  # the part of it that headings in degrees do not explain, at most
STANDING = 1e-6  # m between two rows
FEWEST = 10  # steps along a path
FITTING = (0.05, 4.0)  # median of squared errors over variances, of which chi-square has 0.45


def require_radians(file: str, runs: Sequence[Poses]) -> None:
    """Refuse planar poses whose headings are in degrees; a heading beyond 2 pi alone may be unwrapped radians.

    Raises
    ------
    InputError
        Headings of the truth or of the estimates jump by 360, change by 57 times the turn of the path, or lie beyond
        2 pi beside variances that no heading in radians has.
    """
    if not runs or runs[0].manifold != "planar":
        return
    for side, name in (("truth", "truth"), ("estimates", "estimate")):
        poses = []
        beyond = False
        for p in runs:
            values = getattr(p, name)
            finite = values[finite_rows(values)]
            poses.append(finite)
            beyond |= bool((np.abs(finite[:, 2]) > 2.0 * np.pi + 0.1).any())
        if beyond and jumps([each[:, 2] for each in poses]):
            why = "jump by a whole turn of 360"
        elif turn_in_degrees(poses):
            why = "change by 57 times the turn of the path"
        elif beyond and fit_in_degrees(runs):
            why = "lie beyond 2 pi, and their errors fit variances beyond pi^2, which those in rad cannot"
        else:
            continue
        remedy = "write headings in rad (multiply by pi / 180), and variances in rad^2 (by its square)"
        raise InputError(f"{file}: the headings of the {side} {why}, so that they seem to be in degrees; {remedy}")


def jumps(headings: Sequence[Array]) -> bool:
    """Whether headings (N,) within one turn of 360 jump by it: where all else is smooth, or often."""
    found = 0
    least = 1
    for heading in headings:
        if len(heading) and np.ptp(heading) > 360.0:
            return False
        step = np.abs(np.diff(heading))
        found += int((step > JUMP).sum())
        if (np.minimum(step, np.abs(360.0 - step)) > SMOOTH).any():
            least = OFTEN
    return found >= least


def turn_in_degrees(poses: Sequence[Array]) -> bool:
    """Whether headings of poses (N, 3), read as degrees, explain how the direction of the path turns."""
    turning = 0.0
    unexplained = 0.0
    steps = 0
    for each in poses:
        if len(each) < 2:
            continue
        way = np.diff(each[:, :2], axis=0)
        size = np.hypot(*way.T)
        moving = size > max(0.1 * float(np.median(size)), STANDING)
        if not moving.any():
            continue
        course = np.unwrap(np.arctan2(way[moving, 1], way[moving, 0]))
        heading = np.deg2rad(each[:-1, 2][moving])
        apart = np.unwrap(wrap(heading - course))
        turning += course.var() * len(course)
        unexplained += apart.var() * len(course)
        steps += len(course)
    return steps >= FEWEST and turning > TURNING**2 * steps and unexplained < ALONG**2 * turning


def fit_in_degrees(runs: Sequence[Poses]) -> bool:
    """Whether errors of headings, read as degrees, are of the size of variances, most of them beyond pi^2."""
    gaps = []
    variances = []
    for p in runs:
        known = p.matched()
        gaps.append(known.truth[:, 2] - known.estimate[:, 2])
        variances.append(known.covariance[:, 2, 2])
    gap = np.concatenate(gaps)
    variance = np.concatenate(variances)
    some = np.isfinite(gap) & (variance > np.pi**2)
    error = gap[some] - 360.0 * np.round(gap[some] / 360.0)
    ratio = np.square(error) / variance[some]
    if 2 * len(ratio) <= len(gap):
        return False
    return bool(FITTING[0] < np.median(ratio) < FITTING[1])
