"""
Ellipses of a visual-odometry motion
====================================

One motion between two stereo pairs is estimated 1,000 times from simulated matches of 60 points. The scatter of the
estimates (black ellipse, 2 sigma) is what the covariance that one of them states (blue) should be.
"""

import matplotlib.pyplot as plt
import numpy as np

from consistency.vision import RelativePose, StereoRig, refine_reprojection

SIGMA = 0.3  # px
rng = np.random.default_rng(101)
K = np.array([[700, 0, 600], [0, 700, 180], [0, 0, 1]])
rig = StereoRig(K, K, np.eye(3), np.array([0.54, 0, 0]), (1200, 360))
motion = RelativePose.from_vector(np.array([0.05, -0.02, 1.2, 0.002, -0.01, 0.003]))

depth = rng.uniform(6, 40, 60)
points = depth[:, None] * np.column_stack([rng.uniform(-0.7, 0.7, 60), rng.uniform(-0.2, 0.2, 60), np.ones(60)])
pixels = rig.project(points), rig.project((points - motion.t) @ motion.R)  # (60, 4) each
estimates = [
    refine_reprojection(rig, *(uv + rng.normal(0, SIGMA, uv.shape) for uv in pixels), motion, SIGMA**2 * np.eye(4))
    for _ in range(1000)
]
samples, stated = np.array([each.pose.vector for each in estimates]), estimates[0].covariance


def ellipse(centre, covariance, sigmas=2):
    """Curve (2, 91) of so many standard deviations."""
    turn = np.linspace(0, 2 * np.pi, 91)
    return centre[:, None] + sigmas * np.linalg.cholesky(covariance) @ [np.cos(turn), np.sin(turn)]


figure, panels = plt.subplots(1, 3, figsize=(7.2, 2.6), layout="constrained")
for axes, pair, unit in zip(panels, ([0, 2], [0, 1], [3, 4]), ("mm", "mm", "mrad"), strict=True):
    cloud = 1e3 * samples[:, pair]
    axes.plot(*cloud.T, ".", color="0.6", ms=2, zorder=0)
    axes.plot(*ellipse(cloud.mean(axis=0), np.cov(cloud.T)), "k", lw=1.5, label="scatter")
    axes.plot(*ellipse(1e3 * motion.vector[pair], 1e6 * stated[np.ix_(pair, pair)]), "C0--", lw=1.5, label="stated")
    x, y = (("x", "y", "z", "roll", "pitch", "yaw")[i] for i in pair)
    axes.set(xlabel=f"{x}, {unit}", ylabel=f"{y}, {unit}")
figure.legend(*panels[0].get_legend_handles_labels(), loc="outside upper center", ncols=2)
