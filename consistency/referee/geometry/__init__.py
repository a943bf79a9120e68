"""Angles and rigid motions."""

from __future__ import annotations

import numpy as np

from consistency.referee.types import Array


def wrap(angle: Array) -> Array:
    """Angle in radians brought to [-pi, pi), any shape; NaN where it is not finite."""
    with np.errstate(invalid="ignore"):
        return np.mod(np.asarray(angle) + np.pi, 2.0 * np.pi) - np.pi


def pose_error(truth: Array, estimate: Array) -> Array:
    """Truth minus estimate of planar poses, both (..., 3) -> (..., 3), m and rad, the heading wrapped to [-pi, pi)."""
    error: Array = np.asarray(truth, float) - np.asarray(estimate, float)
    error[..., 2] = wrap(error[..., 2])
    return error


def rotation(roll: float, pitch: float, heading: float) -> Array:
    """Rotation matrix (3, 3) of Rz(heading) Ry(pitch) Rx(roll), radians."""
    (cr, cp, ch), (sr, sp, sh) = (fn([roll, pitch, heading]) for fn in (np.cos, np.sin))
    return np.array(
        [
            [ch * cp, ch * sp * sr - sh * cr, ch * sp * cr + sh * sr],
            [sh * cp, sh * sp * sr + ch * cr, sh * sp * cr - ch * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )
