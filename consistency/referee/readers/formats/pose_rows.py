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
from consistency.referee.readers.clock_units import UNIT_NAMES, unit_of
from consistency.referee.readers.formats.column_renaming import Columns
from consistency.referee.readers.formats.file_head import Head, fields_of, head_of
from consistency.referee.readers.formats.file_kinds import is_solution
from consistency.referee.readers.formats.geodetic import read_solution
from consistency.referee.readers.formats.named_columns import (
    Roles,
    clock_of,
    naming,
    require_units,
    roles_of,
    true_roles_of,
)
from consistency.referee.readers.formats.sheet import (
    Lines,
    TableRows,
    increasing,
    read_numbers,
    read_rows,
    read_sheet,
)
from consistency.referee.readers.formats.text_blocks import blocks
from consistency.referee.readers.places import refuse
from consistency.referee.types import Array, Indices

POSE, SPLIT = 8, 20  # columns: a pose; a pose and two 3 x 3 covariances without a cross-covariance
FULL, TRIANGLE = 36, 21  # a 6 x 6 covariance row by row, or its upper triangle
POINT = 4  # columns of a truth of positions alone: t, x, y, z
DEVIATIONS = (6, 9, 15)  # of a pose, with a velocity, with two biases
DEVIATED = POSE + 6  # columns of a pose and six standard deviations
TUM = (POSE, SPLIT, POSE + TRIANGLE, POSE + FULL)
ASL = 17  # columns of the truth of EuRoC: t in ns, position, quaternion w first, velocity, two biases
MATRICES = {12: (), 13: (0,), 16: (), 17: (0,)}  # numbers of a matrix, 3 x 4 or 4 x 4, behind its time or number
STATED = (0, TRIANGLE, FULL)  # columns of a covariance behind a matrix
ROTATION = 1e-3  # largest entry of R R' - I
LAYOUT = f"t tx ty tz qx qy qz qw ({', '.join(map(str, TUM))} columns)"


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
    roles = None if head is None else roles_of(head.names, path)
    if head is not None and roles is not None and not (head.comment and roles.is_tum and len(head.names) in TUM):
        if not (roles.quaternion or true):
            raise InputError(
                f"{path}: holds no quaternion; a table of a state is read with --state x,y,z; {naming('qx')}"
            )
        return _named(path, head, roles, true, columns)
    widths = [matrix + stated for matrix in MATRICES for stated in STATED]
    unnamed = (*(POINT,) * true, *TUM, DEVIATED, *widths, *STATES)
    if head is not None and not head.comment and len(head.names) not in unnamed:
        missing = "t" if clock_of(head.names) is None else "x"
        names = ", ".join(head.names)
        raise InputError(f"{path}: column '{missing}' is missing; there are: {names}; {naming(missing)}")
    lines = read_rows(path, unnamed, LAYOUT)
    width = lines.values.shape[1]
    if width == POINT:
        return increasing(replace(lines, note=f"{path}: read as positions without orientations, {width} columns"))
    if width == DEVIATED:
        of = "poses with the standard deviations of x, y, z and of the rotation about x, y, z, in m and rad"
        return increasing(replace(lines, note=f"{path}: read as {of}, {width} columns"))
    if width in TUM:
        note = f"{path}: read as t x y z qx qy qz qw, as its columns have no names"
        return increasing(replace(lines, note=note if path.suffix.lower() == ".csv" else ""))
    if width == ASL and not _is_rigid(lines.values[:, 1:]).all():
        return _asl(lines, true)
    if width in widths and (_is_rigid(_matrix(lines)[0]).all() or width not in STATES):
        return _matrices(lines)
    states = as_states(increasing(lines))
    if states is None:
        raise InputError(f"{lines.place(0)}: has {width} columns; should be {LAYOUT}")
    return states


def read_beside(path: Path, columns: Columns | None = None) -> Lines | None:
    """The truth in columns beside the estimates of a file with names, in rows that have one; None without any."""
    head = head_of(path, columns)
    if head is None:
        return None
    roles = true_roles_of(head.names, path)
    if roles is None or not roles.quaternion:
        return None
    lines = _named(path, head, roles, True, columns)
    known = np.isfinite(lines.values).all(axis=1)
    note = f"{path}: the truth stands in columns beside the estimates"
    return replace(lines, values=lines.values[known], line=lines.line[known], rest=None, note=note)


def on_plane(lines: Lines, unit: str) -> TableRows:
    """Columns t, x, y and heading of poses in space, which is that of the x axis.

    Raises
    ------
    InputError
        They are positions without orientations.
    """
    if lines.values.shape[1] < POSE:
        raise InputError(
            f"{lines.path}: holds positions without orientations, and a planar pose needs a heading; give a file with "
            "a heading or a quaternion, or judge positions alone: --state x,y with a truth table of columns t, x, y"
        )
    ahead = Rotation.from_quat(lines.values[:, 4:POSE]).apply([1.0, 0.0, 0.0])
    columns = {"t": lines.t, "x": lines.values[:, 1], "y": lines.values[:, 2], "heading": np.arctan2(*ahead.T[1::-1])}
    return TableRows(lines.path, columns, lines.line, unit, lines.open_line, lines.cut)


def _named(path: Path, head: Head, roles: Roles, true: bool, columns: Columns | None) -> Lines:
    """Rows under the names of their columns."""
    pose = (*roles.time, *roles.position, *roles.quaternion, *roles.covariance)
    lines, values = read_named(path, head, (*pose, *roles.rest), columns)
    t, unit = times_of(lines, roles.time, values[: len(roles.time)], roles.unit)
    if roles.squared:
        first = len(roles.time) + len(roles.position) + len(roles.quaternion)
        values[first : len(pose)] = [np.sign(each) * np.sqrt(np.abs(each)) for each in values[first : len(pose)]]
    of, clock = roles.kind, UNIT_NAMES[unit]
    if not true:
        of = of.replace(" truth", " poses")
    if len(roles.time) == 2:
        clock = "seconds and nanoseconds"
    order = "no orientation"
    if roles.quaternion:
        order = "quaternion w last"
        if roles.quaternion[3] < roles.quaternion[0]:
            order = "quaternion w first"
    note = f"{path}: read as {of}, {len(head.names)} columns, {clock}, {order}"
    if roles.covariance:
        stated = "covariance"
        if roles.squared:
            stated = "variances"
        elif len(roles.covariance) in DEVIATIONS:
            stated = "standard deviations"
        note += f", {stated} in {len(roles.covariance)} columns"
    rest = np.column_stack(values[len(pose) :]) if roles.rest else None
    rows = np.column_stack([t, *values[len(roles.time) : len(pose)]])
    return increasing(replace(lines, values=rows, note=note, rest=rest))


def read_named(
    path: Path, head: Head, places: Sequence[int], columns: Columns | None = None
) -> tuple[Lines, list[Array]]:
    """Some columns of a file with names, and lines that hold none of them yet."""
    require_units([head.names[i] for i in places], path)
    if head.comment or head.spaced:
        layout = f"{len(head.names)} columns as named"
        lines = read_rows(path, [len(head.names)], layout, 0 if head.comment else head.line)
        return replace(lines, values=lines.values[:, :0]), [lines.values[:, i] for i in places]
    sheet = read_sheet(path, columns)
    names = list(sheet.data)
    if "run" in names or "filter" in names:
        raise InputError(f"{path}: column 'run' or 'filter': write such poses to a file for each run and estimator")
    lines = Lines(path, np.empty((len(sheet), 0)), sheet.line, open_line=sheet.open_line, cut=sheet.cut)
    return lines, [sheet.numbers(names[i]) for i in places]


def _asl(lines: Lines, true: bool) -> Lines:
    """The 17 columns of EuRoC without their names."""
    t, unit = times_of(lines, (0,), [lines.t])
    of = f"EuRoC {'truth' if true else 'poses'}, {ASL} columns, {UNIT_NAMES[unit]}, quaternion w first"
    note = f"{lines.path}: read as {of}"
    values = np.column_stack([t, lines.values[:, [1, 2, 3, 5, 6, 7, 4]]])
    return increasing(replace(lines, values=values, note=note, rest=lines.values[:, POSE:]))


def times_of(
    lines: Lines, places: Sequence[int], columns: Sequence[Array], unit: int | None = None
) -> tuple[Array, int]:
    """Times in s, each the number nearest to what the file says, and how many of its units are a second.

    A double does not hold the nanoseconds since 1970, so that they are read again as whole numbers.
    """
    unit = 10**9 if len(places) == 2 else unit_of(columns[0], unit)
    if unit < 10**9:
        return columns[0] / unit, unit
    rows = iter(lines.line)
    row, t = next(rows, None), []
    for block in blocks(lines.path):
        for number, line in block.lines():
            if number == row:
                cells = fields_of(line)
                try:
                    t.append(
                        sum(int(cells[i]) * each for i, each in zip(places, (unit, 1)[-len(places) :], strict=True))
                        / unit
                    )
                except (ValueError, IndexError, OverflowError):
                    return (columns[0] / unit if len(places) == 1 else columns[0] + columns[1] / unit), unit
                row = next(rows, None)
    return np.array(t), unit


# --- matrices ----------------------------------------------------------------------------------------


def _matrix(lines: Lines) -> tuple[Array, Array, Array]:
    """Numbers of the matrices (N, 12 or 16), what stands before them, and their covariances."""
    width = lines.values.shape[1]
    for stated in STATED:
        if width - stated in MATRICES:
            start, end = len(MATRICES[width - stated]), width - stated
            return lines.values[:, start:end], lines.values[:, :start], lines.values[:, end:]
    raise InputError(f"{lines.place(0)}: has {width} columns; should be {LAYOUT}")


def _is_rigid(numbers: Array) -> Indices:
    """Whether rows (N, 12) or (N, 16) are the matrix of a rotation and a translation, or not finite."""
    M = numbers.reshape(len(numbers), -1, 4)
    R, finite = M[:, :3, :3], np.asarray(np.isfinite(numbers).all(axis=1))
    with np.errstate(invalid="ignore", over="ignore"):
        right: Indices = (np.abs(R @ np.swapaxes(R, 1, 2) - np.eye(3)).max((1, 2)) < ROTATION) & (
            np.linalg.det(np.where(finite[:, None, None], R, 0.0)) > 0
        )
    if M.shape[1] == 4:
        right &= np.abs(M[:, 3] - [0.0, 0.0, 0.0, 1.0]).max(axis=1) < ROTATION
    return np.asarray(right | ~finite)


def _matrices(lines: Lines) -> Lines:
    """Matrices that turn body into world coordinates, row by row, behind a time or a number or neither."""
    numbers, before, covariance = _matrix(lines)
    what = (
        f"the {numbers.shape[1]} numbers are not a rotation and translation, row by row; should be these, or {LAYOUT}"
    )
    refuse(~_is_rigid(numbers), lines.place, what)
    t, clock = _clock(lines, before)
    M = numbers.reshape(len(numbers), -1, 4)
    quaternion = np.full((len(M), 4), np.nan)
    finite = np.isfinite(numbers).all(axis=1)
    if finite.any():
        quaternion[finite] = Rotation.from_matrix(M[finite, :3, :3]).as_quat()
    note = f"{lines.path}: read as matrices of {M.shape[1]} x 4, {lines.values.shape[1]} columns, {clock}"
    return increasing(replace(lines, values=np.column_stack([t, M[:, :3, 3], quaternion, covariance]), note=note))


def _clock(lines: Lines, before: Array) -> tuple[Array, str]:
    """Times of matrices: those before them, those of times.txt in the same folder, or their numbers from 0 on."""
    if before.shape[1]:
        t, unit = times_of(lines, (0,), [before[:, 0]])
        if (t == np.round(t)).all():
            return t, "the first one the number of the step"
        return t, f"the first one the time in {UNIT_NAMES[unit]}"
    times = lines.path.parent / "times.txt"
    if not times.is_file():
        return np.arange(float(len(lines.line))), "numbered from 0 on, as there is no times.txt beside them"
    t = read_rows(times, (1,), "a time").t
    if len(t) != len(lines.line):
        raise InputError(f"{times}: has {len(t)} times, but {lines.path} {len(lines.line)} poses")
    return t, f"times from {times.name} beside them"


CAMERAS, CALIBRATION = 18, 15  # column with the number of cameras, and numbers of each one's calibration
LARGEST = 200  # columns, of more cameras than OpenVINS takes
STATES = range(CAMERAS + 1 + CALIBRATION, LARGEST)  # columns of a state
DEVIATION_WIDTHS = range(
    CAMERAS + CALIBRATION - 1, LARGEST
)  # of its deviations: three for a rotation, in place of four
AS_TUM = [0, 5, 6, 7, 1, 2, 3, 4]  # t, position and quaternion in the order of TUM
REST = slice(8, 17)  # velocity, biases
SIGMA = slice(1, 16)  # rotation, position, velocity, biases
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
    return lines, diagonal(np.concatenate([sigma[:, 3:6], sigma[:, :3], sigma[:, 6:]], axis=1))


def _has_cameras(values: Array, column: int, each: int) -> bool:
    """Whether a column holds a number of cameras, of which there are so many numbers each in the columns behind it."""
    cameras = values[:, column]
    width = column + 1 + each * cameras
    return bool(((cameras >= 1) & (cameras == np.round(cameras)) & (width <= values.shape[1])).all())
