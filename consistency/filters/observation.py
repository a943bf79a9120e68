"""Observation models of the kernels, composed: pose -> point landmark -> mounted sensor.

A composed model is three compiled functions over (pose, landmark) and a packed rig
(f, B, mount): ``predict`` gives h, ``linearise`` gives h and its Jacobians, ``place`` inverts h for
a landmark seen for the first time. A new sensor adds four small functions and one ``compose``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from consistency.filters.jit import inner
from consistency.models import point, stereo


class ObservationModel(NamedTuple):
    predict: Callable[..., Any]
    linearise: Callable[..., Any]
    place: Callable[..., Any]


def compose(
    measure: Callable[..., Any],
    measure_jacobian: Callable[..., Any],
    locate: Callable[..., Any],
    locate_jacobian: Callable[..., Any],
) -> ObservationModel:
    """Chain a sensor's h(c), dh/dc and their inverses with the point model and the mount."""

    @inner
    def sensor_point(pose: Any, landmark: Any, rig: Any) -> Any:
        bx, by, bz = point.to_robot(pose[0], pose[1], pose[2], landmark[0], landmark[1], landmark[2])
        return point.to_sensor(bx, by, bz, rig[2:])

    @inner
    def predict(pose: Any, landmark: Any, rig: Any, z: Any) -> None:
        cx, cy, cz = sensor_point(pose, landmark, rig)
        z[0], z[1], z[2] = measure(cx, cy, cz, rig)

    @inner
    def linearise(pose: Any, landmark: Any, pose0: Any, landmark0: Any, rig: Any, z: Any, Hp: Any, Hl: Any) -> None:
        cx, cy, cz = sensor_point(pose, landmark, rig)
        z[0], z[1], z[2] = measure(cx, cy, cz, rig)
        J = measure_jacobian(cx, cy, cz, rig)
        c, s = np.cos(pose[2]), np.sin(pose[2])
        bx, by, _ = point.to_robot(pose[0], pose[1], pose[2], landmark[0], landmark[1], landmark[2])
        for i in range(3):
            # D: the row of dh/d(robot-frame point), through the mount's rotation
            j0, j1, j2 = J[3 * i], J[3 * i + 1], J[3 * i + 2]
            d0 = j0 * rig[5] + j1 * rig[6] + j2 * rig[7]
            d1 = j0 * rig[8] + j1 * rig[9] + j2 * rig[10]
            d2 = j0 * rig[11] + j1 * rig[12] + j2 * rig[13]
            Hl[i, 0], Hl[i, 1], Hl[i, 2] = c * d0 - s * d1, s * d0 + c * d1, d2
            Hp[i, 0], Hp[i, 1], Hp[i, 2] = -Hl[i, 0], -Hl[i, 1], d0 * by - d1 * bx

    @inner
    def place(pose: Any, z: Any, pose0: Any, landmark0: Any, rig: Any, landmark: Any, Jp: Any, Jz: Any) -> None:
        cx, cy, cz = locate(z[0], z[1], z[2], rig)
        bx, by, bz = point.from_sensor(cx, cy, cz, rig[2:])
        landmark[0], landmark[1], landmark[2] = point.to_world(pose[0], pose[1], pose[2], bx, by, bz)
        J = locate_jacobian(z[0], z[1], z[2], rig)
        c, s = np.cos(pose[2]), np.sin(pose[2])
        Jp[:] = 0.0
        Jp[0, 0] = Jp[1, 1] = 1.0
        Jp[0, 2], Jp[1, 2] = -s * bx - c * by, c * bx - s * by
        for j in range(3):
            e0 = rig[5] * J[j] + rig[6] * J[3 + j] + rig[7] * J[6 + j]
            e1 = rig[8] * J[j] + rig[9] * J[3 + j] + rig[10] * J[6 + j]
            e2 = rig[11] * J[j] + rig[12] * J[3 + j] + rig[13] * J[6 + j]
            Jz[0, j], Jz[1, j], Jz[2, j] = c * e0 - s * e1, s * e0 + c * e1, e2

    return ObservationModel(predict, linearise, place)


def about_reference(model: ObservationModel) -> ObservationModel:
    """The model to first order about the known point (pose0, landmark0): linear in the state."""
    exact, inverse = model.linearise, model.place

    @inner
    def linearise(pose: Any, landmark: Any, pose0: Any, landmark0: Any, rig: Any, z: Any, Hp: Any, Hl: Any) -> None:
        exact(pose0, landmark0, pose0, landmark0, rig, z, Hp, Hl)
        for i in range(3):
            for j in range(3):
                z[i] += Hp[i, j] * (pose[j] - pose0[j]) + Hl[i, j] * (landmark[j] - landmark0[j])

    @inner
    def place(pose: Any, z: Any, pose0: Any, landmark0: Any, rig: Any, landmark: Any, Jp: Any, Jz: Any) -> None:
        z0, Hp, Hl = np.empty(3), np.empty((3, 3)), np.empty((3, 3))
        exact(pose0, landmark0, pose0, landmark0, rig, z0, Hp, Hl)
        Jz[:] = np.linalg.inv(Hl)
        Jp[:] = -np.dot(Jz, Hp)
        for i in range(3):
            landmark[i] = landmark0[i]
            for j in range(3):
                landmark[i] += Jz[i, j] * (z[j] - z0[j]) + Jp[i, j] * (pose[j] - pose0[j])

    return ObservationModel(model.predict, linearise, place)


@inner
def _same(x: Any, y: Any, z: Any, rig: Any) -> Any:
    return x, y, z


@inner
def _identity(x: Any, y: Any, z: Any, rig: Any) -> Any:
    return 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0


@inner
def _project(x: Any, y: Any, z: Any, rig: Any) -> Any:
    return stereo.project(x, y, z, rig[0], rig[1])


@inner
def _project_jacobian(x: Any, y: Any, z: Any, rig: Any) -> Any:
    return stereo.project_jacobian(x, y, z, rig[0], rig[1])


@inner
def _triangulate(u: Any, v: Any, d: Any, rig: Any) -> Any:
    return stereo.triangulate(u, v, d, rig[0], rig[1])


@inner
def _triangulate_jacobian(u: Any, v: Any, d: Any, rig: Any) -> Any:
    return stereo.triangulate_jacobian(u, v, d, rig[0], rig[1])


XYZ = compose(_same, _identity, _same, _identity)
UVD = compose(_project, _project_jacobian, _triangulate, _triangulate_jacobian)
LINEAR = about_reference(XYZ)
