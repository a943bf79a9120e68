"""Observation models of the kernels: pose -> point landmark -> mounted sensor, chosen by a code.

``predict_observation`` gives h, ``linearise`` gives h and its Jacobians, ``place`` inverts h for a
landmark seen for the first time; all over (pose, landmark) and a packed rig (f, B, mount). A new sensor
adds a branch to the four functions of the sensor frame and nothing else.

Kernel functions stand at module level on purpose: Numba names closures by a counter of the process, so
two that were cached by different processes can be taken for each other when both are loaded.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from consistency.filters.jit import inner
from consistency.models import point, stereo

XYZ, UVD, LINEAR = 0, 1, 2  # eq. 19; eq. 22; eq. 19 to first order about a known reference


@inner
def _measure(model: int, x: Any, y: Any, z: Any, rig: Any) -> Any:
    if model == UVD:
        return stereo.project(x, y, z, rig[0], rig[1])
    return x, y, z


@inner
def _measure_jacobian(model: int, x: Any, y: Any, z: Any, rig: Any) -> Any:
    if model == UVD:
        return stereo.project_jacobian(x, y, z, rig[0], rig[1])
    return 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0


@inner
def _locate(model: int, z0: Any, z1: Any, z2: Any, rig: Any) -> Any:
    if model == UVD:
        return stereo.triangulate(z0, z1, z2, rig[0], rig[1])
    return z0, z1, z2


@inner
def _locate_jacobian(model: int, z0: Any, z1: Any, z2: Any, rig: Any) -> Any:
    if model == UVD:
        return stereo.triangulate_jacobian(z0, z1, z2, rig[0], rig[1])
    return 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0


@inner
def predict_observation(model: int, px: Any, py: Any, c: Any, s: Any, landmark: Any, rig: Any, z: Any) -> None:
    """z <- h at a pose (px, py, heading) with c, s the cosine and sine of the heading."""
    bx, by, bz = point.turned_to_robot(px, py, c, s, landmark[0], landmark[1], landmark[2])
    cx, cy, cz = point.to_sensor(bx, by, bz, rig[2:])
    z[0], z[1], z[2] = _measure(model, cx, cy, cz, rig)


@inner
def _linearise_at(model: int, pose: Any, landmark: Any, rig: Any, z: Any, Hp: Any, Hl: Any) -> None:
    c, s = np.cos(pose[2]), np.sin(pose[2])
    bx, by, bz = point.turned_to_robot(pose[0], pose[1], c, s, landmark[0], landmark[1], landmark[2])
    cx, cy, cz = point.to_sensor(bx, by, bz, rig[2:])
    z[0], z[1], z[2] = _measure(model, cx, cy, cz, rig)
    J = _measure_jacobian(model, cx, cy, cz, rig)
    for i in range(3):
        # d: the row of dh / d(robot-frame point), through the mount's rotation
        j0, j1, j2 = J[3 * i], J[3 * i + 1], J[3 * i + 2]
        d0 = j0 * rig[5] + j1 * rig[6] + j2 * rig[7]
        d1 = j0 * rig[8] + j1 * rig[9] + j2 * rig[10]
        d2 = j0 * rig[11] + j1 * rig[12] + j2 * rig[13]
        Hl[i, 0], Hl[i, 1], Hl[i, 2] = c * d0 - s * d1, s * d0 + c * d1, d2
        Hp[i, 0], Hp[i, 1], Hp[i, 2] = -Hl[i, 0], -Hl[i, 1], d0 * by - d1 * bx


@inner
def linearise(
    model: int, pose: Any, landmark: Any, pose0: Any, landmark0: Any, rig: Any, z: Any, Hp: Any, Hl: Any
) -> None:
    """z, Hp, Hl <- h and its Jacobians (3, 3) at (pose, landmark); of a linear world at its reference."""
    if model == LINEAR:
        _linearise_at(XYZ, pose0, landmark0, rig, z, Hp, Hl)
        for i in range(3):
            for j in range(3):
                z[i] += Hp[i, j] * (pose[j] - pose0[j]) + Hl[i, j] * (landmark[j] - landmark0[j])
    else:
        _linearise_at(model, pose, landmark, rig, z, Hp, Hl)


@inner
def place(model: int, pose: Any, z: Any, pose0: Any, landmark0: Any, rig: Any, landmark: Any, Jp: Any, Jz: Any) -> None:
    """landmark, Jp, Jz <- the inverse of h and its Jacobians (3, 3) with respect to pose and z."""
    if model == LINEAR:
        _place_linear(pose, z, pose0, landmark0, rig, landmark, Jp, Jz)
        return
    cx, cy, cz = _locate(model, z[0], z[1], z[2], rig)
    bx, by, bz = point.from_sensor(cx, cy, cz, rig[2:])
    landmark[0], landmark[1], landmark[2] = point.to_world(pose[0], pose[1], pose[2], bx, by, bz)
    J = _locate_jacobian(model, z[0], z[1], z[2], rig)
    c, s = np.cos(pose[2]), np.sin(pose[2])
    Jp[:] = 0.0
    Jp[0, 0] = Jp[1, 1] = 1.0
    Jp[0, 2], Jp[1, 2] = -s * bx - c * by, c * bx - s * by
    for j in range(3):
        e0 = rig[5] * J[j] + rig[6] * J[3 + j] + rig[7] * J[6 + j]
        e1 = rig[8] * J[j] + rig[9] * J[3 + j] + rig[10] * J[6 + j]
        e2 = rig[11] * J[j] + rig[12] * J[3 + j] + rig[13] * J[6 + j]
        Jz[0, j], Jz[1, j], Jz[2, j] = c * e0 - s * e1, s * e0 + c * e1, e2


@inner
def _place_linear(pose: Any, z: Any, pose0: Any, landmark0: Any, rig: Any, landmark: Any, Jp: Any, Jz: Any) -> None:
    z0, Hp, Hl = np.empty(3), np.empty((3, 3)), np.empty((3, 3))
    _linearise_at(XYZ, pose0, landmark0, rig, z0, Hp, Hl)
    Jz[:] = np.linalg.inv(Hl)
    Jp[:] = -np.dot(Jz, Hp)
    for i in range(3):
        landmark[i] = landmark0[i]
        for j in range(3):
            landmark[i] += Jz[i, j] * (z[j] - z0[j]) + Jp[i, j] * (pose[j] - pose0[j])
