"""EKF-SLAM on landmarks of six numbers, anchored at where they were first seen: Civera, Davison & Montiel (2008).

A landmark is the position of the sensor when it was first seen (x0, y0, z0 in m), azimuth and elevation of the ray
in the world (rad), and the inverse of its length (1/m). In inverse depth the error of stereo is nearly Gaussian at
any distance. The price is a state of twice the size.
"""

from __future__ import annotations

import numpy as np

from consistency.bench.filters.textbook import basics
from consistency.bench.filters.textbook.basics import PointSensor, SlamState, heading_matrix
from consistency.bench.filters.textbook.ekf import ExtendedKalman
from consistency.bench.filters.textbook.inverse_range import unit_vectors
from consistency.bench.protocols import Problem
from consistency.bench.types import Gaussian, Info
from consistency.referee.types import Array


class AnchoredKalman(ExtendedKalman):
    """EKF-SLAM on anchored landmarks, their Jacobians through the point in the world."""

    def init(self, problem: Problem) -> SlamState:
        return basics.start(problem, width=6)

    def _correct(self, state: SlamState, seen: list[int], z: Array, R: Array) -> tuple[SlamState, Info]:
        sensor = PointSensor(state.problem.belief.sensor, self.uvd)
        zhat, H = np.zeros(3 * len(seen)), np.zeros((3 * len(seen), len(state.x)))
        for i, label in enumerate(seen):
            rows, at = slice(3 * i, 3 * i + 3), slice(state.at(label), state.at(label) + 6)
            point, D = anchored_point(state.x[at])
            zhat[rows] = sensor.measure(state.x[:3], point)
            H[rows, :3], by_point = sensor.jacobians(state.x[:3], point)
            H[rows, at] = by_point @ D
        return basics.corrected(state, H, z.ravel() - zhat, R)

    def _locate(self, state: SlamState, label: int, z: Array) -> tuple[Array, Array, Array]:
        point, point_by_pose, point_by_z = basics.locate_point(state, z, self.uvd)
        turn = heading_matrix(state.x[2])
        mount = np.array(state.problem.belief.sensor.mount.position)
        anchor = [*state.x[:2], 0.0] + turn @ mount
        anchor_by_pose = np.column_stack([[1.0, 0, 0], [0, 1.0, 0], turn @ [-mount[1], mount[0], 0.0]])
        ray = point - anchor
        flat, length = np.hypot(ray[0], ray[1]), np.linalg.norm(ray)
        values = np.array([*anchor, np.arctan2(ray[1], ray[0]), np.arctan2(ray[2], flat), 1.0 / length])
        # azimuth, elevation and inverse length by the point: the inverse of the point by them
        by_ray = np.linalg.inv(anchored_point(values)[1][:, 3:])
        Jp = np.vstack([anchor_by_pose, by_ray @ (point_by_pose - anchor_by_pose)])
        return values, Jp, np.vstack([np.zeros((3, 3)), by_ray @ point_by_z])

    def map(self, state: SlamState) -> dict[int, Gaussian]:
        blocks = {label: slice(state.at(label), state.at(label) + 6) for label in state.landmarks}
        points = {label: anchored_point(state.x[at]) for label, at in blocks.items()}
        return {label: Gaussian(p, D @ state.P[blocks[label], blocks[label]] @ D.T) for label, (p, D) in points.items()}

    def joint(self, state: SlamState) -> Gaussian:
        blocks = [slice(at, at + 6) for at in range(3, len(state.x), 6)]
        mean, D = np.zeros(3 + 3 * len(blocks)), np.zeros((3 + 3 * len(blocks), len(state.x)))
        mean[:3], D[:3, :3] = state.x[:3], np.eye(3)
        for i, at in enumerate(blocks, 1):
            mean[3 * i : 3 * i + 3], D[3 * i : 3 * i + 3, at] = anchored_point(state.x[at])
        return Gaussian(mean, D @ state.P @ D.T)


def anchored_point(values: Array) -> tuple[Array, Array]:
    """Point (3,) in the world of a landmark's six numbers, with its Jacobian (3, 6)."""
    rho, (ray, by_angles) = values[5], unit_vectors(values[3:])
    return values[:3] + ray / rho, np.column_stack([np.eye(3), by_angles / rho, -ray / rho**2])
