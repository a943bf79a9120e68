"""The map at the end of a compiled trial: landmarks in the world, with their covariance."""

from __future__ import annotations

import numpy as np

from consistency.filters.kernel.slam import (
    Slam,
    State,
    landmark_width,
    robot_frame,
    robot_width,
    to_error,
    world_point,
)
from consistency.types import Gaussian


def landmarks_of(slam: Slam, state: State) -> dict[int, Gaussian]:
    """Landmarks by label, position (3,) in m and covariance of its additive error (3, 3)."""
    r, w = robot_width(slam.motion), landmark_width(slam.landmark)
    P = np.triu(state.P[: state.n, : state.n])
    pose = state.x[:r]
    frame = robot_frame(slam.motion, pose)
    out = {}
    for label in np.flatnonzero(state.offset >= 0):
        o = state.offset[label]
        point, D = np.empty(3), np.zeros((3, r + w))
        values = state.x[o : o + w]
        world_point(slam.landmark, frame, values, point, D[:, :r], D[:, r:])
        to_error(slam.error, pose, values, D[:, :r], D[:, r:])
        at = np.r_[:r, o : o + w]
        half = P[np.ix_(at, at)]
        out[int(label)] = Gaussian(point, D @ (half + half.T - np.diag(np.diag(half))) @ D.T)
    return out
