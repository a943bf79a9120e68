"""A motion from matched pixels: degrees of freedom of what is left after the pose."""

import numpy as np
import pytest
from rigs import MOTION, RIG
from scipy.spatial.transform import Rotation

from consistency.stereo.visual_odometry.relative_motion import (
    ESTIMATORS,
    MotionSettings,
    disparities,
    estimate_motion,
    usable,
)
from consistency.vision import StereoRig, triangulate, triangulation_covariance

pytest.importorskip("cv2", reason="OpenCV (the extra vision) is not installed")
EQUATIONS = {"reprojection": 5, "svd": 3, "horn": 3}  # of a point: eight pixels less its position, or three coordinates
NOISE = (0.2, 0.6)  # px, in the first and the second frame


def matches(rng, points, outliers=0):
    """Pixels of points at one distance, and their noise; the first ``outliers`` are elsewhere in the second frame."""
    p = rng.uniform([-1, -1, 6], [1, 1, 7], (points, 3))
    moved = MOTION.inverse().apply(p)
    moved[:outliers] += [1.0, -1.0, 2.0]
    sigma0, sigma1 = (np.full((points, 4), noise) for noise in NOISE)
    uv0, uv1 = (RIG.project(q) + s * rng.normal(size=s.shape) for q, s in ((p, sigma0), (moved, sigma1)))
    return uv0, uv1, sigma0, sigma1


@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize("outliers", [0, 7])
def test_six_degrees_of_freedom_are_the_pose(rng, estimator, outliers):
    """Of the inliers' equations six are used up; an inlier is outside the gate of 10 sigma with probability 1e-21."""
    found = estimate_motion(RIG, *matches(rng, 30, outliers), MotionSettings(gate=10.0, estimator=estimator), rng)
    assert not found.inliers[:outliers].any()
    assert found.inliers.sum() > 20
    assert found.dof == EQUATIONS[estimator] * found.inliers.sum() - 6


def test_residuals_have_their_degrees_of_freedom(rng):
    """The chi2 of 120 motions of 8 points together is within 4.5 sigma of its degrees of freedom: 7e-6.

    Without the six of each pose these would be 7 sigma away.
    """
    found = [estimate_motion(RIG, *matches(rng, 8), MotionSettings(gate=10.0), rng) for _ in range(120)]
    assert all(f.inliers.all() for f in found)
    chi2, dof = sum(f.chi2 for f in found), sum(f.dof for f in found)
    assert abs(chi2 - dof) < 4.5 * np.sqrt(2.0 * dof)


@pytest.mark.parametrize("estimator", ["svd", "horn"])
def test_chi2_of_a_registration_by_hand(rng, estimator):
    uv0, uv1, sigma0, sigma1 = matches(rng, 20, 3)
    found = estimate_motion(RIG, uv0, uv1, sigma0, sigma1, MotionSettings(gate=10.0, estimator=estimator), rng)
    chi2 = 0.0
    for i in np.flatnonzero(found.inliers):
        (p0,), (p1,) = (triangulate(RIG, uv[[i]]) for uv in (uv0, uv1))
        (C0,), (C1,) = (
            triangulation_covariance(RIG, uv[[i]], noise**2 * np.eye(4))
            for uv, noise in zip((uv0, uv1), NOISE, strict=True)
        )
        e = p0 - found.pose.apply(p1[None])[0]
        chi2 += e @ np.linalg.solve(C0 + found.pose.R @ C1 @ found.pose.R.T, e)
    assert found.chi2 == pytest.approx(chi2)


def test_a_small_disparity_off_the_epipolar_line_is_not_near():
    """Least squares puts a match of 0.1 px whose rows differ by 1 px at the depth of 10 px."""
    K = np.array([[700.0, 0.0, 600.0], [0.0, 700.0, 180.0], [0.0, 0.0, 1.0]])
    shifted = K.copy()
    shifted[0, 2] += 20.0
    rectified = StereoRig(K, shifted, np.eye(3), np.array([0.54, 0.0, 0.0]), (1200, 360))
    turn = Rotation.from_rotvec([0.01, -0.05, 0.02]).as_matrix()
    turned = StereoRig(K, 1.1 * K - np.diag([0.0, 0.0, 0.1]), turn, np.array([0.5, 0.02, -0.05]), (1200, 360))
    for rig in (rectified, turned):
        depth = 700.0 * rig.baseline / np.array([40.0, 2.5, 1.5, 0.1])
        pixels = rig.project(depth[:, None] * np.array([0.1, 0.05, 1.0]))
        np.testing.assert_allclose(disparities(rig, pixels), [40.0, 2.5, 1.5, 0.1], rtol=0.03)
        assert usable(rig, pixels, 2.0).tolist() == [True, True, False, False]
        off = pixels + np.array([0.0, 0.0, 0.0, 1.0])
        assert triangulate(rig, off)[3, 2] < 700.0 * rig.baseline / 5.0  # negative control
        assert usable(rig, off, 2.0).tolist() == [True, True, False, False]
