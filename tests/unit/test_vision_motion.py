"""A motion from matched pixels: degrees of freedom of what is left after the pose."""

from __future__ import annotations

import numpy as np
import pytest
from rigs import MOTION, RIG

from consistency.vision.motion import ESTIMATORS, Estimate, _estimated

EQUATIONS = {"reprojection": 5, "svd": 3, "horn": 3}  # of a point: eight pixels less its position, or three coordinates
NOISE = 0.3  # px


def motion(rng: np.random.Generator, estimator: str, points: int, outliers: int = 0, gate: float = 10.0) -> Estimate:
    """From points of one distance; the first ``outliers`` are somewhere else in the second frame."""
    p = rng.uniform([-1, -1, 6], [1, 1, 7], (points, 3))
    moved = MOTION.inverse().apply(p)
    moved[:outliers] += [1.0, -1.0, 2.0]
    sigma = np.full((points, 4), NOISE)
    uv0, uv1 = (RIG.project(q) + rng.normal(0.0, NOISE, (points, 4)) for q in (p, moved))
    return _estimated(RIG, uv0, uv1, sigma, sigma, estimator, gate, rng)


@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize("outliers", [0, 7])
def test_six_degrees_of_freedom_are_the_pose(rng: np.random.Generator, estimator: str, outliers: int) -> None:
    """Of the inliers' equations six are used up; an inlier is outside the gate of 10 sigma with probability 1e-21."""
    found = motion(rng, estimator, 30, outliers)
    assert not found.inliers[:outliers].any()
    assert found.inliers.sum() > 20
    assert found.dof == EQUATIONS[estimator] * found.inliers.sum() - 6


def test_residuals_have_their_degrees_of_freedom(rng: np.random.Generator) -> None:
    """The chi2 of 120 motions of 8 points together is within 4.5 sigma of its degrees of freedom: 7e-6.

    Without the six of each pose these would be 7 sigma away.
    """
    found = [motion(rng, "reprojection", 8) for _ in range(120)]
    assert all(f.inliers.all() for f in found)
    chi2, dof = sum(f.chi2 for f in found), sum(f.dof for f in found)
    assert abs(chi2 - dof) < 4.5 * np.sqrt(2.0 * dof)
