"""Trajectories as text that `consistency analyse` and the usual tools read."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from consistency.referee.types import Array


def trajectory_text(stamps: Array, R: Array, t: Array) -> str:
    """Lines ``t tx ty tz qx qy qz qw`` of poses (n, 3, 3), (n, 3)."""
    quaternion = Rotation.from_matrix(R).as_quat(canonical=True)
    return _lines(stamps, np.column_stack([t, quaternion]))


def covariance_text(stamps: Array, P: Array) -> str:
    """Lines of t and 36 numbers of covariances (n, 6, 6), translation first; a start known exactly has none."""
    known = P.any(axis=(1, 2))
    return _lines(stamps[known], P[known].reshape(-1, 36))


def motions_text(stamps: Array, R: Array, t: Array, P: Array) -> str:
    """Lines of t, the motion since the line before (7 numbers) and 36 of its covariance, translation first.

    The first line is where the motions (T, 3, 3), (T, 3), (T, 6, 6) start, for T + 1 stamps.
    """
    quaternion = Rotation.from_matrix(R).as_quat(canonical=True)
    rows = np.column_stack([t, quaternion, P.reshape(-1, 36)])
    start = np.concatenate([np.zeros((1, 6)), np.ones((1, 1)), np.zeros((1, 36))], axis=1)
    return _lines(stamps, np.concatenate([start, rows]))


def _lines(stamps: Array, values: Array) -> str:
    rows = (" ".join([f"{t:.9f}", *(f"{x:.17g}" for x in row)]) for t, row in zip(stamps, values, strict=True))
    return "\n".join(rows) + "\n"
