"""What the two cases of pycolmap share: a scene, the library's pose of a camera in it, and that of a textbook."""

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

POINTS, FOCAL, CENTRE = 60, 500.0, (320.0, 240.0)  # px; the noise of a pixel is 1
CAMERA = pycolmap.Camera(model="SIMPLE_PINHOLE", width=640, height=480, params=[FOCAL, *CENTRE])
OPTIONS = pycolmap.AbsolutePoseRefinementOptions()
HALF = np.diag([0.5, 0.5, 0.5, 1, 1, 1])  # of a rotation vector: the vector part of its quaternion
OPTIONS.loss_function_scale, OPTIONS.gradient_tolerance = 1e6, 1e-10  # no point is taken for an outlier


def project(x, R, t, points):
    """Pixels, after a rotation vector on the left of cam_from_world and a translation."""
    p = points @ (Rotation.from_rotvec(x[:3]) * R).as_matrix().T + t + x[3:]
    return (FOCAL * p[:, :2] / p[:, 2:] + CENTRE).ravel()


def jacobian(function, *at, h=1e-5):
    return np.column_stack([(function(d, *at) - function(-d, *at)) / (2 * h) for d in h * np.eye(6)])


def simulate(rng, runs, place=0.0):
    """Draws of a pose, points of a scene that stands ``place`` m from the origin along x, and pixels."""
    draws = []
    for _ in range(runs):
        R, t, noise = Rotation.from_rotvec(rng.normal(0, 0.1, 3)), rng.normal(0, 0.2, 3), rng.normal(0, 1, 2 * POINTS)
        points = np.column_stack([rng.uniform(-2, 2, (POINTS, 2)), rng.uniform(4, 8, POINTS)])
        far = R, t - R.apply([place, 0, 0]), points + np.array([place, 0, 0])
        draws.append((*far, project(np.zeros(6), *far) + noise))
    return draws


def library(R, t, points, pixels):
    start = pycolmap.Rigid3d(pycolmap.Rotation3d(R.as_quat()), t)
    everyone = np.ones((POINTS, 1), bool)
    fit = pycolmap.refine_absolute_pose(
        start, pixels.reshape(-1, 2), points, everyone, CAMERA, OPTIONS, return_covariance=True
    )
    pose = fit["cam_from_world"]
    return Rotation.from_quat(pose.rotation.quat), pose.translation, fit["covariance"]


def textbook(R, t, points, pixels):
    """Least squares, and (J'J)^-1."""
    for _ in range(4):
        J = jacobian(project, R, t, points)
        x = np.linalg.lstsq(J, pixels - project(np.zeros(6), R, t, points), rcond=None)[0]
        R, t = Rotation.from_rotvec(x[:3]) * R, t + x[3:]
    return R, t, np.linalg.inv(J.T @ J)
