"""Registrations and refinement against SciPy's."""

import numpy as np
import pytest
from rigs import MOTION, RIG
from scipy.optimize import approx_fprime, least_squares
from scipy.spatial.transform import Rotation

from consistency.vision import (
    RelativePose,
    refine_reprojection,
    register_horn,
    register_svd,
    register_weighted,
    registration_covariance,
    triangulate,
    triangulation_covariance,
)


def frames(rng, n, noise):
    p = rng.uniform([-2, -1.5, 4], [2, 1.5, 10], (n, 3))
    uv = [RIG.project(q) for q in (p, MOTION.inverse().apply(p))]
    return uv[0] + rng.normal(0, noise, (n, 4)), uv[1] + rng.normal(0, noise, (n, 4))


def solution(fun, start):
    return np.asarray(
        least_squares(fun, start, method="trf", x_scale="jac", jac="3-point", ftol=1e-15, xtol=1e-15, gtol=1e-15).x
    )


@pytest.mark.parametrize("register", [register_svd, register_horn])
def test_registration_is_align_vectors(register, rng):
    for _ in range(20):
        R = Rotation.random(rng=rng).as_matrix()
        p2 = rng.normal(size=(8, 3)) + rng.normal(0, 9, 3)
        p1 = p2 @ R.T + rng.normal(0, 5, 3) + rng.normal(0, 0.3, (8, 3))
        theirs = Rotation.align_vectors(p1 - p1.mean(0), p2 - p2.mean(0))[0].as_matrix()
        ours = register(p1, p2)
        assert np.abs(ours.R - theirs).max() < 1e-9
        assert np.abs(ours.t - (p1.mean(0) - theirs @ p2.mean(0))).max() < 1e-8


def test_refinement_is_least_squares(rng):
    """Pose and points of the bundle to 1e-8, with different noise for each match and frame."""
    n = 12
    uv1, uv2 = frames(rng, n, 1.0)
    sigma1, sigma2 = rng.uniform(0.5, 2.0, (2, n))
    S1, S2 = (np.square(s)[:, None, None] * np.eye(4) for s in (sigma1, sigma2))
    start = register_svd(triangulate(RIG, uv1), triangulate(RIG, uv2))
    ours = refine_reprojection(RIG, uv1, uv2, start, S1, S2)

    def fun(x):
        pose, q = RelativePose.from_vector(x[:6]), x[6:].reshape(n, 3)
        e1 = (RIG.project(pose.apply(q)) - uv1) / sigma1[:, None]
        e2 = (RIG.project(q) - uv2) / sigma2[:, None]
        return np.concatenate([e1.ravel(), e2.ravel()])

    x = solution(fun, np.concatenate([start.vector, triangulate(RIG, uv2).ravel()]))
    assert np.abs(ours.pose.vector - x[:6]).max() < 1e-8
    assert np.abs(ours.points - RelativePose.from_vector(x[:6]).apply(x[6:].reshape(n, 3))).max() < 1e-6
    assert ours.chi2 == pytest.approx(float(np.sum(fun(x) ** 2)), rel=1e-10)
    assert ours.dof == 8 * n - 3 * n - 6
    assert np.abs(start.vector - x[:6]).max() > 1e-4  # negative control: the start is another estimate


@pytest.mark.parametrize("robust", [None, "huber", "cauchy"])
def test_weighted_registration_is_least_squares(robust, rng):
    """The minimum of the sum of rho(e' (S1 + R S2 R')^-1 e) to 1e-8, with an outlier for the losses."""
    n = 15
    root = rng.normal(0, 0.1, (2, n, 3, 3))
    S1, S2 = root @ np.swapaxes(root, -1, -2) + 0.001 * np.eye(3)
    p2 = rng.uniform([-2, -1.5, 4], [2, 1.5, 10], (n, 3))
    p1 = MOTION.apply(p2) + np.einsum("nij,nj->ni", np.linalg.cholesky(S1 + S2), rng.normal(size=(n, 3)))
    p1[0] += 1.0
    ours = register_weighted(p1, p2, S1, S2, robust=robust)
    c2 = 7.814727903251179  # 95 % quantile of chi-square(3)

    def cost(x):
        pose = RelativePose.from_vector(x)
        e = p1 - pose.apply(p2)
        s = np.einsum("ni,ni->n", e, np.linalg.solve(S1 + pose.R @ S2 @ pose.R.T, e[:, :, None])[:, :, 0])
        if robust == "huber":
            s = np.where(s > c2, 2 * np.sqrt(c2 * s) - c2, s)
        elif robust == "cauchy":
            s = c2 * np.log1p(s / c2)
        return float(s.sum())

    gradient = approx_fprime(ours.pose.vector, cost, 1e-7)
    spread = np.sqrt(np.diagonal(ours.covariance))
    assert np.abs(gradient * spread).max() < 1e-4  # flat to 1e-4 standard deviations
    for k in range(6):
        for sign in (-1, 1):
            assert cost(ours.pose.vector + sign * 0.05 * spread * (np.arange(6) == k)) > cost(ours.pose.vector)
    if robust:
        assert ours.weights[0] < 0.5 < ours.weights[1:].mean()


@pytest.mark.parametrize("robust", [None, "huber", "cauchy"])
def test_covariances_are_those_of_the_estimators(robust, rng):
    """J S J' with J from differences of the estimators themselves, noise, outlier and all."""
    n = 8
    uv1, uv2 = frames(rng, n, 1.0)
    uv1[0, :2] += 6.0
    start = register_svd(triangulate(RIG, uv1), triangulate(RIG, uv2))
    ours = refine_reprojection(RIG, uv1, uv2, start, 0.5 * np.eye(4), robust=robust)

    def refined(z):
        a, b = z.reshape(2, n, 4)
        return refine_reprojection(RIG, a, b, ours.pose, 0.5 * np.eye(4), robust=robust).pose.vector

    J = jacobian(refined, np.concatenate([uv1.ravel(), uv2.ravel()]), 1e-3)
    assert ours.covariance == pytest.approx(0.5 * J @ J.T, rel=1e-4, abs=1e-7 * ours.covariance.max())
    assert ours.covariance != pytest.approx(0.51 * J @ J.T, rel=1e-4, abs=1e-7 * ours.covariance.max())


def test_propagation_is_that_of_the_registration(rng):
    """Both steps of sec. 2.3 at noisy matches against differences of triangulation and registration."""
    n = 6
    uv1, uv2 = frames(rng, n, 1.0)
    S1, S2 = (triangulation_covariance(RIG, uv, np.eye(4)) for uv in (uv1, uv2))
    p1, p2 = triangulate(RIG, uv1), triangulate(RIG, uv2)
    ours = registration_covariance(p1, p2, S1, S2, register_svd(p1, p2))

    def registered(z):
        a, b = z.reshape(2, n, 4)
        return register_svd(triangulate(RIG, a), triangulate(RIG, b)).vector

    J = jacobian(registered, np.concatenate([uv1.ravel(), uv2.ravel()]), 1e-3)
    assert ours == pytest.approx(J @ J.T, rel=1e-4, abs=1e-7 * ours.max())


def jacobian(fun, x, h):
    return np.array([(fun(x + h * e) - fun(x - h * e)) / (2 * h) for e in np.eye(len(x))]).T
