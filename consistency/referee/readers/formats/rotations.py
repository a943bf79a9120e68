"""Rotations as files hold them: matrices and quaternions, checked."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from consistency.referee.readers.truth_matching import finite_rows
from consistency.referee.types import Array, Indices

TOLERANCE = 1e-3  # largest entry of R R' - I
UNIT = 1e-3  # of the length of a quaternion: four decimals pass


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
