"""The files of a simulation with OpenVINS: the state, its standard deviations, and the true state, one file each."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from consistency.referee.diagnostics.records.large_arrays import diagonal
from consistency.referee.errors import InputError
from consistency.referee.readers.formats.sheet import Lines, read_numbers
from consistency.referee.types import Array

CAMERAS, CALIBRATION = 18, 15  # column with the number of cameras, and numbers of each one's calibration
LARGEST = 200  # columns, of more cameras than OpenVINS takes
FULL = range(CAMERAS + 1 + CALIBRATION, LARGEST)  # columns of a state
DEVIATED = range(CAMERAS + CALIBRATION - 1, LARGEST)  # of its deviations: three for a rotation, in place of four
AS_TUM = [0, 5, 6, 7, 1, 2, 3, 4]  # t, position and quaternion in the order of TUM
REST = slice(8, 17)  # velocity, biases
SIGMA = slice(1, 16)  # rotation, position, velocity, biases
LAYOUT = (
    "t, three standard deviations of the rotation, rad, three of the position, m, and those of the rest of the state"
)


class States(Lines):
    """Poses (N, 8) as in a TUM trajectory, of states whose standard deviations are in a file of their own."""


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
    lines = read_numbers(path, DEVIATED, LAYOUT)
    if not _has_cameras(lines.values, CAMERAS - 1, CALIBRATION - 1):
        raise InputError(f"{lines.place(0)}: has {lines.values.shape[1]} columns; should be {LAYOUT}")
    sigma = lines.values[:, SIGMA]
    negative = np.flatnonzero((sigma < 0).any(axis=1))
    if len(negative):
        raise InputError(f"{lines.place(int(negative[0]))}: a standard deviation is below 0; should be {LAYOUT}")
    return lines, diagonal(np.concatenate([sigma[:, 3:6], sigma[:, :3], sigma[:, 6:]], axis=1))


def _has_cameras(values: Array, column: int, each: int) -> bool:
    """Whether a column holds a number of cameras, of which there are so many numbers each in the columns behind it."""
    cameras = values[:, column]
    width = column + 1 + each * cameras
    return bool(((cameras >= 1) & (cameras == np.round(cameras)) & (width <= values.shape[1])).all())
