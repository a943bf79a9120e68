"""TUM trajectories: lines ``t tx ty tz qx qy qz qw``, the covariances in the same line or in a file of their own."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np

from consistency.referee.diagnostics import Evidence
from consistency.referee.diagnostics.records.large_arrays import diagonal
from consistency.referee.errors import InputError
from consistency.referee.geometry.conventions import INERTIAL, SPATIAL
from consistency.referee.readers.formats.file_kinds import TABLES, is_drive, trajectory_files
from consistency.referee.readers.formats.geodetic import Fixes, localised
from consistency.referee.readers.formats.kitti_files import read_drive
from consistency.referee.readers.formats.named_columns import head_of, numbered
from consistency.referee.readers.formats.pose_rows import (
    DEVIATIONS,
    DEVIATIONS_LAYOUT,
    FULL,
    POINT,
    POSE,
    SPLIT,
    TRIANGLE,
    States,
    read_deviations,
    read_poses,
)
from consistency.referee.readers.formats.position_truth import fixed, placeholder, position_source, positions
from consistency.referee.readers.formats.sheet import Lines, read_numbers
from consistency.referee.readers.options import COLUMNS, Reading
from consistency.referee.readers.pipeline.records import (
    ALONE,
    BLOCKS,
    POINTS,
    SINGLE,
    STATE,
    WHOLE,
    TrajectorySource,
    apart,
    recordings_of,
    require_axes,
)
from consistency.referee.readers.places import Places, refuse
from consistency.referee.readers.runs_to_record import symmetric
from consistency.referee.readers.truth_matching import NamedPoses, Poses, associate
from consistency.referee.readers.windows import Relative
from consistency.referee.types import Array, Indices

ORDERS = ("translation-rotation", "rotation-translation")
BLOCKS_OF_STATE = ("p", "R", "v", "bg", "ba")  # three components each, in the order of STATE
BOTH = 2 * FULL  # and a cross-covariance with the line before
UNIT = 1e-3  # quaternions of four decimals pass


def read_tum(estimates: Path, r: Reading, relative: Relative | None = None) -> list[Evidence]:
    """Evidence of one estimator: a file, or a folder with a file for each run.

    With axes named only these components of the error are judged, by their part of the covariance.

    With the 20 columns that the tools of OpenVINS write, position and rotation are two recordings: their
    cross-covariance is not in the file, so a joint NEES would be wrong. With the states and standard deviations of a
    simulation each component is one. The truth may be a drive of KITTI.
    """
    if r.error not in (None, *INERTIAL):
        raise InputError(f"--error {r.error}: for a trajectory in space it is one of {', '.join(SPATIAL)}")
    require_axes(r.axes, STATE)
    if r.truth is None:
        raise InputError(f"{estimates}: a trajectory needs --truth FILE, the true one in the same form")
    files = _runs(estimates, r.truth, r.covariance)
    truth_of = _truths(r)
    runs = ((read_trajectory(path), truth_of(true), P, list[str]()) for path, true, P in files)
    source, poses, parts = poses_of(estimates, [(path, true) for path, true, _ in files], runs, r, relative)
    return recordings_of(source, poses, parts, r, relative)


def poses_of(
    estimates: Path,
    files: Sequence[tuple[Path | str, Path | str]],
    runs: Iterable[tuple[Lines, Lines, Path | None, list[str]]],
    r: Reading,
    relative: Relative | None = None,
    why: str = "",
    mixed: str = "",
) -> tuple[TrajectorySource, list[Poses], Mapping[str, range]]:
    """Runs before any error is taken, with their origin, and the components whose covariance is known.

    Parameters
    ----------
    files : of each run: its estimates, its truth
    runs : estimates and truth, a file of covariances where they are not in the lines, and notes
    why : reason for the default error, as the end of a note; that of the layout where empty
    mixed : message where runs are of different layouts
    """
    order = r.covariance_order or ORDERS[0]
    parts: Mapping[str, range] = WHOLE
    poses: list[Poses] = []
    notes: list[str] = []
    for (path, _), (own, true, P_path, said) in zip(files, runs, strict=True):
        own, true, world = localised(own, true)
        notes += [note for note in (own.note, true.note, world, unused(true, r), *said) if note]
        if not poses:
            parts, is_fixed = _parts(own), isinstance(own, Fixes)
            error_kind = r.error or ("so3" if parts in (WHOLE, ALONE) else "so3-body")
            require_error(own, r.error)
            notes += _order_note(path, _width(own), r.covariance_order)
        if parts not in (WHOLE, ALONE) and r.covariance_order not in (None, ORDERS[1]):
            raise InputError(f"--covariance-order: {path} is written by OpenVINS, rotation before translation")
        if _parts(own) is not parts:
            raise InputError(mixed or f"{path}: has {own.values.shape[1]} columns, {files[0][0]} another layout")
        if isinstance(own, Fixes):
            poses.append(fixed(own, true, r, of_truth(true, own, ORDERS[0], r)))
            continue
        k, unjudged = judged_rest(own, true, r, relative)
        notes += [unjudged] * bool(unjudged)
        poses.append(_poses(own, true, P_path, error_kind, order, r, k))
        if _is_point(true):
            poses[-1] = positions(poses[-1], r.lever_arm or (0.0, 0.0, 0.0), parts is not WHOLE)
    if poses[0].manifold == "spatial" and r.axes is None and relative is None:
        empty, what = placeholder(poses)
        notes += [f"{files[0][1]}: {what}"] * bool(what)
        if empty:
            poses = [positions(one, r.lever_arm or (0.0, 0.0, 0.0), parts is not WHOLE) for one in poses]
    why = "" if r.error else why or f"; the default of this layout, {_origin(parts)}"
    source = TrajectorySource(estimates, files, r.covariance or estimates, why, tuple(dict.fromkeys(notes)))
    if any(one.manifold == "vector" for one in poses):
        source = position_source(source, poses, "" if is_fixed else error_kind, r, relative)
    elif r.lever_arm is not None:
        raise InputError("--lever-arm: goes with a truth of positions alone; this one has the orientation of its body")
    return source, poses, parts


def _truths(r: Reading) -> Callable[[Path], Lines]:
    @lru_cache(maxsize=1)
    def read(path: Path) -> Lines:
        return read_drive(path, r.body) if is_drive(path) else read_trajectory(path, true=True)

    return read


def _is_point(lines: Lines) -> bool:
    return lines.values.shape[1] == POINT or isinstance(lines, Fixes)


def _parts(own: Lines) -> Mapping[str, range]:
    """Components whose covariance is known, by the layout of a file."""
    if isinstance(own, Fixes):
        return ALONE if own.alone else POINTS
    if isinstance(own, States):
        return SINGLE
    stated = own.values.shape[1] - POSE
    return BLOCKS if stated == SPLIT - POSE else ALONE if stated in DEVIATIONS else WHOLE


def _origin(parts: Mapping[str, range]) -> str:
    if parts in (WHOLE, ALONE):
        return "as in ROS messages with a covariance; declare yours with --error"
    if parts is POINTS:
        return "positions alone"
    return "written by OpenVINS" + "; --error so3 where it comes from another ROS topic" * (parts is BLOCKS)


def _runs(estimates: Path, truth: Path, covariance: Path | None) -> list[tuple[Path, Path, Path | None]]:
    """Files of every run: estimates, truth, covariance."""
    if not estimates.is_dir():
        for option, path in (("--truth", truth), ("--covariance", covariance)):
            if path is not None and path.is_dir() and not (option == "--truth" and is_drive(path)):
                raise InputError(f"{option} {path}: is a folder, but {estimates} is one file")
        return [(estimates, truth, covariance)]
    files = trajectory_files(estimates)
    if not files:
        tables = any(path.suffix.lower() in TABLES for path in estimates.iterdir())
        hint = "; tables of several runs go into one file with a column 'run'" * tables
        raise InputError(f"{estimates}: holds no .txt or .tum file and no manifest.json{hint}")
    stems = [path.stem for path in files]
    if twice := next((path for path in files if stems.count(path.stem) > 1), None):
        raise InputError(f"{estimates}: holds the run '{twice.stem}' twice, as .txt and .tum; keep one of them")
    if covariance is not None and not covariance.is_dir():
        raise InputError(f"--covariance {covariance}: must be a folder like {estimates}, a file for each run")
    out = []
    for path in files:
        own_truth = _same_stem(truth, path, "--truth") if truth.is_dir() and not is_drive(truth) else truth
        own_covariance = None if covariance is None else _same_stem(covariance, path, "--covariance")
        out.append((path, own_truth, own_covariance))
    return out


def _same_stem(folder: Path, path: Path, option: str) -> Path:
    if is_drive(folder / path.stem):
        return folder / path.stem
    matches = [other for other in trajectory_files(folder) if other.stem == path.stem]
    if not matches:
        raise InputError(f"{option} {folder}: holds no file '{path.stem}' with .txt or .tum for {path}")
    return matches[0]


def _poses(
    own: Lines,
    truth: Lines,
    covariance_path: Path | None,
    convention: str,
    order: str,
    r: Reading,
    k: int,
) -> Poses:
    """A run with its truth, of poses and ``k`` numbers of velocity and biases; P is NaN where none is near."""
    tolerance = r.tolerance
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
        of = (
            f"the standard deviations of {DEVIATIONS_LAYOUT}"
            if isinstance(own, States)
            else f"lines of t and {FULL} numbers"
        )
        raise InputError(f"{own.path}: holds no covariance; give --covariance FILE, {of}")
    covariance = covariance[:, : 6 + k, : 6 + k]
    P = np.full((len(own.t), 6 + k, 6 + k), np.nan)
    P[rows] = symmetric(covariance if source is own else covariance[picked], lambda row: source.place(int(picked[row])))
    with_P = np.zeros(len(own.t), bool)
    with_P[rows] = True
    own = own.of(slice(0, POSE))
    estimate, true = (
        np.column_stack([each.values[:, 1:POSE], each.rest[:, :k]])
        if k and each.rest is not None
        else each.values[:, 1:POSE]
        for each in (own, truth)
    )
    place = Places(own.place, np.arange(len(own.t)))
    return Poses(
        place, own.t, estimate, P, with_P, truth.t, true, "spatial", convention, tolerance, cross,
        of_truth(truth, own, order, r),
    )  # fmt: skip


def _width(lines: Lines) -> int:
    """Components whose covariance or deviations stand behind the poses."""
    stated = lines.values.shape[1] - POSE
    return next((n for n in DEVIATIONS if stated in (n, n * n, n * (n + 1) // 2)), 6)


def require_error(own: Lines, error: str | None) -> None:
    """Refuse covariances of states whose error is not declared, and an error of states for poses alone."""
    if _width(own) > 6 and error is None:
        what = f"{own.path}: holds a covariance of poses with their velocity, whose error is not known"
        raise InputError(f"{what}; add --error {', '.join(INERTIAL)}")
    if _width(own) == 6 and error not in (None, *SPATIAL):
        raise InputError(f"--error {error}: for a trajectory in space it is one of {', '.join(SPATIAL)}")


def judged_rest(own: Lines, true: Lines, r: Reading, relative: Relative | None) -> tuple[int, str]:
    """How many numbers of velocity and biases are judged beside the poses, and a note where they are not."""
    stated = 9 if isinstance(own, States) else _width(own) - 6
    k = min(stated, *(0 if lines.rest is None else lines.rest.shape[1] for lines in (own, true)))
    moving = {"--relative": relative, "--align": r.align, "--truth-covariance": r.truth_covariance}
    options = [option for option, value in moving.items() if value is not None]
    if k and options:
        return 0, f"{own.path}: with {options[0]} the poses alone are judged, not their velocities and biases"
    if k < stated and not isinstance(own, States):
        what = "biases" if k else "velocities"
        return k, f"{true.path}: holds no {what}, so that those of {own.path} are not judged"
    return k, ""


def unused(truth: Lines, r: Reading) -> str:
    """A note on a covariance of the truth that nothing is done with, "" without one."""
    stated = isinstance(truth, Fixes) or bool((truth.values[:, POSE:] > 0).any())
    if r.truth_covariance is not None or not stated or isinstance(truth, States):
        return ""
    return f"{truth.path}: the truth states a covariance of its own, which counts as 0; see --truth-covariance columns"


def of_truth(truth: Lines, own: Lines, order: str, r: Reading) -> Array | None:
    """Covariance of the truth, (M, 6, 6) or of fixes (M, 3, 3): of its columns, or of a file; NaN without one."""
    if r.truth_covariance is None:
        return None
    if r.truth_covariance == COLUMNS:
        P = truth.values[:, 4:].reshape(-1, 3, 3) if isinstance(truth, Fixes) else _inline(truth, order)
        if P is None:
            raise InputError(
                f"--truth-covariance {COLUMNS}: {truth.path} has none; give a file of t and {FULL} numbers"
            )
        return symmetric(P[:, :6, :6], truth.place)
    path = Path(r.truth_covariance)
    source = read_covariances(_same_stem(path, own.path, "--truth-covariance") if path.is_dir() else path)
    rows, picked = _pairs(truth, source, r.tolerance, "covariance")
    out = np.full((len(truth.t), 6, 6), np.nan)
    P = _matrices(source.values[picked, 1 : 1 + FULL], order)
    out[rows] = symmetric(P, lambda row: source.place(int(picked[row])))
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
        raise apart(own.path, own.t, other.path, other.t, tolerance, what)
    return rows, match


# --- files ---------------------------------------------------------------------------------------


def read_trajectory(path: Path, true: bool = False) -> Lines:
    """A trajectory, checked: increasing timestamps, quaternions of unit length; NaN only in estimates."""
    lines = read_poses(path, true)
    pose = lines.values[:, 1:POSE]
    finite = np.isfinite(pose).all(axis=1)
    if true:
        refuse(~finite, lines.place, "the truth is not finite; leave such lines out")
    if _is_point(lines):
        return lines
    length = np.linalg.norm(pose[:, 3:], axis=1)
    columns = f"columns {'2 to 5' if isinstance(lines, States) else '5 to 8'} must be qx qy qz qw"
    where = lines.note.partition(": ")[2] or columns
    bad = finite & (np.abs(length - 1.0) > UNIT)
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
        return diagonal(numbers[:, _turned(numbers.shape[1], order)])
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
        P = P[:, _turned(n, order)][:, :, _turned(n, order)]
    return np.asarray(P)


def _turned(n: int, order: str) -> list[int]:
    """Places of x, y, z, the rotation and n - 6 more among components in an order."""
    there = BLOCKS_OF_STATE[: n // 3]
    blocks = [block for block in blocks_in(n, order) if block in there]
    return [3 * blocks.index(block) + i for block in there for i in range(3)]


def blocks_in(n: int, order: str) -> list[str]:
    """Blocks of a covariance (n, n) in an order, which may leave out the last ones."""
    names = {ORDERS[0]: "p,R", ORDERS[1]: "R,p"}.get(order, order).split(",")
    return [*names, *(block for block in BLOCKS_OF_STATE[: n // 3] if block not in names)]


def _order_note(path: Path | str, n: int, order: str | None) -> list[str]:
    """The order of the blocks: where it is declared, or where no names of columns tell that of three or more."""
    blocks, there = blocks_in(n, order or ORDERS[0]), BLOCKS_OF_STATE[: n // 3]
    if sorted(blocks) != sorted(there):
        has = (
            f"the blocks {','.join(there)} of {path} (p position, R rotation, v velocity, bg, ba biases), as they stand"
        )
        raise InputError(f"--covariance-order {order}: must be {' or '.join(ORDERS)}, or {has}")
    head = None if n == 6 or order else head_of(Path(path))
    if order is None and (n == 6 or (head is not None and not any(map(numbered, head.names)))):
        return []
    return [f"{path}: the covariance is read in the order {', '.join(blocks)}; --covariance-order declares another one"]


def _triangle(numbers: Array, n: int) -> Array:
    out = np.empty((len(numbers), n, n))
    i, j = np.triu_indices(n)
    out[:, i, j] = out[:, j, i] = numbers
    return out


# --- poses alone -------------------------------------------------------------------------------------


def trajectory_poses(estimates: Path, r: Reading) -> Iterator[NamedPoses]:
    """Poses of each run of a file or folder beside a truth with orientations; covariances are not looked at."""
    if r.truth is None:
        raise InputError(f"{estimates}: a trajectory needs --truth FILE, the true one in the same form")
    truth_of = _truths(r)
    for path, true_path, _ in _runs(estimates, r.truth, None):
        own, truth = read_trajectory(path), truth_of(true_path)
        for lines, name in ((own, path), (truth, true_path)):
            if _is_point(lines):
                raise InputError(f"{name}: holds positions alone; motions need orientations, too")
        yield bare_poses(path.stem, own, truth, r)


def bare_poses(name: str, own: Lines, truth: Lines, r: Reading) -> NamedPoses:
    """A run of poses in space without covariances."""
    place, pose = Places(own.place, np.arange(len(own.t))), slice(1, POSE)
    poses = Poses.bare(place, own.t, own.values[:, pose], truth.t, truth.values[:, pose], "spatial", r.tolerance)
    return NamedPoses(name, poses, own.t)
