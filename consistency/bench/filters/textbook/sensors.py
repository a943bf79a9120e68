"""Sensors: h, its Jacobians and its inverse, as eq. 19 and 22 have them."""

from __future__ import annotations

import numpy as np

from consistency.bench.models import planar, point, stereo
from consistency.bench.scenario import PLANAR_SENSORS, BelievedSensor
from consistency.referee.types import Array


class PointSensor:
    """Eq. 19 (``xyz``) or eq. 22 (``uvd``) from a mounted sensor."""

    size = width = 3  # numbers of an observation, and of a landmark

    def __init__(self, sensor: BelievedSensor, uvd: bool) -> None:
        self.f, self.B, self.uvd = sensor.f or 0.0, sensor.B or 0.0, uvd
        self.mount = sensor.mount.packed()
        self.turn = np.reshape(self.mount[3:], (3, 3))  # sensor axes in the robot frame

    def measure(self, pose: Array, landmark: Array) -> Array:
        """h: observations (..., 3) of landmarks (..., 3), m, from poses (..., 3)."""
        body = point.to_robot(*np.moveaxis(pose, -1, 0), *np.moveaxis(landmark, -1, 0))
        x, y, z = point.to_sensor(*body, self.mount)
        return np.stack(stereo.project(x, y, z, self.f, self.B) if self.uvd else (x, y, z), axis=-1)

    def jacobians(self, pose: Array, landmark: Array) -> tuple[Array, Array]:
        """Derivatives of h by the pose (3,) and by the landmark (3,), each (3, 3)."""
        body = point.to_robot(*pose, *landmark)
        c = point.to_sensor(*body, self.mount)
        J = np.reshape(stereo.project_jacobian(*c, self.f, self.B), (3, 3)) if self.uvd else np.eye(3)
        world_to_robot = heading_matrix(pose[2]).T
        d_body = np.column_stack([-world_to_robot[:, 0], -world_to_robot[:, 1], [body[1], -body[0], 0.0]])
        return J @ self.turn.T @ d_body, J @ self.turn.T @ world_to_robot

    def locate(self, pose: Array, z: Array) -> tuple[Array, Array, Array]:
        """Landmark (3,) in m from one observation z (3,) at ``pose`` (3,), with its Jacobians (3, 3) by pose and z."""
        c, J = z, np.eye(3)
        if self.uvd:
            u, v, d = z
            c = np.array(stereo.triangulate(u, v, d, self.f, self.B))
            J = np.reshape(stereo.triangulate_jacobian(u, v, d, self.f, self.B), (3, 3))
        body = point.from_sensor(c[0], c[1], c[2], self.mount)
        robot_to_world = heading_matrix(pose[2])
        d_heading = robot_to_world @ [-body[1], body[0], 0.0]
        d_pose = np.column_stack([[1.0, 0, 0], [0, 1.0, 0], d_heading])
        return np.array(point.to_world(pose[0], pose[1], pose[2], *body)), d_pose, robot_to_world @ self.turn @ J

    def less(self, z: Array, about: Array) -> Array:
        difference: Array = z - about
        return difference


class PlanarSensor:
    """Relative position or range and bearing of landmarks in the plane, from a mounted sensor."""

    size = width = 2

    def __init__(self, sensor: BelievedSensor) -> None:
        self.space, self.bearing = PointSensor(sensor, uvd=False), sensor.model == "range-bearing"

    def measure(self, pose: Array, landmark: Array) -> Array:
        """h: observations (..., 2) of landmarks (..., 2), m, from poses (..., 3)."""
        x, y, _ = np.moveaxis(self.space.measure(pose, at_height_zero(landmark)), -1, 0)
        return np.stack(planar.range_bearing(x, y) if self.bearing else (x, y), axis=-1)

    def jacobians(self, pose: Array, landmark: Array) -> tuple[Array, Array]:
        """Derivatives of h by the pose (3,) and by the landmark (2,), (2, 3) and (2, 2)."""
        here = at_height_zero(landmark)
        x, y, _ = self.space.measure(pose, here)
        J = np.reshape(planar.range_bearing_jacobian(x, y), (2, 2)) if self.bearing else np.eye(2)
        Hp, Hl = self.space.jacobians(pose, here)
        return J @ Hp[:2], J @ Hl[:2, :2]

    def locate(self, pose: Array, z: Array) -> tuple[Array, Array, Array]:
        """Landmark (2,) in m from one observation z (2,) at ``pose`` (3,), with Jacobians (2, 3), (2, 2) by both."""
        c, J = z, np.eye(2)
        if self.bearing:
            c = np.array(planar.at_range_bearing(z[0], z[1]))
            J = np.reshape(planar.at_range_bearing_jacobian(z[0], z[1]), (2, 2))
        landmark, Jp, Jz = self.space.locate(pose, at_height_zero(c))
        return landmark[:2], Jp[:2], Jz[:2, :2] @ J

    def less(self, z: Array, about: Array) -> Array:
        """z (..., 2) less another observation (..., 2), a bearing by the shorter way round."""
        difference: Array = z - about
        if self.bearing:
            difference[..., 1] -= 2.0 * np.pi * np.rint(difference[..., 1] / (2.0 * np.pi))
        return difference


def mounted(sensor: BelievedSensor) -> tuple[Array, Array]:
    """Position (3,) of a sensor in the frame of the robot, m, and its axes (3, 3) as columns."""
    mount = np.array(sensor.mount.packed())
    return mount[:3], mount[3:].reshape(3, 3)


def view(sensor: BelievedSensor, uvd: bool) -> PointSensor | PlanarSensor:
    """What a filter takes the sensor to measure: raw (u, v, d) where ``uvd``, else what its model says, or points."""
    return PlanarSensor(sensor) if sensor.model in PLANAR_SENSORS else PointSensor(sensor, uvd)


def at_height_zero(point: Array) -> Array:
    """Points (..., 3) of points in the plane (..., 2)."""
    return np.concatenate([point, np.zeros_like(point[..., :1])], axis=-1)


def heading_matrix(heading: float) -> Array:
    """Rotation (3, 3) from the robot frame to the world."""
    c, s = np.cos(heading), np.sin(heading)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
