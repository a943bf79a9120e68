"""Poses in space as rows ``t x y z qx qy qz qw`` with a covariance, from every layout of text that they come in.

The layout is told by the names of the columns, or by their number and what they hold.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from consistency.referee.diagnostics.records.large_arrays import diagonal
from consistency.referee.errors import InputError
from consistency.referee.readers.clock_units import UNIT_NAMES
from consistency.referee.readers.formats.columns import PoseColumns, pose_columns, true_pose_columns
from consistency.referee.readers.formats.file_head import Head, head_of
from consistency.referee.readers.formats.file_kinds import is_solution
from consistency.referee.readers.formats.geodetic import read_solution
from consistency.referee.readers.formats.rotations import TOLERANCE, are_rotations, quaternions
from consistency.referee.readers.formats.sheet import OF_ONE_RUN, TableRows, sheet_of
from consistency.referee.readers.formats.spellings import Clock, Columns, clock_of, naming, require_units
from consistency.referee.readers.formats.table_columns import times_of
from consistency.referee.readers.formats.text_blocks import Lines, increasing, read_numbers, read_rows
from consistency.referee.readers.places import refuse
from consistency.referee.readers.truth_matching import finite_rows
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
    return _named(path, head, found, true, columns)


def read_beside(path: Path, columns: Columns | None = None) -> Lines | None:
    """The truth in columns beside the estimates of a file with names, in rows that have one; None without any."""
    head = head_of(path, columns)
    found = None if head is None else true_pose_columns(head.names, path)
    if head is None or found is None or not found.quaternion:
        return None
    lines = _named(path, head, found, True, columns)
    finite = finite_rows(lines.values)
    return replace(lines.rows(finite), rest=None, note=f"{path}: the truth stands in columns beside the estimates")


def on_plane(lines: Lines, unit: str) -> TableRows:
    """Columns t, x, y and heading of poses in space, which is that of the x axis.

    Raises
    ------
    InputError
        They are positions without orientations.
    """
    if lines.values.shape[1] < POSE_NUMBERS:
        raise InputError(
            f"{lines.path}: holds positions without orientations, and a planar pose needs a heading; give a file with "
            "a heading or a quaternion, or judge positions alone: --state x,y with a truth table of columns t, x, y"
        )
    ahead = Rotation.from_quat(lines.values[:, 4:POSE_NUMBERS]).apply([1.0, 0.0, 0.0])
    heading = np.arctan2(ahead[:, 1], ahead[:, 0])
    t, x, y = lines.values[:, :3].T
    columns = {"t": t, "x": x, "y": y, "heading": heading}
    return TableRows(lines.path, columns, lines.line, unit, lines.open_line, lines.cut)


# --- columns with names ------------------------------------------------------------------------------


def _named(path: Path, head: Head, found: PoseColumns, true: bool, columns: Columns | None) -> Lines:
    """Rows under the names of their columns."""
    sheet = sheet_of(path, head, columns)
    if "run" in sheet or "filter" in sheet:
        raise InputError(f"{path}: column 'run' or 'filter': {OF_ONE_RUN}")
    names = head.names

    def numbers(places: Sequence[int]) -> list[Array]:
        columns = [names[place] for place in places]
        require_units(columns, path)
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
    note = _named_note(path, head, found, true, UNIT_NAMES[unit])
    lines = Lines(
        path, values, sheet.line, note, rest=rest, open_line=sheet.open_line, cut=sheet.cut, columns=sheet.data
    )
    return increasing(lines)


def _named_note(path: Path, head: Head, found: PoseColumns, true: bool, clock: str) -> str:
    of = found.kind
    order = "no orientation"
    if not true:
        of = of.replace(" truth", " poses")
    if len(found.clock.places) == 2:
        clock = "seconds and nanoseconds"
    if found.quaternion:
        order = "quaternion w first" if found.quaternion[3] < found.quaternion[0] else "quaternion w last"
    note = f"{path}: read as {of}, {len(head.names)} columns, {clock}, {order}"
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
