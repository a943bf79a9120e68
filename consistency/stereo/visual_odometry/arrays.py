"""Arrays that callers hand in, checked, and the errors of input that cannot be used."""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np

from consistency.referee.errors import InputError
from consistency.referee.extras import MissingPackageError, remedy
from consistency.referee.types import Array

ROUNDING = 1e-9  # of a covariance's largest entry: asymmetry and negative eigenvalues below are rounding
ORTHONORMAL = 1e-6  # largest entry of R'R - I: a calibration file has about that many digits
LARGEST = 1e75  # of a number: fourth powers of coordinates are still finite


def checked_rows(name: str, value: Any, width: int) -> Array:
    """``value`` as floats of shape (N, width).

    Raises
    ------
    InputError
        Another shape, or a value that is not finite.
    """
    array = floats(name, value)
    if array.ndim != 2 or array.shape[1] != width:
        raise InputError(f"{name}: shape {array.shape}, allowed is (N, {width})")
    return array


def freeze(record: Any, **shapes: tuple[int, ...]) -> None:
    """Fields of a frozen record become read-only copies, as floats of these shapes; a field ``R`` is a rotation.

    Raises
    ------
    InputError
        Another shape, a value that is not finite, or R no rotation.
    """
    for name, shape in shapes.items():
        value = floats(name, getattr(record, name)).copy()
        if value.shape != shape:
            raise InputError(f"{name}: shape {value.shape}, allowed is {shape}")
        value.flags.writeable = False
        object.__setattr__(record, name, value)
    R = record.R
    if np.abs(R.T @ R - np.eye(3)).max() > ORTHONORMAL or np.linalg.det(R) < 0.0:
        raise InputError("R: not a rotation; its columns must be orthonormal and its determinant +1")


def same_length(names: str, *arrays: Array) -> None:
    """All arrays have the same number of rows, else InputError."""
    if len({len(array) for array in arrays}) > 1:
        counts = ", ".join(str(len(array)) for array in arrays)
        raise InputError(f"{names}: {counts} rows, they must be matched row by row")


def covariances(
    name: str,
    value: Any,
    count: int,
    size: int,
) -> Array:
    """``value`` of shape (size, size), for all rows, or (count, size, size), as the latter.

    Raises
    ------
    InputError
        Another shape, a value that is not finite, or a matrix that is not symmetric positive semidefinite.
    """
    matrices = floats(name, value)
    if matrices.shape not in {(size, size), (count, size, size)}:
        raise InputError(f"{name}: shape {matrices.shape}, allowed are ({size}, {size}) and ({count}, {size}, {size})")
    if matrices.size == 0:
        return matrices
    slack = ROUNDING * np.abs(matrices).max(axis=(-2, -1), keepdims=True)
    if (np.abs(matrices - np.swapaxes(matrices, -1, -2)) > slack).any():
        raise InputError(f"{name}: not symmetric; give covariances, for pixels in px^2")
    try:
        np.linalg.cholesky(matrices + (slack + np.finfo(float).tiny) * np.eye(size))
    except np.linalg.LinAlgError:
        raise InputError(f"{name}: not positive semidefinite; give covariances, for pixels in px^2") from None
    return np.broadcast_to(matrices, (count, size, size))


def floats(name: str, value: Any) -> Array:
    """``value`` as an array of finite floats, else InputError."""
    try:
        array: Array = np.asarray(value, float)
    except (TypeError, ValueError):
        raise InputError(f"{name}: not an array of numbers") from None
    bad = np.argwhere(~(np.abs(array) <= LARGEST))
    if len(bad):
        index = tuple(bad[0].tolist())
        why = "not finite"
        if np.isfinite(array[index]):
            why = "too large"
        raise InputError(f"{name}: {why} at index {index}; leave such rows out")
    return array


def symmetric_inverses(C: Array) -> tuple[Array, Array]:
    """Inverses (..., m, m) of symmetric matrices, and which of them are positive definite (...).

    What stands for the inverse of one that is not means nothing. Three rows go by cofactors, which takes less time
    than LAPACK's calls for each matrix.
    """
    if C.shape[-1] != 3:
        one = np.eye(C.shape[-1])
        finite = np.asarray(np.isfinite(C).all(axis=(-2, -1)))
        least = np.linalg.eigvalsh(np.where(finite[..., None, None], C, one))[..., 0]
        definite = finite & (least > 0.0)
        return np.linalg.inv(np.where(definite[..., None, None], C, one)), definite
    C = np.moveaxis(C, (-2, -1), (0, 1))  # entry by entry over all matrices
    cofactors = np.empty_like(C)
    for i in range(3):
        second, third = C[(i + 1) % 3], C[(i + 2) % 3]
        for j in range(3):
            k, m = (j + 1) % 3, (j + 2) % 3
            cofactors[i, j] = second[k] * third[m] - second[m] * third[k]
    det = C[0, 0] * cofactors[0, 0] + C[0, 1] * cofactors[0, 1] + C[0, 2] * cofactors[0, 2]
    definite = (det > 0.0) & (C[0, 0] > 0.0) & (cofactors[2, 2] > 0.0)
    inverses = cofactors / np.where(definite, det, 1.0)
    return np.moveaxis(inverses, (0, 1), (-2, -1)), np.asarray(definite)


class MatchError(InputError):
    """Something that may be one match's fault: ``match`` is its number, from 0, or None."""

    def __init__(self, message: str, match: int | None = None) -> None:
        super().__init__(message)
        self.match = match


class PointError(MatchError):
    """A point at infinity, at a camera or behind it, or a match without positive disparity."""


class DegenerateError(MatchError):
    """Points that do not fix a rigid motion: fewer than three, identical, or on one line; or one that is not fixed."""


class ConsensusError(InputError):
    """No motion has enough inliers."""


class GimbalLockError(InputError):
    """A pitch of +-90 degrees, where roll and yaw are not defined."""


class ConvergenceError(InputError):
    """A minimisation that did not reach a minimum."""


def opencv() -> Any:
    """The module ``cv2``.

    Raises
    ------
    InputError
        OpenCV is not installed.
    """
    try:
        return importlib.import_module("cv2")
    except ImportError:
        raise MissingPackageError(f"an image needs {remedy('vision')}") from None
