"""Poses in space as rows ``t x y z qx qy qz qw`` with a covariance, from every layout of text that they come in.

Rotations are checked. Planar poses may be made of them, or of speeds and turn rates.

The layout is told by the names of the columns, or by their number and what they hold.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from consistency.referee.column_names import POSE
from consistency.referee.diagnostics.whitening import diagonal
from consistency.referee.errors import InputError
from consistency.referee.geometry import INERTIAL, SPATIAL, wrap
from consistency.referee.readers.clocks import UNIT_NAMES, nothing_near
from consistency.referee.readers.formats.columns import (
    PLAIN,
    Clock,
    Columns,
    PoseColumns,
    clock_of,
    is_numbered,
    naming,
    pose_columns,
    rates_in,
    require_units,
    state_columns,
    true_pose_columns,
)
from consistency.referee.readers.formats.file_kinds import Head, are_poses, head_of, is_solution
from consistency.referee.readers.formats.positions import read_solution
from consistency.referee.readers.formats.sheet import TableRows, sheet_of
from consistency.referee.readers.formats.table_columns import times_of
from consistency.referee.readers.formats.text_blocks import Lines, increasing, read_numbers, read_rows
from consistency.referee.readers.options import Reading
from consistency.referee.readers.places import refuse
from consistency.referee.readers.runs_to_record import symmetric
from consistency.referee.readers.truth_matching import associate, finite_rows
from consistency.referee.types import Array, Indices

POSE_NUMBERS = 8  # columns of a pose
SPLIT = 20  # of a pose and two 3 x 3 covariances without a cross-covariance
FULL = 36  # numbers of a 6 x 6 covariance row by row
TRIANGLE = 21  # of its upper triangle
POINT = 4  # columns of a truth of positions alone: t, x, y, z
DEVIATIONS = (6, 9, 15)  # of a pose, with a velocity, with two biases
DEVIATED = POSE_NUMBERS + 6  # columns of a pose and six standard deviations
TUM = (POSE_NUMBERS, SPLIT, POSE_NUMBERS + TRIANGLE, POSE_NUMBERS + FULL)
ASL = 17  # columns of the truth of EuRoC: t in ns, position, quaternion w first, velocity, two biases
MATRICES = {12: 0, 13: 1, 16: 0, 17: 1}  # by columns of a matrix, 3 x 4 or 4 x 4, and of its time or number: the latter
STATED = (0, TRIANGLE, FULL)  # columns of a covariance behind a matrix
MATRIX_WIDTHS = {matrix + stated: (first, matrix) for matrix, first in MATRICES.items() for stated in STATED}
LAYOUT = f"t tx ty tz qx qy qz qw ({', '.join(map(str, TUM))} columns)"
AS_ESTIMATED = "poses with the standard deviations of x, y, z and of the rotation about x, y, z, in m and rad"

CAMERAS, CALIBRATION = 18, 15  # column with the number of cameras, and numbers of each one's calibration
LARGEST = 200  # columns, of more cameras than OpenVINS takes
STATES = range(CAMERAS + 1 + CALIBRATION, LARGEST)  # columns of a state
DEVIATION_WIDTHS = range(CAMERAS + CALIBRATION - 1, LARGEST)  # of its deviations: a rotation has three, not four
AS_TUM = [0, 5, 6, 7, 1, 2, 3, 4]  # t, position and quaternion in the order of TUM
REST = slice(8, 17)  # velocity, biases
SIGMA = [4, 5, 6, 1, 2, 3, *range(7, 16)]  # position, rotation, velocity, biases
DEVIATIONS_LAYOUT = (
    "t, three standard deviations of the rotation, rad, three of the position, m, and those of the rest of the state"
)
ORDERS = ("translation-rotation", "rotation-translation")
BLOCKS = ("p", "R", "v", "bg", "ba")  # three components each, in the order of a state
BOTH = 2 * FULL  # and a cross-covariance with the line before
TOLERANCE = 1e-3  # largest entry of R R' - I
UNIT = 1e-3  # of the length of a quaternion: four decimals pass


def read_poses(path: Path, true: bool = False, columns: Columns | None = None) -> Lines:
    """Lines (N, 8, or more with a covariance) as in a TUM trajectory, whatever layout they have in the file.

    Parameters
    ----------
    columns : names of columns in place of the file's own

    Raises
    ------
    InputError
        The layout is none of those known, a row is broken, or timestamps do not increase.
    """
    if is_solution(path):
        return read_solution(path)
    head = head_of(path, columns)
    found = None if head is None else pose_columns(head.names, path)
    if head is None or found is None or (head.comment and found.is_tum and len(head.names) in TUM):
        return _unnamed(path, true, head)
    if not (found.quaternion or true):
        raise InputError(f"{path}: holds no quaternion; a table of a state is read with --state x,y,z; {naming('qx')}")
    return _named(head, found, true)


def read_beside(path: Path, columns: Columns | None = None) -> Lines | None:
    """The truth in columns beside the estimates of a file with names, in rows that have one; None without any."""
    head = head_of(path, columns)
    found = None if head is None else true_pose_columns(head.names, path)
    if head is None or found is None or not found.quaternion:
        return None
    lines = _named(head, found, True)
    finite = finite_rows(lines.values)
    return replace(lines.rows(finite), rest=None, note=f"{path}: the truth stands in columns beside the estimates")


def on_plane(lines: Lines, unit: str) -> TableRows:
    """Columns t, x, y and heading of poses in space, which is that of the x axis.

    Raises
    ------
    InputError
        They are positions without orientations, or a quaternion has not length 1.
    """
    if lines.values.shape[1] < POSE_NUMBERS:
        raise InputError(
            f"{lines.path}: holds positions without orientations, and a planar pose needs a heading; give a file with "
            "a heading or a quaternion, or judge positions alone: --state x,y with a truth table of columns t, x, y"
        )
    bad, length = not_unit(lines.values[:, 1:POSE_NUMBERS])
    refuse(bad, lines.place, lambda row: f"the quaternion has length {length[row]:.4g}, not 1")
    ahead = Rotation.from_quat(lines.values[:, 4:POSE_NUMBERS]).apply([1.0, 0.0, 0.0])
    heading = np.arctan2(ahead[:, 1], ahead[:, 0])
    t, x, y = lines.values[:, :3].T
    columns = {"t": t, "x": x, "y": y, "heading": heading}
    return TableRows(lines.path, columns, lines.line, unit, lines.open_line, lines.cut)


# --- columns with names ------------------------------------------------------------------------------


def _named(head: Head, found: PoseColumns, true: bool) -> Lines:
    """Rows under the names of their columns."""
    sheet = sheet_of(head)
    _require_one_run(sheet)

    def numbers(places: Sequence[int]) -> list[Array]:
        columns = [head.names[place] for place in places]
        require_units(columns, head.path)
        return list(map(sheet.numbers, columns))

    t, unit = times_of(sheet, found.clock, numbers(found.clock.places))
    stated = numbers(found.covariance)
    if found.squared:
        stated = [np.sign(each) * np.sqrt(np.abs(each)) for each in stated]
    rest = None
    if found.rest:
        rest = np.column_stack(numbers(found.rest))
    pose = numbers(found.position + found.quaternion)
    values = np.column_stack([t, *pose, *stated])
    note = _named_note(head, found, true, UNIT_NAMES[unit])
    lines = Lines(
        head.path, values, sheet.line, note, rest=rest, open_line=sheet.open_line, cut=sheet.cut, columns=sheet.data
    )
    return increasing(lines)


def _require_one_run(sheet: TableRows) -> None:
    """Refuse a file whose rows are of several runs or estimators."""
    if "run" in sheet or "filter" in sheet:
        what = "write such poses to a file for each run and estimator"
        raise InputError(f"{sheet.path}: column 'run' or 'filter': {what}")


def _named_note(head: Head, found: PoseColumns, true: bool, clock: str) -> str:
    of = found.kind
    order = "no orientation"
    if not true:
        of = of.replace(" truth", " poses")
    if len(found.clock.places) == 2:
        clock = "seconds and nanoseconds"
    if found.quaternion:
        order = "quaternion w first" if found.quaternion[3] < found.quaternion[0] else "quaternion w last"
    note = f"{head.path}: read as {of}, {len(head.names)} columns, {clock}, {order}"
    if not found.covariance:
        return note
    stated = "covariance"
    if found.squared:
        stated = "variances"
    elif len(found.covariance) in DEVIATIONS:
        stated = "standard deviations"
    return f"{note}, {stated} in {len(found.covariance)} columns"


# --- columns without names ---------------------------------------------------------------------------


def _unnamed(path: Path, true: bool, head: Head | None) -> Lines:
    """Rows of a layout that is told by the number of columns, and by what they hold."""
    widths = [*TUM, DEVIATED, *MATRIX_WIDTHS, *STATES]
    if true:
        widths.append(POINT)
    if head is not None and not head.comment and len(head.names) not in widths:
        missing = "t" if clock_of(head.names) is None else "x"
        names = ", ".join(head.names)
        raise InputError(f"{path}: column '{missing}' is missing; there are: {names}; {naming(missing)}")
    lines = read_rows(path, widths, LAYOUT)
    width = lines.values.shape[1]
    if width == POINT:
        return increasing(replace(lines, note=f"{path}: read as positions without orientations, {width} columns"))
    if width == DEVIATED:
        return increasing(replace(lines, note=f"{path}: read as {AS_ESTIMATED}, {width} columns"))
    if width in TUM:
        note = ""
        if path.suffix.lower() == ".csv":
            note = f"{path}: read as t x y z qx qy qz qw, as its columns have no names"
        return increasing(replace(lines, note=note))
    if width == ASL and not _are_rigid(lines.values[:, 1:]).all():
        return _asl(lines, true)
    if width in MATRIX_WIDTHS and (width not in STATES or _are_rigid(_matrix(lines)[1]).all()):
        return _poses_of_matrices(lines)
    states = as_states(increasing(lines))
    if states is None:
        raise InputError(f"{lines.place(0)}: has {width} columns; should be {LAYOUT}")
    return states


def _asl(lines: Lines, true: bool) -> Lines:
    """The 17 columns of EuRoC without their names."""
    t, unit = times_of(lines, Clock((0,), None), [lines.t])
    of = "truth" if true else "poses"
    note = f"{lines.path}: read as EuRoC {of}, {ASL} columns, {UNIT_NAMES[unit]}, quaternion w first"
    pose = lines.values[:, [1, 2, 3, 5, 6, 7, 4]]
    values = np.column_stack([t, pose])
    return increasing(replace(lines, values=values, note=note, rest=lines.values[:, POSE_NUMBERS:]))


def _matrix(lines: Lines) -> tuple[Array, Array, Array]:
    """What stands before the matrices, their numbers (N, 12 or 16), and covariances."""
    first, end = MATRIX_WIDTHS[lines.values.shape[1]]
    return lines.values[:, :first], lines.values[:, first:end], lines.values[:, end:]


def _are_rigid(numbers: Array) -> Indices:
    """Whether rows (N, 12) or (N, 16) are the matrix of a rotation and a translation, or not finite."""
    M = numbers.reshape(len(numbers), -1, 4)
    right = are_rotations(M[:, :3, :3])
    if M.shape[1] == 4:
        off = np.abs(M[:, 3] - [0.0, 0.0, 0.0, 1.0])
        right &= off.max(axis=1) < TOLERANCE
    return np.asarray(right | ~finite_rows(numbers))


def _poses_of_matrices(lines: Lines) -> Lines:
    """Matrices that turn body into world coordinates, row by row, behind a time or a number or neither."""
    before, numbers, covariance = _matrix(lines)
    what = f"the {numbers.shape[1]} numbers are not a rotation and translation, row by row"
    refuse(~_are_rigid(numbers), lines.place, f"{what}; should be these, or {LAYOUT}")
    t, clock = _clock(lines, before)
    M = numbers.reshape(len(numbers), -1, 4)
    quaternion = quaternions(M[:, :3, :3])
    quaternion[~finite_rows(numbers)] = np.nan
    note = f"{lines.path}: read as matrices of {M.shape[1]} x 4, {lines.values.shape[1]} columns, {clock}"
    values = np.column_stack([t, M[:, :3, 3], quaternion, covariance])
    return increasing(replace(lines, values=values, note=note))


def _clock(lines: Lines, before: Array) -> tuple[Array, str]:
    """Times of matrices: those before them, those of times.txt in the same folder, or their numbers from 0 on."""
    if before.shape[1]:
        t, unit = times_of(lines, Clock((0,), None), [before[:, 0]])
        if (t == np.round(t)).all():
            return t, "the first one the number of the step"
        return t, f"the first one the time in {UNIT_NAMES[unit]}"
    times = lines.path.parent / "times.txt"
    count = len(lines.line)
    if not times.is_file():
        return np.arange(float(count)), "numbered from 0 on, as there is no times.txt beside them"
    t = read_rows(times, (1,), "a time").t
    if len(t) != count:
        raise InputError(f"{times}: has {len(t)} times, but {lines.path} {count} poses")
    return t, f"times from {times.name} beside them"


# --- states of a simulation with OpenVINS ------------------------------------------------------------


class States(Lines):
    """Poses (N, 8) as in a TUM trajectory, of a simulation with OpenVINS: states, and a file of their deviations."""


def as_states(lines: Lines) -> States | None:
    """The poses in lines of whole states; None if the lines are not states.

    A state is t, the quaternion x, y, z, w, position, velocity, biases of gyroscope and accelerometer (three each), the
    offset of the clocks, the number of cameras, and their calibration. OpenVINS states the rotation from the world into
    the body as a JPL quaternion, whose four numbers are those of the rotation from the body into the world as a
    Hamilton quaternion.
    """
    if not _has_cameras(lines.values, CAMERAS, CALIBRATION):
        return None
    return States(lines.path, lines.values[:, AS_TUM], lines.line, rest=lines.values[:, REST])


def read_deviations(path: Path) -> tuple[Lines, Array]:
    """Standard deviations of states, and covariances (N, 15, 15) whose diagonal alone is known.

    They are of position, rotation, velocity and the biases of gyroscope and accelerometer.

    The rotation is the error about the axes of the body, in rad.
    """
    lines = read_numbers(path, DEVIATION_WIDTHS, DEVIATIONS_LAYOUT)
    if not _has_cameras(lines.values, CAMERAS - 1, CALIBRATION - 1):
        raise InputError(f"{lines.place(0)}: has {lines.values.shape[1]} columns; should be {DEVIATIONS_LAYOUT}")
    sigma = lines.values[:, SIGMA]
    refuse((sigma < 0).any(axis=1), lines.place, f"a standard deviation is below 0; should be {DEVIATIONS_LAYOUT}")
    return lines, diagonal(sigma)


def _has_cameras(values: Array, column: int, each: int) -> bool:
    """Whether a column holds a number of cameras, of which there are so many numbers each in the columns behind it."""
    cameras = values[:, column]
    width = column + 1 + each * cameras
    are_numbers = (cameras >= 1) & (cameras == np.round(cameras))
    return bool((are_numbers & (width <= values.shape[1])).all())


def components_in(numbers: int) -> int | None:
    """Components of a covariance of which a row holds n^2 numbers, the upper triangle, or n deviations."""
    return next((n for n in DEVIATIONS if numbers in (n, n * n, n * (n + 1) // 2)), None)


def components_of(lines: Lines) -> int:
    """Components whose covariance or deviations stand behind the poses; those of a pose where none do."""
    return components_in(lines.values.shape[1] - POSE_NUMBERS) or 6


def covariances_in(lines: Lines, order: str) -> Array | None:
    """Covariances (N, n, n), translation first, that stand behind the poses; None without any."""
    numbers = lines.values[:, POSE_NUMBERS:]
    if not numbers.shape[1]:
        return None
    if lines.values.shape[1] != SPLIT:
        return _matrices(numbers, order)
    out = np.zeros((len(numbers), 6, 6))  # two triangles: rotation, then position
    out[:, 3:, 3:] = _from_triangle(numbers[:, :6], 3)
    out[:, :3, :3] = _from_triangle(numbers[:, 6:], 3)
    return out


def matrices_of(source: Lines, order: str) -> Array:
    """Covariances (N, 6, 6), translation first, of the lines of a file of covariances."""
    return _matrices(source.values[:, 1 : 1 + FULL], order)


def _matrices(numbers: Array, order: str) -> Array:
    """Covariances (N, n, n), translation first, of numbers in the order of a file."""
    many = numbers.shape[1]
    n = components_in(many)
    assert n is not None
    places = covariance_order(n, order)
    if many == n:
        return diagonal(numbers[:, places])
    P = numbers.reshape(-1, n, n) if many == n * n else _from_triangle(numbers, n)
    if order == ORDERS[0]:
        return P
    return np.asarray(P[:, places][:, :, places])


def _from_triangle(numbers: Array, n: int) -> Array:
    out = np.empty((len(numbers), n, n))
    i, j = np.triu_indices(n)
    out[:, i, j] = out[:, j, i] = numbers
    return out


# --- the order of blocks -----------------------------------------------------------------------------


def covariance_order(n: int, order: str) -> list[int]:
    """Places of x, y, z, the rotation and n - 6 more among components in an order."""
    there = BLOCKS[: n // 3]
    blocks = [block for block in blocks_in(n, order) if block in there]
    return [3 * blocks.index(block) + i for block in there for i in range(3)]


def blocks_in(n: int, order: str) -> list[str]:
    """Blocks of a covariance (n, n) in an order, which may leave out the last ones."""
    names = {ORDERS[0]: "p,R", ORDERS[1]: "R,p"}.get(order, order).split(",")
    return [*names, *(block for block in BLOCKS[: n // 3] if block not in names)]


def order_note(path: Path | str, n: int, r: Reading) -> str:
    """The order of the blocks: where it is declared, or where no names of columns tell that of three or more.

    Raises
    ------
    InputError
        The declared order does not go with n components.
    """
    order = r.conventions.covariance_order
    blocks = blocks_in(n, order or ORDERS[0])
    there = BLOCKS[: n // 3]
    if sorted(blocks) != sorted(there):
        which = f"the blocks {','.join(there)} of {path} in their order, such as {','.join(reversed(there))}"
        names = "(p position, R rotation, v velocity, bg, ba biases)"
        raise InputError(f"--covariance-order {order}: must be {' or '.join(ORDERS)}, or {which} {names}")
    if order is None:
        head = None if n == 6 else head_of(Path(path), r.components.columns)
        if n == 6 or (head is not None and not any(map(is_numbered, head.names))):
            return ""
    return f"{path}: the covariance is read in the order {', '.join(blocks)}; --covariance-order declares another one"


def require_error(own: Lines, error: str | None) -> None:
    """Refuse covariances of states whose error is not declared, and an error of states for poses alone."""
    n = components_of(own)
    if n > 6 and error is None:
        what = f"{own.path}: holds a covariance of poses with their velocity, whose error is not known"
        raise InputError(f"{what}; add --error {', '.join(INERTIAL)} ('guess' is for poses alone)")
    if n == 6:
        require_spatial(error, SPATIAL)


def require_spatial(error: str | None, known: dict[str, str]) -> None:
    """Refuse an error that poses in space do not have."""
    if error not in (None, *known):
        raise InputError(f"--error {error}: for a trajectory in space it is one of {', '.join(SPATIAL)}")


# --- files of their own ------------------------------------------------------------------------------


def read_covariances(path: Path) -> Lines:
    """A file of covariances: t, then 36 numbers row by row, or the 21 of the upper triangle.

    72 numbers are the 36 and the cross-covariance E e_before e' with the line before, row by row.
    """
    layout = f"t and {FULL} numbers, or t and {TRIANGLE}, or t and {BOTH}"
    return read_numbers(path, (1 + TRIANGLE, 1 + FULL, 1 + BOTH), layout)


def nearest_rows(own: Lines, other: Lines, tolerance: float) -> tuple[Indices, Indices]:
    """Rows (k,) of some lines, and those of a file of covariances that are near in time."""
    rows, match = associate(own.t, other.t, tolerance)
    if not len(rows):
        raise nothing_near((own.path, other.path), own.t, other.t, tolerance, "estimate", "covariance")
    return rows, match


def from_file(lines: Lines, path: Path, order: str, tolerance: float) -> Array:
    """Covariances (N, 6, 6) of lines from a file of their own; NaN where it has none near in time."""
    source = read_covariances(path)
    rows, picked = nearest_rows(lines, source, tolerance)
    return on_rows(len(lines.t), rows, matrices_of(source, order)[picked], source, picked)


def on_rows(count: int, rows: Indices, P: Array, source: Lines, picked: Indices) -> Array:
    """Covariances (count, n, n) with ``P`` (k, n, n) in some rows, symmetric, and NaN in the others."""
    out = np.full((count, *P.shape[1:]), np.nan)
    out[rows] = symmetric(P, lambda row: source.place(int(picked[row])), one_triangle=True)
    return out


def cross_covariances(own: Lines, source: Lines, rows: Indices, picked: Indices, order: str) -> Array:
    """Cross-covariances with the line before, on the rows of ``own``, (N, 6, 6)."""
    what = "but the cross-covariance of the next line is with this one; give each line its pose"
    gap = np.diff(picked) != 1
    refuse(gap, lambda row: source.place(int(picked[row]) + 1), f"no pose of {own.path} has this time, {what}")
    out = np.full((len(own.t), 6, 6), np.nan)
    out[rows] = _matrices(source.values[picked, 1 + FULL :], order)
    return out


def are_rotations(R: Array) -> Indices:
    """Whether matrices (..., 3, 3) are rotations, (...) of bool; no matrix that is not finite is."""
    with np.errstate(invalid="ignore", over="ignore"):
        product = R @ np.swapaxes(R, -1, -2)
        off = np.abs(product - np.eye(3)).max(axis=(-2, -1))
        return np.asarray((off < TOLERANCE) & (np.linalg.det(R) > 0))


def quaternions(R: Array) -> Array:
    """Quaternions x, y, z, w (..., 4) of rotations (..., 3, 3); NaN where these are not finite."""
    matrices = R.reshape(-1, 3, 3)
    out = np.full((len(matrices), 4), np.nan)
    finite = finite_rows(matrices)
    if finite.any():  # older SciPy makes no empty rotations
        out[finite] = Rotation.from_matrix(matrices[finite]).as_quat()
    return out.reshape(*R.shape[:-2], 4)


def not_unit(pose: Array) -> tuple[Indices, Array]:
    """Which finite poses x, y, z, qx, qy, qz, qw (N, 7) have quaternions of another length than 1; all lengths (N,)."""
    length = np.linalg.norm(pose[:, 3:], axis=1)
    bad = finite_rows(pose) & (np.abs(length - 1.0) > UNIT)
    return np.asarray(bad), length


def read_plane(path: Path, head: Head | None, motions: bool = False) -> tuple[TableRows, str]:
    """A table with planar poses t, x, y, heading of a file that holds them otherwise, and what it was read as.

    Speeds and turn rates are integrated, each held from its row to the next: to the motion since the row before, in
    the frame of the body there, with ``motions``; else to poses from (0, 0, 0) on. Of poses in space it is the
    position and the heading of the x axis.

    Raises
    ------
    InputError
        Speeds are of several runs, or a row cannot be read.
    """
    if are_poses(path, head):
        lines = read_poses(path, true=True, columns=None if head is None else head.renaming)
        of = lines.note or f"{path}: read as poses in space"
        return on_plane(lines, "line"), f"{of}, of which the heading is that of the x axis"
    assert head is not None
    names = head.names
    clock = clock_of(names)
    assert clock is not None
    poses = state_columns(names, POSE, PLAIN)
    has_poses = len(poses) == len(POSE)
    moving = tuple(poses.values()) if has_poses else rates_in(names)
    require_units([names[place] for place in (*clock.places, *moving)], path)
    sheet = sheet_of(head)
    t, unit = times_of(sheet, clock, [sheet.numbers(names[place]) for place in clock.places])
    pose = sheet.matrix(names[place] for place in moving)
    of = "planar poses"
    if not has_poses:
        _require_one_run(sheet)
        what = "motions" if motions else "poses"
        of = f"speed and turn rate, each held until the next, integrated to {what}"
        pose = motions_of(t, *pose.T)
        if not motions:
            pose = poses_of(pose)
    data = dict(zip(["t", *POSE], [t, *pose.T], strict=True))
    note = f"{path}: read as {of}, {len(names)} columns, {UNIT_NAMES[unit]}"
    return replace(sheet, data=sheet.data | data), note


def motions_of(t: Array, v: Array, omega: Array) -> Array:
    """Motions (N, 3) since the row before: forward, left and turn, in the frame of the body there, m and rad.

    Arcs of circles: ``v`` and ``omega`` (N,), m/s and rad/s, hold from their time ``t``, s, to the next one. The first
    row is 0.
    """
    dt = np.diff(t)
    turn = omega[:-1] * dt
    way = v[:-1] * dt
    half = 0.5 * turn
    chord = way * np.sinc(half / np.pi)
    rows = np.column_stack([chord * np.cos(half), chord * np.sin(half), turn])
    return np.concatenate([np.zeros((1, 3)), rows])


def poses_of(motions: Array) -> Array:
    """Poses (N, 3) from (0, 0, 0) on, of motions as :func:`motions_of` gives them; headings within half a turn."""
    forward, left, turn = motions.T
    heading = np.cumsum(turn)
    before = np.concatenate([[0.0], heading[:-1]])
    c = np.cos(before)
    s = np.sin(before)
    steps = np.column_stack([c * forward - s * left, s * forward + c * left])
    return np.column_stack([np.cumsum(steps, axis=0), wrap(heading)])
