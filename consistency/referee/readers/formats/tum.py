"""TUM trajectories: lines ``t tx ty tz qx qy qz qw``, the covariances in the same line or in a file of their own."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from consistency.referee.diagnostics.records.large_arrays import diagonal
from consistency.referee.errors import InputError
from consistency.referee.geometry.conventions import INERTIAL, PLANAR, SPATIAL
from consistency.referee.readers.clock_units import nothing_near
from consistency.referee.readers.formats.column_renaming import Columns
from consistency.referee.readers.formats.file_head import head_of
from consistency.referee.readers.formats.file_kinds import is_drive, table_files, trajectory_files
from consistency.referee.readers.formats.geodetic import Fixes, localised
from consistency.referee.readers.formats.kitti_files import read_drive
from consistency.referee.readers.formats.named_columns import numbered
from consistency.referee.readers.formats.pose_rows import (
    DEVIATIONS,
    DEVIATIONS_LAYOUT,
    FULL,
    POINT,
    POSE,
    SPLIT,
    TRIANGLE,
    States,
    read_beside,
    read_deviations,
    read_poses,
)
from consistency.referee.readers.formats.position_truth import (
    fixed,
    placeholder,
    position_note,
    positions,
    require_positions,
)
from consistency.referee.readers.formats.sheet import Lines, read_numbers
from consistency.referee.readers.options import COLUMNS, Reading
from consistency.referee.readers.places import Places, one_of_each_kind, refuse
from consistency.referee.readers.runs_to_record import symmetric
from consistency.referee.readers.truth_matching import (
    ALONE,
    BLOCKS,
    POINTS,
    SINGLE,
    STATE,
    WHOLE,
    Estimator,
    Poses,
    Stated,
    associate,
    unstated,
)
from consistency.referee.types import Array, Indices

ORDERS = ("translation-rotation", "rotation-translation")
BLOCKS_OF_STATE = ("p", "R", "v", "bg", "ba")  # three components each, in the order of STATE
BOTH = 2 * FULL  # and a cross-covariance with the line before
UNIT = 1e-3  # quaternions of four decimals pass


@dataclass(frozen=True)
class SpaceRun:
    """A run in space as its files have it."""

    own: Lines
    true: Lines
    files: tuple[Path | str, Path | str]  # of the estimates, of the truth
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
    if r.error not in (None, *INERTIAL):
        raise InputError(f"--error {r.error}: for a trajectory in space it is one of {', '.join(SPATIAL)}")
    truth_of = _truths(estimates, r)
    files = files_of_runs(estimates, r, None if poses_alone else r.covariance)
    runs = (SpaceRun(read_trajectory(own, columns=r.columns), truth_of(true), (own, true), P) for own, true, P in files)
    if poses_alone:
        return [poses_of(estimates, runs, r)]
    return [space_estimator(estimates, runs, r)]


def space_estimator(path: Path, runs: Iterable[SpaceRun], r: Reading, why: str = "", mixed: str = "") -> Estimator:
    """An estimator in space, before any error is taken.

    Parameters
    ----------
    why : reason for the default error, as the end of a note; that of the layout where empty
    mixed : message where runs are of different layouts
    """
    arm = r.lever_arm or (0.0, 0.0, 0.0)
    poses: list[Poses] = []
    notes: list[str] = []
    layout: Layout | None = None
    for run in runs:
        own, true, world = localised(run.own, run.true)
        notes += [own.cut, true.cut, own.note, true.note, world, _unused(true, r), *run.notes]
        if layout is None:
            layout = _layout_of(own, run.files, r)
            notes += _order_note(run.files[0], _width(own), r)
        elif _stated(own) != layout.stated:
            what = f"{run.files[0]}: has {own.values.shape[1]} columns, {layout.files[0]} another layout"
            raise InputError(mixed or what)
        if isinstance(own, Fixes):
            one = fixed(own, true, r, _of_truth(true, own, ORDERS[0], r))
        else:
            k, unjudged = judged_rest(own, true, r)
            notes.append(unjudged)
            one = _poses(own, true, run.covariance, layout.convention, r, k)
            if _is_point(true):
                one = positions(one, arm, layout.stated != WHOLE)
        poses.append(replace(one, run=len(poses), files=run.files, open_end=own.open_end))
    assert layout is not None
    if poses[0].manifold == "spatial" and r.axes is None and r.relative is None:
        empty, what = placeholder(poses)
        if what:
            notes.append(f"{layout.files[1]}: {what}")
        if empty:
            poses = [positions(one, arm, layout.stated != WHOLE) for one in poses]
    if any(one.manifold == "vector" for one in poses):
        require_positions(path, poses, r)
    elif r.lever_arm is not None:
        raise InputError("--lever-arm: goes with a truth of positions alone; this one has the orientation of its body")
    kind = poses[0].convention
    if kind == "vector" and layout.convention:
        notes.append(position_note(layout.files[1], r.lever_arm))
        why = f"; of the position, whose covariance follows from that of the error {layout.convention}"
    elif r.error is not None:
        why = ""
    elif not why:
        why = f"; the default of this layout, {_origin(layout.stated)}"
    return Estimator(
        path.stem, path, poses, STATE[: poses[0].covariance.shape[-1]], kind,
        f"{INERTIAL.get(kind) or PLANAR[kind]}{why}", layout.stated, path.name, r.covariance,
        one_of_each_kind(notes), in_space=True, position=3,
    )  # fmt: skip


class Layout(NamedTuple):
    """What the files of all runs have in common."""

    stated: Stated
    convention: str  # of the error of poses; "" of positions by satellite
    files: tuple[Path | str, Path | str]  # of the first run


def _layout_of(own: Lines, files: tuple[Path | str, Path | str], r: Reading) -> Layout:
    """The layout of the first run.

    Raises
    ------
    InputError
        An option does not go with it.
    """
    stated = _stated(own)
    require_error(own, r.error)
    if stated not in (WHOLE, ALONE) and r.covariance_order not in (None, ORDERS[1]):
        raise InputError(f"--covariance-order: {files[0]} is written by OpenVINS, rotation before translation")
    if isinstance(own, Fixes):
        return Layout(stated, "", files)
    return Layout(stated, r.error or ("so3" if stated in (WHOLE, ALONE) else "so3-body"), files)


def poses_of(path: Path, runs: Iterable[SpaceRun], r: Reading) -> Estimator:
    """Poses in space without their covariances.

    Raises
    ------
    InputError
        A file holds positions alone.
    """
    poses, pose = [], slice(1, POSE)
    for run in runs:
        for lines, name in zip((run.own, run.true), run.files, strict=True):
            if _is_point(lines):
                raise InputError(f"{name}: holds positions alone; motions need orientations, too")
        own, true = run.own, run.true
        place = Places(own.place, np.arange(len(own.t)))
        poses.append(
            Poses(
                place, own.t, own.values[:, pose], *unstated(len(own.t), 6), true.t, true.values[:, pose], "spatial",
                "left", r.tolerance, name=own.path.stem, files=run.files,
            )
        )  # fmt: skip
    return Estimator(path.stem, path, poses, STATE[:6], in_space=True)


def _truths(estimates: Path, r: Reading) -> Callable[[Path], Lines]:
    """What reads a truth: a file of its own, a drive, or columns beside the estimates."""

    @lru_cache(maxsize=1)
    def read(path: Path) -> Lines:
        if r.truth is not None:
            return read_drive(path, r.body) if is_drive(path) else read_trajectory(path, True, r.truth_columns)
        beside = read_beside(path, r.columns)
        if beside is None:
            raise InputError(f"{estimates}: a trajectory needs --truth FILE, the true one in the same form")
        return _checked(beside)

    return read


def _is_point(lines: Lines) -> bool:
    return lines.values.shape[1] == POINT or isinstance(lines, Fixes)


def _stated(own: Lines) -> Stated:
    """Components whose covariance is known, by the layout of a file."""
    if isinstance(own, Fixes):
        return ALONE if own.alone else POINTS
    if isinstance(own, States):
        return SINGLE
    width = own.values.shape[1]
    if width == SPLIT:
        return BLOCKS
    return ALONE if width - POSE in DEVIATIONS else WHOLE


def _origin(stated: Stated) -> str:
    """Where a layout of covariances comes from."""
    if stated in (WHOLE, ALONE):
        return "as in ROS messages with a covariance; declare yours with --error"
    if stated == POINTS:
        return "positions alone"
    if stated == BLOCKS:
        return "written by OpenVINS; --error so3 where it comes from another ROS topic"
    return "written by OpenVINS"


def files_of_runs(estimates: Path, r: Reading, covariance: Path | None) -> list[tuple[Path, Path, Path | None]]:
    """Files of every run: estimates, truth (the estimates where it stands beside them), covariance."""
    truth = r.truth
    if not estimates.is_dir():
        for option, path in (("--truth", truth), ("--covariance", covariance)):
            if path is not None and path.is_dir() and not (option == "--truth" and is_drive(path)):
                raise InputError(f"{option} {path}: is a folder, but {estimates} is one file")
        return [(estimates, truth or estimates, covariance)]
    files = trajectory_files(estimates, r.columns)
    if not files:
        raise InputError(f"{estimates}: holds no .txt or .tum file, no table and no manifest.json")
    stems = [path.stem for path in files]
    if twice := next((path for path in files if stems.count(path.stem) > 1), None):
        raise InputError(f"{estimates}: holds the run '{twice.stem}' twice, as .txt and .tum; keep one of them")
    if covariance is not None and not covariance.is_dir():
        raise InputError(f"--covariance {covariance}: must be a folder like {estimates}, a file for each run")
    out = []
    for path in files:
        own_truth = truth or path
        if truth is not None and truth.is_dir() and not is_drive(truth):
            own_truth = _same_stem(truth, path, "--truth")
        own_covariance = None if covariance is None else _same_stem(covariance, path, "--covariance")
        out.append((path, own_truth, own_covariance))
    return out


def _same_stem(folder: Path, path: Path, option: str) -> Path:
    if is_drive(folder / path.stem):
        return folder / path.stem
    matches = [other for other in (*trajectory_files(folder), *table_files(folder)) if other.stem == path.stem]
    if not matches:
        raise InputError(
            f"{option} {folder}: holds no file '{path.stem}' with .txt or .tum, or table, for {path}; files of the two "
            "folders are paired by name"
        )
    return matches[0]


def _poses(
    own: Lines,
    truth: Lines,
    covariance_path: Path | None,
    convention: str,
    r: Reading,
    k: int,
) -> Poses:
    """A run with its truth, of poses and ``k`` numbers of velocity and biases; P is NaN where none is near."""
    order, tolerance = r.covariance_order or ORDERS[0], r.tolerance
    covariance, source, cross = _inline(own, order), own, None
    rows = picked = np.arange(len(own.t))
    if covariance_path is not None:
        if covariance is not None:
            raise InputError(f"--covariance {covariance_path}: {own.path} holds covariances already; give one of them")
        if isinstance(own, States):
            source, covariance = read_deviations(covariance_path)
        else:
            source = read_covariances(covariance_path)
            covariance = _matrices(source.values[:, 1 : 1 + FULL], order)
        rows, picked = _pairs(own, source, tolerance, "covariance")
        if source.values.shape[1] == 1 + BOTH:
            cross = _cross(own, source, rows, picked, order)
    if covariance is None:
        of = f"lines of t and {FULL} numbers, or name its columns: --columns 'P*=NAME*'"
        if isinstance(own, States):
            of = f"the standard deviations of {DEVIATIONS_LAYOUT}"
        raise InputError(f"{own.path}: holds no covariance; give --covariance FILE, {of}")
    covariance = covariance[:, : 6 + k, : 6 + k]
    P = np.full((len(own.t), 6 + k, 6 + k), np.nan)
    if source is not own:
        covariance = covariance[picked]
    P[rows] = symmetric(covariance, lambda row: source.place(int(picked[row])), one_triangle=True)
    with_P = np.zeros(len(own.t), bool)
    with_P[rows] = True
    of_truth = _of_truth(truth, own, order, r)
    own = own.of(slice(0, POSE))
    place = Places(own.place, np.arange(len(own.t)))
    return Poses(
        place, own.t, _states(own, k), P, with_P, truth.t, _states(truth, k), "spatial", convention, tolerance, cross,
        of_truth,
    )  # fmt: skip


def _states(lines: Lines, k: int) -> Array:
    """Poses with the first ``k`` numbers of velocity and biases behind them, (N, 7 + k)."""
    pose = lines.values[:, 1:POSE]
    if lines.rest is None or not k:
        return pose
    return np.column_stack([pose, lines.rest[:, :k]])


def _width(lines: Lines) -> int:
    """Components whose covariance or deviations stand behind the poses."""
    stated = lines.values.shape[1] - POSE
    return next((n for n in DEVIATIONS if stated in (n, n * n, n * (n + 1) // 2)), 6)


def require_error(own: Lines, error: str | None) -> None:
    """Refuse covariances of states whose error is not declared, and an error of states for poses alone."""
    if _width(own) > 6 and error is None:
        what = f"{own.path}: holds a covariance of poses with their velocity, whose error is not known"
        raise InputError(f"{what}; add --error {', '.join(INERTIAL)} ('guess' is for poses alone)")
    if _width(own) == 6 and error not in (None, *SPATIAL):
        raise InputError(f"--error {error}: for a trajectory in space it is one of {', '.join(SPATIAL)}")


def judged_rest(own: Lines, true: Lines, r: Reading) -> tuple[int, str]:
    """How many numbers of velocity and biases are judged beside the poses, and a note where they are not."""
    stated = 9 if isinstance(own, States) else _width(own) - 6
    k = min(stated, *(0 if lines.rest is None else lines.rest.shape[1] for lines in (own, true)))
    moving = {"--relative": r.relative, "--align": r.align, "--truth-covariance": r.truth_covariance}
    options = [option for option, value in moving.items() if value is not None]
    if k and options:
        return 0, f"{own.path}: with {options[0]} the poses alone are judged, not their velocities and biases"
    if k < stated and not isinstance(own, States):
        what = "biases" if k else "velocities"
        return k, f"{true.path}: holds no {what}, so that those of {own.path} are not judged"
    return k, ""


def _unused(truth: Lines, r: Reading) -> str:
    """A note on a covariance of the truth that nothing is done with, "" without one."""
    stated = isinstance(truth, Fixes) or bool((truth.values[:, POSE:] > 0).any())
    if r.truth_covariance is not None or not stated or isinstance(truth, States):
        return ""
    return f"{truth.path}: the truth states a covariance of its own, which counts as 0; see --truth-covariance columns"


def _of_truth(truth: Lines, own: Lines, order: str, r: Reading) -> Array | None:
    """Covariance of the truth, (M, 6, 6) or of fixes (M, 3, 3): of its columns, or of a file; NaN without one."""
    if r.truth_covariance is None:
        return None
    if r.truth_covariance == COLUMNS:
        P = truth.values[:, 4:].reshape(-1, 3, 3) if isinstance(truth, Fixes) else _inline(truth, order)
        if P is None:
            raise InputError(
                f"--truth-covariance {COLUMNS}: {truth.path} has none; give a file of t and {FULL} numbers"
            )
        return symmetric(P[:, :6, :6], truth.place, one_triangle=True)
    path = Path(r.truth_covariance)
    source = read_covariances(_same_stem(path, own.path, "--truth-covariance") if path.is_dir() else path)
    rows, picked = _pairs(truth, source, r.tolerance, "covariance")
    out = np.full((len(truth.t), 6, 6), np.nan)
    P = _matrices(source.values[picked, 1 : 1 + FULL], order)
    out[rows] = symmetric(P, lambda row: source.place(int(picked[row])), one_triangle=True)
    return out


def _cross(own: Lines, source: Lines, rows: Indices, picked: Indices, order: str) -> Array:
    """Cross-covariances with the line before, on the rows of ``own``, (N, 6, 6)."""
    what = "but the cross-covariance of the next line is with this one; give each line its pose"
    gap = np.diff(picked) != 1
    refuse(gap, lambda row: source.place(int(picked[row]) + 1), f"no pose of {own.path} has this time, {what}")
    out = np.full((len(own.t), 6, 6), np.nan)
    out[rows] = _matrices(source.values[picked, 1 + FULL :], order)
    return out


def _pairs(own: Lines, other: Lines, tolerance: float, what: str) -> tuple[Indices, Indices]:
    rows, match = associate(own.t, other.t, tolerance)
    if not len(rows):
        raise nothing_near((own.path, other.path), own.t, other.t, tolerance, "estimate", what)
    return rows, match


# --- files ---------------------------------------------------------------------------------------


def read_trajectory(path: Path, true: bool = False, columns: Columns | None = None) -> Lines:
    """A trajectory, checked: increasing timestamps, quaternions of unit length; NaN only in estimates."""
    return _checked(read_poses(path, true, columns), true)


def _checked(lines: Lines, true: bool = True) -> Lines:
    """Poses whose quaternions have unit length, and which are finite if they are a truth."""
    pose = lines.values[:, 1:POSE]
    finite = np.isfinite(pose).all(axis=1)
    if true:
        refuse(~finite, lines.place, "the truth is not finite; leave such lines out")
    if _is_point(lines):
        return lines
    length = np.linalg.norm(pose[:, 3:], axis=1)
    bad = finite & (np.abs(length - 1.0) > UNIT)
    whole = lines.without_cut(bad)
    if whole is not lines:
        return whole
    columns = f"columns {'2 to 5' if isinstance(lines, States) else '5 to 8'} must be qx qy qz qw"
    where = lines.note.partition(": ")[2] or columns
    refuse(bad, lines.place, lambda row: f"the quaternion has length {length[row]:.4g}, not 1; {where}")
    return lines


def read_covariances(path: Path) -> Lines:
    """A file of covariances: t, then 36 numbers row by row, or the 21 of the upper triangle.

    72 numbers are the 36 and the cross-covariance E e_before e' with the line before, row by row.
    """
    widths, layout = (1 + TRIANGLE, 1 + FULL, 1 + BOTH), f"t and {FULL} numbers, or t and {TRIANGLE}, or t and {BOTH}"
    return read_numbers(path, widths, layout)


def _inline(own: Lines, order: str) -> Array | None:
    numbers = own.values[:, POSE:]
    if not numbers.shape[1]:
        return None
    if numbers.shape[1] in DEVIATIONS:
        return diagonal(numbers[:, covariance_order(numbers.shape[1], order)])
    if own.values.shape[1] == SPLIT:  # rotation, then position
        rotation, position = _triangle(numbers[:, :6], 3), _triangle(numbers[:, 6:], 3)
        out = np.zeros((len(numbers), 6, 6))
        out[:, :3, :3], out[:, 3:, 3:] = position, rotation
        return out
    return _matrices(numbers, order)


def _matrices(numbers: Array, order: str) -> Array:
    """(N, n^2) or its upper triangle -> (N, n, n), translation first; n is 6, 9 or 15."""
    n = next(n for n in DEVIATIONS if numbers.shape[1] in (n * n, n * (n + 1) // 2))
    P = numbers.reshape(-1, n, n) if numbers.shape[1] == n * n else _triangle(numbers, n)
    if order != ORDERS[0]:
        P = P[:, covariance_order(n, order)][:, :, covariance_order(n, order)]
    return np.asarray(P)


def covariance_order(n: int, order: str) -> list[int]:
    """Places of x, y, z, the rotation and n - 6 more among components in an order."""
    there = BLOCKS_OF_STATE[: n // 3]
    blocks = [block for block in blocks_in(n, order) if block in there]
    return [3 * blocks.index(block) + i for block in there for i in range(3)]


def blocks_in(n: int, order: str) -> list[str]:
    """Blocks of a covariance (n, n) in an order, which may leave out the last ones."""
    names = {ORDERS[0]: "p,R", ORDERS[1]: "R,p"}.get(order, order).split(",")
    return [*names, *(block for block in BLOCKS_OF_STATE[: n // 3] if block not in names)]


def _order_note(path: Path | str, n: int, r: Reading) -> list[str]:
    """The order of the blocks: where it is declared, or where no names of columns tell that of three or more."""
    order = r.covariance_order
    blocks, there = blocks_in(n, order or ORDERS[0]), BLOCKS_OF_STATE[: n // 3]
    if sorted(blocks) != sorted(there):
        blocks_of_file = f"the blocks {','.join(there)} of {path} in their order, such as {','.join(reversed(there))}"
        raise InputError(
            f"--covariance-order {order}: must be {' or '.join(ORDERS)}, or {blocks_of_file} "
            "(p position, R rotation, v velocity, bg, ba biases)"
        )
    head = None if n == 6 or order else head_of(Path(path), r.columns)
    if order is None and (n == 6 or (head is not None and not any(map(numbered, head.names)))):
        return []
    return [f"{path}: the covariance is read in the order {', '.join(blocks)}; --covariance-order declares another one"]


def _triangle(numbers: Array, n: int) -> Array:
    out = np.empty((len(numbers), n, n))
    i, j = np.triu_indices(n)
    out[:, i, j] = out[:, j, i] = numbers
    return out
