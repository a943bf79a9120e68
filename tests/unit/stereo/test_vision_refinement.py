"""Maximum-likelihood poses: what they gain, robust losses, and refusals."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from rigs import MOTION, RIG
from scipy import stats

from consistency.referee.errors import InputError
from consistency.stereo.visual_odometry import maximum_likelihood as module
from consistency.vision import (
    ConvergenceError,
    DegenerateError,
    PointError,
    RelativePose,
    implicit_covariance,
    refine_reprojection,
    register_svd,
    register_weighted,
    registration_covariance,
    triangulate,
    triangulation_covariance,
)

S = 0.25 * np.eye(4)


@pytest.fixture
def matches(rng):
    p = rng.uniform([-2, -1.5, 4], [2, 1.5, 12], (60, 3))
    uv1, uv2 = RIG.project(p), RIG.project(MOTION.inverse().apply(p))
    return uv1 + rng.normal(0, 0.5, (60, 4)), uv2 + rng.normal(0, 0.5, (60, 4))


def initial(uv1, uv2):
    return register_svd(triangulate(RIG, uv1), triangulate(RIG, uv2))


def test_weights_pay(matches):
    """The stated covariance of unweighted registration is larger than the weighted one's, and that the bundle's."""
    uv1, uv2 = matches
    p1, p2 = triangulate(RIG, uv1), triangulate(RIG, uv2)
    S1, S2 = triangulation_covariance(RIG, uv1, S), triangulation_covariance(RIG, uv2, S)
    plain = registration_covariance(p1, p2, S1, S2, register_svd(p1, p2))
    weighted = register_weighted(p1, p2, S1, S2).covariance
    bundle = refine_reprojection(RIG, uv1, uv2, initial(uv1, uv2), S).covariance
    assert np.linalg.eigvalsh(plain - weighted)[-1] > 0.5 * np.linalg.eigvalsh(plain)[-1]
    assert np.trace(bundle[:3, :3]) < 1.1 * np.trace(weighted[:3, :3])


@pytest.mark.parametrize("robust", ["huber", "cauchy"])
def test_an_outlier_loses_its_weight(robust, matches):
    uv1, uv2 = matches
    clean = refine_reprojection(RIG, uv1, uv2, initial(uv1, uv2), S)
    assert clean.weights.tolist() == [1.0] * 60
    bad = uv1.copy()
    bad[:3] += [15.0, -9.0, 15.0, -9.0]
    start = initial(bad, uv2)
    plain = refine_reprojection(RIG, bad, uv2, start, S)
    found = refine_reprojection(RIG, bad, uv2, start, S, robust=robust)
    error, without = (np.linalg.norm(r.pose.t - clean.pose.t) for r in (found, plain))
    assert error < 0.5 * without
    assert found.weights[:3].max() < 0.3 < 0.6 < np.median(found.weights)


def test_weights_are_those_of_a_residual_that_an_honest_point_exceeds_in_one_of_twenty(matches):
    """Huber's weight c / sqrt(s) beyond c; the points cost 3 of 8 equations, or of 6."""
    uv1, uv2 = matches
    p1, p2 = triangulate(RIG, uv1), triangulate(RIG, uv2)
    S1, S2 = triangulation_covariance(RIG, uv1, S), triangulation_covariance(RIG, uv2, S)
    pixels = refine_reprojection(RIG, uv1, uv2, initial(uv1, uv2), 0.3 * S, robust="huber")
    points = register_weighted(p1, p2, 0.3 * S1, 0.3 * S2, robust="huber")
    for found, free in ((pixels, 5), (points, 3)):
        expected = np.minimum(1.0, np.sqrt(stats.chi2.isf(0.05, free) / found.residuals))
        assert (expected < 1.0).any()
        assert_allclose(found.weights, expected)


def test_matches_must_fit(matches):
    uv1, uv2 = matches
    start = initial(uv1, uv2)
    with pytest.raises(InputError, match="uv1, uv2: 60, 59 rows"):
        refine_reprojection(RIG, uv1, uv2[:59], start, S)
    with pytest.raises(DegenerateError, match="2 points"):
        refine_reprojection(RIG, uv1[:2], uv2[:2], start, S)
    with pytest.raises(DegenerateError, match="identical"):
        refine_reprojection(RIG, uv1[[0] * 9], uv2[[0] * 9], start, S)
    with pytest.raises(PointError, match="zero or negative disparity"):
        refine_reprojection(RIG, uv1[:, [2, 3, 0, 1]], uv2, start, S)
    with pytest.raises(PointError, match="behind a camera"):
        refine_reprojection(RIG, uv1, uv2, RelativePose(np.eye(3), np.array([0.0, 0.0, -50.0])), S)


def test_noise_must_be_some(matches):
    uv1, uv2 = matches
    start = initial(uv1, uv2)
    with pytest.raises(InputError, match="S_uv: not positive definite"):
        refine_reprojection(RIG, uv1, uv2, start, np.diag([1.0, 1.0, 1.0, 0.0]))
    with pytest.raises(InputError, match="S_uv2: not symmetric"):
        refine_reprojection(RIG, uv1, uv2, start, S, S + np.eye(4, k=1))
    with pytest.raises(InputError, match="robust: 'tukey'"):
        refine_reprojection(RIG, uv1, uv2, start, S, robust="tukey")  # type: ignore[arg-type]


def test_a_minimum_that_is_not_reached(matches, monkeypatch):
    uv1, uv2 = matches
    monkeypatch.setattr(module, "STEPS", 2)
    with pytest.raises(ConvergenceError, match="no minimum in 2 steps"):
        refine_reprojection(RIG, uv1, uv2, initial(uv1, uv2), S)


def test_the_theorem_needs_a_minimum():
    with pytest.raises(DegenerateError, match="no minimum"):
        implicit_covariance(np.diag([1.0, -1.0]), np.ones((1, 2, 1)), np.ones((1, 1, 1)))
