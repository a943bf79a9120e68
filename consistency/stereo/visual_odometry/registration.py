"""The rigid motion between two clouds of matched points, Valencia & Andrade-Cetto (2018) sec. 2.2.

All minimise eq. 2.4, the sum of ||p1 - (R p2 + t)||^2.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from consistency.referee.types import Array
from consistency.stereo.visual_odometry import input_checks
from consistency.stereo.visual_odometry.input_errors import DegenerateError
from consistency.stereo.visual_odometry.pose import RelativePose

ON_A_LINE = 1e-8  # second singular value of a cloud, over its largest coordinate, up to which it is a line
AMBIGUOUS = 1e-14  # gap to the second-best rotation, relative, that is rounding


def register_svd(p1: Array, p2: Array) -> RelativePose:
    """Eq. 2.15-2.21 (Arun, Huang & Blostein 1987); where eq. 2.20 is a reflection, the nearest rotation.

    Parameters
    ----------
    p1, p2 : (N, 3), the same points in frame 1 and 2, m

    Returns
    -------
    R, t with p1 = R p2 + t

    Raises
    ------
    InputError
        Shapes that do not match, or a value that is not finite.
    DegenerateError
        Fewer than three points, identical points, or points on one line.
    """
    p1, p2 = matched(p1, p2)
    R, t, fixed = rigid_motions(p1, p2)
    _require_unique(float(fixed))
    return RelativePose(R, t)


def register_horn(p1: Array, p2: Array, *, directions: bool = False) -> RelativePose:
    """Eq. 2.5-2.14 (Horn, Hilden & Negahdaripour 1988), by the quaternion.

    Two departures from print, each held by a test. Eq. 2.5 and 2.6 take the unit vectors from the camera to the points;
    under a translation these are not rotated copies of each other, and R is wrong even without noise. The points'
    vectors from their centroids are taken instead, as Horn does. And with eq. 2.9 the quaternion's scalar is the first
    component, where eq. 2.11 takes the last.

    Parameters
    ----------
    p1, p2 : (N, 3), the same points in frame 1 and 2, m
    directions : eq. 2.5 and 2.6 as printed; right for t = 0 only

    Returns
    -------
    R, t with p1 = R p2 + t

    Raises
    ------
    InputError, DegenerateError
        As :func:`register_svd`.
    """
    p1, p2 = matched(p1, p2)
    if directions:
        length1, length2 = (np.linalg.norm(p, axis=1, keepdims=True) for p in (p1, p2))
        if min(length1.min(), length2.min()) == 0.0:
            raise DegenerateError("p1, p2: a point at the camera has no direction; leave it out")
        v1, v2 = p1 / length1, p2 / length2
    else:
        v1, v2 = p1 - p1.mean(axis=0), p2 - p2.mean(axis=0)
    b, c = v2 + v1, v2 - v1
    B_i = np.zeros((len(p1), 4, 4))
    B_i[:, 0, 1:], B_i[:, 1:, 0] = -c, c
    B_i[:, 1, 2], B_i[:, 1, 3], B_i[:, 2, 3] = b[:, 2], -b[:, 1], b[:, 0]
    B_i[:, 2, 1], B_i[:, 3, 1], B_i[:, 3, 2] = -b[:, 2], b[:, 1], -b[:, 0]
    B = np.einsum("nij,nkj->ik", B_i, B_i)
    values, vectors = np.linalg.eigh(B)
    _require_unique(float((values[1] - values[0]) / values[3]))
    scalar, *vector = vectors[:, 0]
    R = Rotation.from_quat([*vector, scalar]).as_matrix()
    return RelativePose(R, p1.mean(axis=0) - R @ p2.mean(axis=0))


def matched(p1: Array, p2: Array) -> tuple[Array, Array]:
    """Both clouds as floats, (N, 3) and (N, 3), checked: errors as :func:`register_svd`."""
    p1, p2 = input_checks.rows("p1", p1, 3), input_checks.rows("p2", p2, 3)
    input_checks.same_length("p1, p2", p1, p2)
    if len(p1) < 3:
        raise DegenerateError(f"p1, p2: {len(p1)} points, a rigid motion needs at least 3")
    for name, p in (("p1", p1), ("p2", p2)):
        spread = np.linalg.svd(p - p.mean(axis=0), compute_uv=False)
        if spread[1] <= ON_A_LINE * np.abs(p).max():
            raise DegenerateError(f"{name}: the points are identical or lie on one line and do not fix a rotation")
    return p1, p2


def _require_unique(fixed: float) -> None:
    if not fixed > AMBIGUOUS:
        raise DegenerateError("p1, p2: more than one rotation fits the points best; one cloud mirrors the other")


def rigid_motions(p1: Array, p2: Array) -> tuple[Array, Array, Array]:
    """Eq. 2.15-2.21 of many clouds at once, unchecked.

    Parameters
    ----------
    p1, p2 : (..., N, 3), m

    Returns
    -------
    R (..., 3, 3), t (..., 3) in m, and how well the rotation is fixed (...), 0 for points on a line to 1
    """
    c1, c2 = p1.mean(axis=-2), p2.mean(axis=-2)
    M = np.swapaxes(p1 - c1[..., None, :], -1, -2) @ (p2 - c2[..., None, :])
    U, s, Vt = np.linalg.svd(M)
    sign = np.where(np.linalg.det(U @ Vt) < 0.0, -1.0, 1.0)
    U = np.concatenate([U[..., :2], U[..., 2:] * sign[..., None, None]], axis=-1)
    R = U @ Vt
    t = c1 - (R @ c2[..., None])[..., 0]
    fixed = (s[..., 1] + sign * s[..., 2]) / np.maximum(s[..., 0], np.finfo(float).tiny)
    return R, t, fixed
