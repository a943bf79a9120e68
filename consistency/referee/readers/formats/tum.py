"""Trajectories in space, as text in files for estimates, truth and covariances, or as messages of a bag."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from consistency.referee.errors import InputError
from consistency.referee.geometry import INERTIAL, PLANAR
from consistency.referee.readers.formats import pose_rows as stated_as
from consistency.referee.readers.formats.columns import Columns
from consistency.referee.readers.formats.file_kinds import files_of_runs, is_drive, paired
from consistency.referee.readers.formats.kitti_files import read_drive
from consistency.referee.readers.formats.pose_rows import (
    DEVIATIONS,
    DEVIATIONS_LAYOUT,
    FULL,
    ORDERS,
    POINT,
    POSE_NUMBERS,
    SPLIT,
    States,
    not_unit,
    read_beside,
    read_deviations,
    read_poses,
)
from consistency.referee.readers.formats.positions import (
    Fixes,
    fixed,
    localised,
    placeholder,
    point_positions,
    position_note,
    require_positions,
)
from consistency.referee.readers.formats.text_blocks import Lines
from consistency.referee.readers.options import COLUMNS, GroupOptions, Reading, flag_of
from consistency.referee.readers.places import listed, one_of_each_kind, refuse
from consistency.referee.readers.runs_to_record import symmetric
from consistency.referee.readers.truth_matching import (
    ALONE,
    BLOCKS,
    POINTS,
    SINGLE,
    STATE,
    WHOLE,
    Estimator,
    Files,
    Poses,
    Stated,
    StatedError,
    finite_rows,
    make_poses,
    unstated,
)
from consistency.referee.system import with_progress
from consistency.referee.types import Array

OPENVINS = "written by OpenVINS"


@dataclass(frozen=True)
class SpaceRun:
    """A run in space as its files have it."""

    own: Lines
    true: Lines
    files: Files  # of the estimates, of the truth
    covariance: Path | None = None  # where it is not in the lines
    notes: Sequence[str] = ()


def read_tum(estimates: Path, r: Reading, poses_alone: bool = False) -> list[Estimator]:
    """One estimator: a file, or a folder with a file for each run.

    With axes named only these components of the error are judged, by their part of the covariance.

    With the 20 columns that the tools of OpenVINS write, position and rotation are two records: their cross-covariance
    is not in the file, so a joint NEES would be wrong. With the states and standard deviations of a simulation each
    component is one. The truth may be a drive of KITTI.

    Parameters
    ----------
    poses_alone : covariances are not looked at
    """
    stated_as.require_spatial(r.conventions.error, INERTIAL)
    truth_of = _truths(estimates, r)
    files = files_of_runs(estimates, r, None if poses_alone else r.sources.covariance)
    runs = (
        SpaceRun(read_trajectory(own, columns=r.components.columns), truth_of(true), (own, true), covariance)
        for own, true, covariance in with_progress(files, "reading", "files")
    )
    return [poses_without_covariances(estimates, runs, r) if poses_alone else space_estimator(estimates, runs, r)]


class Layout(NamedTuple):
    """What the files of all runs have in common."""

    stated: Stated
    convention: str  # of the error of poses; "" of positions by satellite
    files: Files  # of the first run


def space_estimator(path: Path, runs: Iterable[SpaceRun], r: Reading, why: str = "", mixed: str = "") -> Estimator:
    """An estimator in space, before any error is taken.

    Parameters
    ----------
    why : reason for the default error, as the end of a note; that of the layout where empty
    mixed : message where runs are of different layouts
    """
    poses: list[Poses] = []
    notes: list[str] = []
    layout: Layout | None = None
    for run in runs:
        own, true, world = localised(run.own, run.true)
        notes += [own.cut, true.cut, own.note, true.note, world]
        notes += [_unused(true, r), *run.notes]
        if layout is None:
            layout = _layout_of(own, run.files, r)
            notes.append(stated_as.order_note(run.files[0], stated_as.components_of(own), r))
        elif _stated(own) != layout.stated:
            what = f"{run.files[0]}: has {own.values.shape[1]} columns, {layout.files[0]} another layout"
            raise InputError(mixed or what)
        one, unjudged = _beside_truth(replace(run, own=own, true=true), layout, r)
        notes.append(unjudged)
        poses.append(one.with_values(run=len(poses), files=run.files, open_end=own.open_end()))
    assert layout is not None
    if poses[0].manifold == "spatial" and r.components.axes is None and r.runs.relative is None:
        is_empty, what = placeholder(poses)
        if what:
            notes.append(f"{layout.files[1]}: {what}")
        if is_empty:
            poses = [point_positions(one, r.matching.lever_arm, layout.stated != WHOLE) for one in poses]
    if any(one.manifold == "vector" for one in poses):
        require_positions(path, poses, r)
    elif r.matching.lever_arm is not None:
        raise InputError("--lever-arm: goes with a truth of positions alone; this one has the orientation of its body")
    kind = poses[0].convention
    if kind == "vector" and layout.convention:
        notes.append(position_note(layout.files[1], r.matching.lever_arm))
        why = f"; of the position, whose covariance follows from that of the error {layout.convention}"
    elif r.conventions.error is not None:
        why = ""
    elif not why:
        why = f"; the default of this layout, {_origin(layout.stated)}"
    definition = f"{INERTIAL.get(kind) or PLANAR[kind]}{why}"
    axes = STATE[: poses[0].own.covariance.shape[-1]]
    error = StatedError(axes, kind, definition, layout.stated, in_space=True, position=3)
    kept = one_of_each_kind(notes)
    return Estimator(path.stem, path, poses, error, label=path.name, covariances=r.sources.covariance, notes=kept)


def _layout_of(own: Lines, files: Files, r: Reading) -> Layout:
    """The layout of the first run.

    Raises
    ------
    InputError
        An option does not go with it.
    """
    stated = _stated(own)
    stated_as.require_error(own, r.conventions.error)
    if stated not in (WHOLE, ALONE) and r.conventions.covariance_order not in (None, ORDERS[1]):
        raise InputError(f"--covariance-order: {files[0]} is {OPENVINS}, rotation before translation")
    if isinstance(own, Fixes):
        return Layout(stated, "", files)
    default = "so3" if stated in (WHOLE, ALONE) else "so3-body"
    return Layout(stated, r.conventions.error or default, files)


def _stated(own: Lines) -> Stated:
    """Components whose covariance is known, by the layout of a file."""
    width = own.values.shape[1]
    if isinstance(own, Fixes):
        return ALONE if own.alone else POINTS
    if isinstance(own, States):
        return SINGLE
    if width - POSE_NUMBERS in DEVIATIONS:
        return ALONE
    return BLOCKS if width == SPLIT else WHOLE


def _origin(stated: Stated) -> str:
    """Where a layout of covariances comes from."""
    if stated in (WHOLE, ALONE):
        return "as in ROS messages with a covariance; declare yours with --error"
    if stated == POINTS:
        return "positions alone"
    if stated == BLOCKS:
        return f"{OPENVINS}; --error so3 where it comes from another ROS topic"
    return OPENVINS


def poses_without_covariances(path: Path, runs: Iterable[SpaceRun], r: Reading) -> Estimator:
    """Poses in space without their covariances.

    Raises
    ------
    InputError
        A file holds positions alone.
    """
    poses = []
    for run in runs:
        for lines, name in zip((run.own, run.true), run.files, strict=True):
            if _is_point(lines):
                raise InputError(f"{name}: holds positions alone; motions need orientations, too")
        covariance, stated = unstated(len(run.own.t), 6)
        poses.append(_poses(run, 0, covariance, stated, "left", r))
    return Estimator(path.stem, path, poses, StatedError(STATE[:6], in_space=True))


# --- a run with its truth ----------------------------------------------------------------------------


def _beside_truth(run: SpaceRun, layout: Layout, r: Reading) -> tuple[Poses, str]:
    """The poses of a run, or positions where these alone have a truth, and a note on what is not judged."""
    own = run.own
    true = run.true
    by = _own_column(own, r.groups)
    if isinstance(own, Fixes):
        return fixed(own, true, r, _of_truth(true, own, ORDERS[0], r)).with_values(by=by), ""
    k, note = judged_rest(own, true, r)
    order = r.conventions.covariance_order or ORDERS[0]
    P, known = unstated(len(own.t), 6 + k)
    cross = None
    if not r.statement.unstated or run.covariance is not None or stated_as.covariances_in(own, order) is not None:
        P, known, cross = _covariances(own, run.covariance, 6 + k, order, r.matching.tolerance)
    of_truth = _of_truth(true, own, order, r)
    run = replace(run, own=own.of(slice(0, POSE_NUMBERS)))  # without the covariances, of which P has a copy
    poses = _poses(run, k, P, known, layout.convention, r)
    poses = poses.with_values(cross=cross, true_covariance=of_truth, by=by)
    if _is_point(true):
        poses = point_positions(poses, r.matching.lever_arm, layout.stated != WHOLE)
    return poses, note


def _own_column(own: Lines, options: GroupOptions) -> Array | None:
    """Cells of the column of ``--by``, (N,); None where the file has no columns, or the column is of another one.

    A file without a column t has the seconds since its first row in its place.
    """
    by = options.own_column
    if by == "t" and "t" not in own.columns:
        return np.asarray(own.t - own.t[0])
    if by is None or not own.columns:
        return None
    if by not in own.columns:
        has = f"has no such column; there are: {listed(list(own.columns), 12)}"
        raise InputError(f"--by {by}: {own.path} {has}; a table with t and the column goes with --by-file")
    return own.columns[by]


def _poses(run: SpaceRun, k: int, covariance: Array, stated: Array, convention: str, r: Reading) -> Poses:
    """Poses beside the true ones, both with the first ``k`` numbers of velocity and biases behind them."""
    own = run.own
    true = run.true
    return make_poses(
        place=own.places,
        t=own.t,
        estimate=_states(own, k),
        covariance=covariance,
        stated=stated,
        true_t=true.t,
        truth=_states(true, k),
        manifold="spatial",
        convention=convention,
        max_dt=r.matching.tolerance,
        name=own.path.stem,
        files=run.files,
    )


def _covariances(
    own: Lines, path: Path | None, n: int, order: str, tolerance: float
) -> tuple[Array, Array, Array | None]:
    """Covariances (N, n, n), NaN where none is near, whether there is one, (N,), and cross-covariances.

    They stand in the lines or in a file of their own.
    """
    P = stated_as.covariances_in(own, order)
    if path is None and P is not None:
        covariance = symmetric(P[:, :n, :n], own.place, one_triangle=True)
        return covariance, np.ones(len(P), bool), None
    if path is None:
        of = f"lines of t and {FULL} numbers, or name its columns: --columns 'P*=NAME*'"
        if isinstance(own, States):
            of = f"the standard deviations of {DEVIATIONS_LAYOUT}"
        raise InputError(
            f"{own.path}: holds no covariance; give --covariance FILE, {of}; where none is stated, 'consistency "
            "correct' finds one"
        )
    if P is not None:
        raise InputError(f"--covariance {path}: {own.path} holds covariances already; give one of them")
    if isinstance(own, States):
        source, P = read_deviations(path)
    else:
        source = stated_as.read_covariances(path)
        P = stated_as.matrices_of(source, order)
    rows, picked = stated_as.nearest_rows(own, source, tolerance)
    known = np.zeros(len(own.t), bool)
    known[rows] = True
    cross = None
    if source.values.shape[1] == 1 + stated_as.BOTH:
        cross = stated_as.cross_covariances(own, source, rows, picked, order)
    covariance = stated_as.on_rows(len(known), rows, P[picked][:, :n, :n], source, picked)
    return covariance, known, cross


def _states(lines: Lines, k: int) -> Array:
    """Poses with the first ``k`` numbers of velocity and biases behind them, (N, 7 + k)."""
    pose = lines.values[:, 1:POSE_NUMBERS]
    if lines.rest is None or not k:
        return pose
    return np.column_stack([pose, lines.rest[:, :k]])


def judged_rest(own: Lines, true: Lines, r: Reading) -> tuple[int, str]:
    """How many numbers of velocity and biases are judged beside the poses, and a note where they are not."""
    stated = 9 if isinstance(own, States) else stated_as.components_of(own) - 6
    k = stated
    for lines in (own, true):
        k = min(k, 0 if lines.rest is None else lines.rest.shape[1])
    moving = r.given(("relative", "align", "truth_covariance"))
    if k and moving:
        flag = flag_of(moving[0])
        return 0, f"{own.path}: with {flag} the poses alone are judged, not their velocities and biases"
    if k == stated or isinstance(own, States):
        return k, ""
    what = "biases" if k else "velocities"
    return k, f"{true.path}: holds no {what}, so that those of {own.path} are not judged"


def _unused(truth: Lines, r: Reading) -> str:
    """A note on a covariance of the truth that nothing is done with, "" without one."""
    stated = isinstance(truth, Fixes) or bool((truth.values[:, POSE_NUMBERS:] > 0).any())
    if r.truth.truth_covariance is not None or not stated or isinstance(truth, States):
        return ""
    return f"{truth.path}: the truth states a covariance of its own, which counts as 0; see --truth-covariance columns"


def _of_truth(truth: Lines, own: Lines, order: str, r: Reading) -> Array | None:
    """Covariance of the truth, (M, 6, 6) or of fixes (M, 3, 3): of its columns, or of a file; NaN without one."""
    if r.truth.truth_covariance is None:
        return None
    if r.truth.truth_covariance != COLUMNS:
        path = paired(Path(r.truth.truth_covariance), own.path, "--truth-covariance")
        return stated_as.from_file(truth, path, order, r.matching.tolerance)
    P = truth.covariances if isinstance(truth, Fixes) else stated_as.covariances_in(truth, order)
    if P is None:
        raise InputError(f"--truth-covariance {COLUMNS}: {truth.path} has none; give a file of t and {FULL} numbers")
    return symmetric(P[:, :6, :6], truth.place, one_triangle=True)


# --- files -------------------------------------------------------------------------------------------


def _truths(estimates: Path, r: Reading) -> Callable[[Path], Lines]:
    """What reads a truth: a file of its own, a drive, or columns beside the estimates."""

    @lru_cache(maxsize=1)
    def read(path: Path) -> Lines:
        if r.sources.truth is not None:
            if is_drive(path):
                return read_drive(path, r.sources.body)
            return read_trajectory(path, True, r.components.truth_columns)
        beside = read_beside(path, r.components.columns)
        if beside is None:
            raise InputError(f"{estimates}: a trajectory needs --truth FILE, the true one in the same form")
        return _checked(beside)

    return read


def read_trajectory(path: Path, true: bool = False, columns: Columns | None = None) -> Lines:
    """A trajectory, checked: increasing timestamps, quaternions of unit length; NaN only in estimates."""
    return _checked(read_poses(path, true, columns), true)


def _checked(lines: Lines, true: bool = True) -> Lines:
    """Poses whose quaternions have unit length, and which are finite if they are a truth."""
    pose = lines.values[:, 1:POSE_NUMBERS]
    if true:
        refuse(~finite_rows(pose), lines.place, "the truth is not finite; leave such lines out")
    if _is_point(lines):
        return lines
    bad, length = not_unit(pose)
    whole = lines.without_cut(bad)
    if whole is not lines:
        return whole
    places = "2 to 5" if isinstance(lines, States) else "5 to 8"
    where = lines.note.partition(": ")[2] or f"columns {places} must be qx qy qz qw"
    refuse(bad, lines.place, lambda row: f"the quaternion has length {length[row]:.4g}, not 1; {where}")
    return lines


def _is_point(lines: Lines) -> bool:
    return lines.values.shape[1] == POINT or isinstance(lines, Fixes)
