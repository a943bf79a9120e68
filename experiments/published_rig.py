"""The simulated rig and scenes of Valencia & Andrade-Cetto (2018) sec. 2.3.3.1.

The rig's pose is printed. Camera matrices, the motion and where points are is not: what stands here was chosen.
"""

from __future__ import annotations

import numpy as np

from consistency.referee import geometry
from consistency.referee.types import Array
from consistency.stereo.visual_odometry.relative_pose import RelativePose
from consistency.stereo.visual_odometry.rig import StereoRig

TRANSLATION, ANGLES = np.array([0.385, 0.007, 0.0]), (0.040, 0.016, 0.014)  # printed; m and rad, of the right camera
FOCAL, SIZE = 500.0, (640, 480)  # px: a field of view of 65 degrees
MOTION = RelativePose.from_vector(np.array([0.1, 0.05, 0.3, 0.02, 0.05, -0.03]))  # m, rad: a walking robot's step


def published_rig(baseline: float | None = None) -> StereoRig:
    """The printed rig; given a baseline in m, with its cameras moved that far apart along the same line."""
    K = np.array([[FOCAL, 0.0, SIZE[0] / 2], [0.0, FOCAL, SIZE[1] / 2], [0.0, 0.0, 1.0]])
    stretch = 1.0 if baseline is None else baseline / float(np.linalg.norm(TRANSLATION))
    return StereoRig(K, K, geometry.rotation(*ANGLES), stretch * TRANSLATION, SIZE)


def disparity_noise(rig: StereoRig, depth: float, noise: float) -> float:
    """Standard deviation of the disparity over the disparity, of a point ``depth`` m away under ``noise`` px."""
    return float(np.sqrt(2.0) * noise * depth / (rig.K_left[0, 0] * rig.baseline))


def common_points(
    rng: np.random.Generator, rig: StereoRig, motion: RelativePose, n: int, near: float, far: float
) -> Array:
    """Points uniform in the space that all four images see, between two depths.

    Parameters
    ----------
    motion : p1 = R p2 + t; frame 2 must see part of what frame 1 sees, or this never ends
    near, far : depths in frame 1, m

    Returns
    -------
    (n, 3), in frame 1, m
    """
    points = np.zeros((0, 3))
    back = np.linalg.inv(rig.K_left).T
    while len(points) < n:
        z = np.cbrt(rng.uniform(near**3, far**3, 8 * n))
        pixels = np.column_stack([rng.uniform(0.0, rig.image_size, (8 * n, 2)), np.ones(8 * n)])
        p = pixels @ back * z[:, None]
        q = motion.inverse().apply(p)
        p, q = (cloud[q[:, 2] > 0.5 * near] for cloud in (p, q))
        points = np.concatenate([points, p[rig.inside(rig.project(p)) & rig.inside(rig.project(q))]])
    return points[:n]
