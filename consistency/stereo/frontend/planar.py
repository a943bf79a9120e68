"""Motions in space as those of a robot on a plane: forward, left, up, and the heading about up."""

from __future__ import annotations

import numpy as np

from consistency.bench.models.motion import dead_reckoning
from consistency.referee.types import Array

WITHIN = 30.0  # degrees between optical axis and motion; a camera that looks elsewhere does not tell what is forward
MOVED = 0.1  # m over the whole sequence; below, a rig that stands still has no direction
OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # forward, left, up <- right, down, forward


def robot_axes(t: Array) -> Array:
    """Axes forward, left, up of the robot in those of the camera (right, down, forward), rows, (3, 3).

    Forward is the mean direction of the motions, so that the robot goes where it heads; the camera's rows are level.
    Where the rig moves less than 10 cm in all, or more than 30 degrees off the optical axis, forward is the optical
    axis.

    Parameters
    ----------
    t : (T, 3), translations from frame to frame in camera axes, m
    """
    total = t.sum(axis=0)
    forward = total * np.where(total[2] < 0.0, -1.0, 1.0) / max(float(np.linalg.norm(total)), 1e-12)
    if np.linalg.norm(total) < MOVED or forward[2] < np.cos(np.deg2rad(WITHIN)):
        return OPTICAL.copy()
    left = np.cross([0.0, -1.0, 0.0], forward)
    left /= np.linalg.norm(left)
    return np.array([forward, left, np.cross(forward, left)])


def in_robot_axes(R: Array, t: Array, axes: Array, lever: float) -> tuple[Array, Array]:
    """Motions (T, 3, 3), (T, 3) of the camera as those of a robot point ``lever`` m behind it, in robot axes."""
    ahead = np.array([lever, 0.0, 0.0])
    turn = axes @ R @ axes.T
    return turn, t @ axes.T + ahead - turn @ ahead


def planar_motions(R: Array, t: Array) -> Array:
    """Forward, left (m) and turn (rad) of motions (T, 3, 3), (T, 3) in robot axes, (T, 3).

    Height, roll and pitch are left out step by step: a slope is unrolled, nothing of it adds up.
    """
    return np.column_stack([t[:, :2], np.arctan2(R[:, 1, 0], R[:, 0, 0])])


def planar_path(motions: Array) -> Array:
    """Poses x, y, heading (T + 1, 3) from :func:`planar_motions`, from the origin on; the heading is not wrapped."""
    ones = np.ones(len(motions))
    along = dead_reckoning(np.zeros(3), np.column_stack([ones, motions[:, 0], motions[:, 2]]))
    heading = along[:-1, 2]
    aside = np.cumsum(motions[:, 1:2] * np.column_stack([-np.sin(heading), np.cos(heading)]), axis=0)
    along[1:, :2] += aside
    return along
