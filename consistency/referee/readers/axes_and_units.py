"""Axes that are declared by a letter each, as ned and frd, and headings in degrees where radians are needed.

Covariances of the estimates stay as they are, so that each error keeps its meaning.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from consistency.referee.errors import InputError
from consistency.referee.geometry import CHARTS, wrap
from consistency.referee.readers.options import OF_AXES, Reading, flag_of
from consistency.referee.readers.truth_matching import Estimator, Poses, finite_rows
from consistency.referee.types import Array

X, Y, Z = np.eye(3)
WORLD = {"e": X, "w": -X, "n": Y, "s": -Y, "u": Z, "d": -Z}  # of axes, in east, north, up
BODY = {"f": X, "b": -X, "l": Y, "r": -Y, "u": Z, "d": -Z}  # in forward, left, up
ENU = "enu"
FLU = "flu"
JUMP = 180.0  # degrees between two rows
SMOOTH = 60.0  # degrees that are left of a jump less a whole turn
OFTEN = 3  # jumps: headings in rad do not jump as often
TURNING = 0.15  # rad, spread of a course
ALONG = 0.2  # the part of it that headings in degrees do not explain, at most
STANDING = 1e-6  # m between two rows
FEWEST = 10  # steps along a path
FITTING = (0.05, 4.0)  # median of squared errors over variances, of which chi-square has 0.45


class Axes(NamedTuple):
    """Axes of a file."""

    world: str  # as "ned"
    body: str  # as "frd"


class Change(NamedTuple):
    """Matrices from the axes of the truth to those of the estimates, whose entries are 0, 1 and -1."""

    world: Array  # (3, 3)
    body: Array  # (3, 3)


def in_axes_of_estimates(e: Estimator, r: Reading) -> Estimator:
    """An estimator whose truth is given in the axes of its estimates.

    Raises
    ------
    InputError
        Axes are none, or left-handed; the estimates have no poses; or axes of the plane do not lie in one.
    """
    given = r.given(OF_AXES)
    if not given:
        return e
    are_poses = e.error.in_space or tuple(e.error.axes) == ("x", "y", "heading")
    if e.innovations_alone or not are_poses:
        raise InputError(f"{flag_of(given[0])}: needs poses or positions with a truth; {e.path} has none")
    own, true = axes_of_files(r, e.error.in_space)
    world = _matrix("--world", own.world, WORLD).T @ _matrix("--truth-world", true.world, WORLD)
    body = _matrix("--body-axes", own.body, BODY).T @ _matrix("--truth-body-axes", true.body, BODY)
    if np.array_equal([world, body], [np.eye(3)] * 2):
        return e
    if not e.error.in_space and abs(world[2, 2] + body[2, 2]) != 2.0:
        raise InputError(
            f"{flag_of(given[0])}: in the plane, as in {e.path}, the third axes of world and body must be both up "
            f"or both down; the estimates are in {own.world} and {own.body}, the truth in {true.world} and {true.body}"
        )
    runs = [_with_truth(p, Change(world, body), e.error.in_space) for p in e.runs]
    what = (
        f"the truth, in {true.world} and {true.body}, is read in the axes of the estimates, {own.world} and {own.body}"
    )
    return replace(e, runs=runs).with_notes(f"{e.said}: {what} (world, body)")


def axes_of_files(r: Reading, in_space: bool) -> tuple[Axes, Axes]:
    """Axes of estimates and truth, which are enu and flu where nothing is declared.

    A truth beside the estimates in their file has their axes. The body of a pose in the plane, unless declared, has its
    third axis where its world has it.
    """
    beside = not r.given(("truth", "truth_topic"))
    declared = r.conventions
    world = declared.world or ENU
    own = Axes(world, declared.body_axes or _body_of(world, in_space))
    if beside:
        return own, Axes(declared.truth_world or own.world, declared.truth_body_axes or own.body)
    true_world = declared.truth_world or ENU
    return own, Axes(true_world, declared.truth_body_axes or _body_of(true_world, in_space))


def _body_of(world: str, in_space: bool) -> str:
    return "frd" if world.endswith("d") and not in_space else FLU


def _matrix(option: str, letters: str, directions: Mapping[str, Array]) -> Array:
    """Matrix (3, 3) whose columns are the axes, in east, north, up or in forward, left, up."""
    example = "ned, enu" if directions is WORLD else "frd, flu"
    if len(letters) != 3 or not set(letters) <= set(directions):
        known = ", ".join(directions)
        raise InputError(f"{option} {letters}: must be three letters of {known}, such as {example}")
    out = np.column_stack([directions[letter] for letter in letters])
    if np.linalg.det(out) < 0.5:
        raise InputError(f"{option} {letters}: is not right-handed; such as {example} are")
    return out


def _with_truth(p: Poses, change: Change, in_space: bool) -> Poses:
    """A run with its truth in other axes, and the covariance of that truth."""
    A, C = change
    truth = p.true.values.copy()
    P = p.true.covariance
    if not in_space:
        truth[:, :2] = truth[:, :2] @ A[:2, :2].T
        start = A @ C.T
        turned = np.arctan2(start[1, 0], start[0, 0])
        truth[:, 2] = A[2, 2] * truth[:, 2] + turned
        if p.manifold == "planar":
            truth[:, 2] = wrap(truth[:, 2])
    else:
        truth[:, :3] = truth[:, :3] @ A.T
        if p.manifold == "spatial" and len(truth):
            R = Rotation.from_quat(truth[:, 3:7])
            R = Rotation.from_matrix(A) * R * Rotation.from_matrix(C.T)
            truth[:, 3:7] = R.as_quat()
        for first, axes in ((7, A), (10, C), (13, C)):  # velocity, biases of gyroscope and accelerometer
            if first < truth.shape[1]:
                truth[:, first : first + 3] = truth[:, first : first + 3] @ axes.T
    if P is not None:
        P = _carried(P, p.convention, change, in_space)
    return p.with_values(truth=truth, true_covariance=P)


def _carried(P: Array, convention: str, change: Change, in_space: bool) -> Array:
    """Covariances (M, n, n) of errors of the truth in other axes; of positions or planar poses n is 3, of poses 6."""
    A, C = change
    position = rotation = A
    if convention == "left":
        position = C
    if convention in ("left", "so3-body"):
        rotation = C
    if convention in CHARTS:
        raise InputError(f"--truth-covariance: goes with no other axes of the truth where the error is '{convention}'")
    T = np.zeros((6, 6))
    T[:3, :3] = position
    T[3:, 3:] = rotation
    if P.shape[-1] == 3:
        part = [0, 1, 2] if in_space else [0, 1, 5]
        T = T[np.ix_(part, part)]
    return np.asarray(T @ P @ T.T)


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
            values = p.value(name)
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
        gaps.append(known.true.values[:, 2] - known.own.estimate[:, 2])
        variances.append(known.own.covariance[:, 2, 2])
    gap = np.concatenate(gaps)
    variance = np.concatenate(variances)
    some = np.isfinite(gap) & (variance > np.pi**2)
    error = gap[some] - 360.0 * np.round(gap[some] / 360.0)
    ratio = np.square(error) / variance[some]
    if 2 * len(ratio) <= len(gap):
        return False
    return bool(FITTING[0] < np.median(ratio) < FITTING[1])
