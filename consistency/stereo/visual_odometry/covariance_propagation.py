"""First-order covariances of what a minimisation returns, Valencia & Andrade-Cetto (2018) sec. 2.3.

A minimum y of a cost C(x, y) is a function of x without a formula; its Jacobian still has one, by the implicit function
theorem: d y / d x = -C_yy^-1 C_yx (eq. 2.23).
"""

from __future__ import annotations

import numpy as np

from consistency.referee.geometry.lie_groups import propagated
from consistency.referee.types import Array
from consistency.stereo.visual_odometry.cameras import arrays
from consistency.stereo.visual_odometry.cameras.input_errors import ConvergenceError, DegenerateError
from consistency.stereo.visual_odometry.cameras.rig import StereoRig, solved
from consistency.stereo.visual_odometry.registration import checked_clouds
from consistency.stereo.visual_odometry.relative_pose import RelativePose, rotation_derivatives

AT_MINIMUM = 1e-3  # standard deviations that a pose may be away from the minimum that the theorem speaks of


def implicit_covariance(C_yy: Array, C_yx: Array, S_x: Array) -> Array:
    """Covariance of y = argmin C(x, y), eq. 2.22-2.24, where x is made of B independent blocks.

    Parameters
    ----------
    C_yy : (..., m, m), second derivative of the cost at its minimum
    C_yx : (..., B, m, k), mixed derivatives with each block of x
    S_x : (..., B, k, k), covariance of each block

    Returns
    -------
    (..., m, m), the sum over blocks of J S_x J' with J = -C_yy^-1 C_yx

    Raises
    ------
    DegenerateError
        C_yy is not positive definite: x does not fix y.
    """
    inverse, definite = arrays.symmetric_inverses(C_yy)
    if not definite.all():
        raise DegenerateError("the cost has no minimum here: its second derivative is not positive definite")
    S = _wide(C_yx @ S_x) @ np.swapaxes(_wide(C_yx), -1, -2)
    return propagated(inverse, S)


def _wide(blocks: Array) -> Array:
    """(..., B, m, k) -> (..., m, B k)."""
    *batch, B, m, k = blocks.shape
    return np.swapaxes(blocks, -3, -2).reshape(*batch, m, B * k)


def triangulation_covariance(rig: StereoRig, uv: Array, S_uv: Array) -> Array:
    """Covariance of :func:`triangulate`, eq. 2.24 and 2.27, with the exact derivatives of eq. 2.25.

    Parameters
    ----------
    uv : (N, 4), u, v, u', v', px
    S_uv : (4, 4) or (N, 4, 4), px^2; eq. 2.24 has zeros between the images, which is not required

    Returns
    -------
    (N, 3, 3), m^2

    Raises
    ------
    PointError
        As :func:`triangulate`.
    InputError
        A shape, a value that is not finite, S_uv not symmetric positive semidefinite.
    """
    uv = arrays.checked_rows("uv", uv, 4)
    S_uv = arrays.covariances("S_uv", S_uv, len(uv), 4)
    C_pp, C_pu = triangulation_derivatives(rig, *solved(rig, uv))
    return implicit_covariance(C_pp, C_pu[:, None], S_uv[:, None])


def triangulation_derivatives(
    rig: StereoRig,
    A: Array,
    b: Array,
    points: Array,
) -> tuple[Array, Array]:
    """C_pp (N, 3, 3) and C_pu (N, 3, 4) of half of eq. 2.25.

    Row j of A p - b is (u_j P_3 - P_j) (p, 1), with P the rows of its camera: u_j stands in row j only, and its factor
    there is the depth P_3 (p, 1).
    """
    last = rig.cameras[:, 2].repeat(2, axis=0)  # (4, 4), P_3 of each row
    residual = np.einsum("nij,nj->ni", A, points) - b
    depth = points @ last[:, :3].T + last[:, 3]
    C_up = A * depth[:, :, None] + last[:, :3] * residual[:, :, None]
    C_pu = np.swapaxes(C_up, 1, 2)
    return np.swapaxes(A, 1, 2) @ A, C_pu


def registration_covariance(
    p1: Array,
    p2: Array,
    S1: Array,
    S2: Array,
    pose: RelativePose,
) -> Array:
    """Covariance of the minimum of eq. 2.28, eq. 2.29-2.31, with its exact derivatives.

    It holds for :func:`register_svd` and :func:`register_horn`, which both find that minimum.

    Parameters
    ----------
    p1, p2 : (N, 3), m
    S1, S2 : (3, 3) or (N, 3, 3), m^2; points are independent of each other
    pose : what the registration of the same points returned

    Returns
    -------
    (6, 6), of x, y, z (m), roll, pitch, yaw (rad)

    Raises
    ------
    InputError, DegenerateError
        As :func:`register_svd`; S1 or S2 not symmetric positive semidefinite.
    GimbalLockError
        A pitch of +-90 degrees.
    ConvergenceError
        ``pose`` is not the minimum for these points.
    """
    p1, p2 = checked_clouds(p1, p2)
    S1 = arrays.covariances("S1", S1, len(p1), 3)
    S2 = arrays.covariances("S2", S2, len(p1), 3)
    C_d, C_dd, C_dp = registration_derivatives(p1, p2, pose)
    S = implicit_covariance(C_dd, C_dp, np.concatenate([S1, S2]))
    step = np.linalg.solve(C_dd, C_d)
    spread = np.sqrt(np.diagonal(S))
    rounding = 1e-9 * (1.0 + np.abs(pose.vector))
    if (np.abs(step) > AT_MINIMUM * spread + rounding).any():
        raise ConvergenceError("pose: not the minimum of eq. 2.28 for p1 and p2; register these very points first")
    return S


def registration_derivatives(p1: Array, p2: Array, pose: RelativePose) -> tuple[Array, Array, Array]:
    """C_d (6,), C_dd (6, 6) and C_dp (2N, 6, 3), first of p1 then of p2, of half of eq. 2.28."""
    first, second = rotation_derivatives(pose)
    n = len(p1)
    residual = p1 - pose.apply(p2)
    turned = np.einsum("kij,nj->nki", first, p2)  # R_k p2
    flat = turned.transpose(1, 0, 2).reshape(3, -1)
    C_d = np.empty(6)
    C_d[:3] = -residual.sum(axis=0)
    C_d[3:] = -np.einsum("ni,nki->k", residual, turned)
    C_dd = np.empty((6, 6))
    C_dd[:3, :3] = n * np.eye(3)
    C_dd[3:, :3] = turned.sum(axis=0)
    C_dd[:3, 3:] = C_dd[3:, :3].T
    C_dd[3:, 3:] = flat @ flat.T - np.einsum("klij,ij->kl", second, residual.T @ p2)
    C_dp1 = np.empty((n, 6, 3))
    C_dp1[:, :3] = -np.eye(3)
    C_dp1[:, 3:] = -turned
    C_dp2 = np.empty((n, 6, 3))
    C_dp2[:, :3] = pose.R
    C_dp2[:, 3:] = turned @ pose.R - np.einsum("kij,ni->nkj", first, residual)
    return C_d, C_dd, np.concatenate([C_dp1, C_dp2])
