"""Right-invariant error of poses, T_true = Exp(xi) T, beside landmarks that are in no world frame."""

from __future__ import annotations

from typing import NamedTuple

from consistency.bench.filters.error.planar import exponential, shifted_covariance
from consistency.bench.filters.kernel.dispatch import implement, part
from consistency.bench.filters.kernel.jit import inner
from consistency.bench.filters.kernel.slam import insert_error, pose_covariance, to_error
from consistency.referee.types import Array


@part(motion="Unicycle", landmark="InverseRange")
class InvariantPose(NamedTuple):
    """No parameters."""


@implement(to_error, InvariantPose)
def to_invariant_pose(error: InvariantPose, pose: Array, values: Array, Hp: Array, Hl: Array) -> None:
    for a in range(len(Hp)):
        Hp[a, 2] += pose[0] * Hp[a, 1] - pose[1] * Hp[a, 0]


@implement(insert_error, InvariantPose)
def insert_beside_pose(error: InvariantPose, pose: Array, values: Array, Jp: Array) -> None:
    pass


@implement(pose_covariance, InvariantPose)
def invariant_pose_covariance(error: InvariantPose, x: Array, P: Array, out: Array) -> None:
    shifted_covariance(x, P, out)


@inner
def move_pose(pose: Array, xi: Array, out: Array) -> None:
    """``out`` (3,) <- Exp(xi) T."""
    c, s, along, across = exponential(xi[2])
    x, y = pose[0], pose[1]
    out[0] = c * x - s * y + along * xi[0] - across * xi[1]
    out[1] = s * x + c * y + across * xi[0] + along * xi[1]
    out[2] = pose[2] + xi[2]


@inner
def left_jacobian(xi: Array, J: Array) -> None:
    """``J`` (3, 3) <- J_l of SE(2) to second order."""
    x, y, t = xi[0], xi[1], xi[2]
    J[0, 0] = J[1, 1] = 1.0 - t * t / 6.0
    J[0, 1], J[1, 0] = -0.5 * t, 0.5 * t
    J[0, 2], J[1, 2] = 0.5 * y + t * x / 6.0, -0.5 * x + t * y / 6.0
    J[2, 0] = J[2, 1] = 0.0
    J[2, 2] = 1.0
