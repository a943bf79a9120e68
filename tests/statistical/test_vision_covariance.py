"""Propagated covariances against the spread of 100,000 estimates, where first order holds.

The pixel noise is so small that second-order terms stay far below the sampling error, which is 0.4 % of a variance. The
unweighted registration needs less of it: at 0.05 px it already fails this test, in the directions that it fixes best.
"""

import numpy as np
import pytest
from rigs import RIG
from scipy import stats

from consistency.stereo.visual_odometry.relative_pose import rigid_motions
from consistency.vision import (
    RelativePose,
    refine_reprojection,
    register_svd,
    register_weighted,
    registration_covariance,
    triangulate,
    triangulation_covariance,
)

pytestmark = pytest.mark.slow

SAMPLES, CHUNK = 100_000, 500  # which stay in the cache of a processor
FALSE_ALARM = 1e-5  # of each test
NOISE, LESS = 0.05, 0.01  # px
POINTS = 8
MOTION = RelativePose.from_vector(np.array([0.3, -0.2, 0.4, 0.04, -0.5, 2.0]))  # far from the identity
S_UV = NOISE**2 * (np.eye(4) + 0.3 * np.eye(4, k=1) + 0.3 * np.eye(4, k=-1))


def discrepancy(estimates, covariance):
    """Smallest p-value over the entries of the whitened sample covariance, times their number (Bonferroni).

    Whitened by the right covariance its entries are independent in the limit, with variances 2/n and 1/n; at
    n = 100,000 the normal approximation errs by far less than a factor of two at five standard deviations.
    """
    n, m = estimates.shape
    white = np.linalg.solve(np.linalg.cholesky(covariance), (estimates - estimates.mean(axis=0)).T)
    z = (white @ white.T / (n - 1) - np.eye(m)) * np.sqrt(n / (1 + np.eye(m)))
    worst = np.abs(z[np.tril_indices(m)]).max()
    return float(2 * stats.norm.sf(worst) * m * (m + 1) / 2)


def holds(estimates, covariance):
    """The right covariance is accepted, and one that is 3 % off in one direction is not."""
    assert discrepancy(estimates, covariance) > FALSE_ALARM
    wrong = covariance.copy()
    wrong[0] *= np.sqrt(1.03)
    wrong[:, 0] *= np.sqrt(1.03)
    assert discrepancy(estimates, wrong) < FALSE_ALARM


@pytest.fixture(scope="module")
def scene():
    """True points in frame 1 and 2."""
    rng = np.random.default_rng(2)
    p = rng.uniform([-2, -1.5, 4], [2, 1.5, 7], (POINTS, 3))
    turn = RelativePose(MOTION.R, p.mean(axis=0) - MOTION.R @ p.mean(axis=0))  # so that both frames see the points
    return p, turn.inverse().apply(p)


def drawn(rng, p, noise=NOISE):
    """(CHUNK, N, 4) noisy matches."""
    root = np.linalg.cholesky(S_UV) * noise / NOISE
    return RIG.project(p) + rng.normal(size=(CHUNK, len(p), 4)) @ root.T


def vectors(R, t):
    angles = [np.arctan2(R[:, 2, 1], R[:, 2, 2]), -np.arcsin(R[:, 2, 0]), np.arctan2(R[:, 1, 0], R[:, 0, 0])]
    return np.column_stack([t, *angles])


def clouds(uv):
    return triangulate(RIG, uv.reshape(-1, 4)).reshape(*uv.shape[:2], 3)


def test_triangulation(scene):
    """False alarm 1e-5."""
    rng = np.random.default_rng(3)
    points = np.concatenate([triangulate(RIG, drawn(rng, scene[0][:1])[:, 0]) for _ in range(SAMPLES // CHUNK)])
    holds(points, triangulation_covariance(RIG, RIG.project(scene[0][:1]), S_UV)[0])


def test_registration(scene):
    """Pixels to pose through both steps, at a rotation of 2 rad and a translation of metres. False alarm 1e-5."""
    rng, poses = np.random.default_rng(4), []
    for _ in range(SAMPLES // CHUNK):
        R, t, _ = rigid_motions(*(clouds(drawn(rng, p, LESS)) for p in scene))
        poses.append(vectors(R, t))
    S1, S2 = (triangulation_covariance(RIG, RIG.project(p), S_UV * (LESS / NOISE) ** 2) for p in scene)
    holds(np.concatenate(poses), registration_covariance(*scene, S1, S2, register_svd(*scene)))


def test_weighted_registration(scene):
    """Points with fixed, correlated noise. False alarm 1e-5."""
    p1, p2 = scene
    S1, S2 = (triangulation_covariance(RIG, RIG.project(p), S_UV) for p in scene)
    noise = [np.linalg.cholesky(S) for S in (S1, S2)]
    rng, poses = np.random.default_rng(5), []
    G1, G2 = (np.linalg.inv(S) for S in (S1, S2))
    W = np.zeros((6 * POINTS, 6 * POINTS))
    for n, (a, b) in enumerate(zip(G1, G2, strict=True)):
        W[3 * n : 3 * n + 3, 3 * n : 3 * n + 3] = a
        W[3 * (POINTS + n) :, 3 * (POINTS + n) :][:3, :3] = b
    start = register_svd(p1, p2)
    for _ in range(SAMPLES // CHUNK):
        z1, z2 = (
            p + np.einsum("nij,mnj->mni", root, rng.normal(size=(CHUNK, POINTS, 3)))
            for p, root in zip(scene, noise, strict=True)
        )
        poses.append(gauss_newton(None, z1, z2, W, start, p2))
    for k in range(3):
        ours = register_weighted(z1[k], z2[k], S1, S2).pose.vector
        assert np.abs(ours - poses[-1][k]).max() < 1e-9
    holds(np.concatenate(poses), register_weighted(p1, p2, S1, S2).covariance)


def test_reprojection(scene):
    """The bundle of two frames. False alarm 1e-5."""
    p1, p2 = scene
    start = register_svd(p1, p2)
    W = np.kron(np.eye(2 * POINTS), np.linalg.inv(S_UV))
    rng, poses = np.random.default_rng(6), []
    for _ in range(SAMPLES // CHUNK):
        z1, z2 = drawn(rng, p1), drawn(rng, p2)
        poses.append(gauss_newton(RIG.cameras, z1, z2, W, start, p2))
    for k in range(3):
        ours = refine_reprojection(RIG, z1[k], z2[k], start, S_UV).pose.vector
        assert np.abs(ours - poses[-1][k]).max() < 1e-8
    holds(np.concatenate(poses), refine_reprojection(RIG, RIG.project(p1), RIG.project(p2), start, S_UV).covariance)


def gauss_newton(cameras, z1, z2, W, start, q):
    """Poses (M, 6) of M bundles at once, all unknowns in one matrix, from the truth: a second way to the minimum.

    The rotation is updated by a left perturbation; without cameras the points themselves are measured.
    """
    M, N, k = z1.shape
    R, t = np.tile(start.R, (M, 1, 1)), np.tile(start.t, (M, 1))
    q = np.tile(q, (M, 1, 1))
    for _ in range(3):
        turned = q @ np.swapaxes(R, 1, 2)
        h1, J1 = seen(cameras, turned + t[:, None])
        h2, J2 = seen(cameras, q)
        e = np.concatenate([(z1 - h1).reshape(M, -1), (z2 - h2).reshape(M, -1)], axis=1)
        J = np.zeros((M, 2, N, k, 6 + 3 * N))
        J[:, 0, ..., :3] = J1
        J[:, 0, ..., 3:6] = -J1 @ skew(turned)
        for n in range(N):
            J[:, 0, n, :, 6 + 3 * n : 9 + 3 * n] = J1[:, n] @ R
            J[:, 1, n, :, 6 + 3 * n : 9 + 3 * n] = J2[:, n]
        J = J.reshape(M, 2 * N * k, -1)
        JtW = np.swapaxes(J, 1, 2) @ W
        step = np.linalg.solve(JtW @ J, JtW @ e[:, :, None])[:, :, 0]
        t = t + step[:, :3]
        R = cayley(step[:, 3:6]) @ R
        q = q + step[:, 6:].reshape(M, N, 3)
    return vectors(R, t)


def seen(cameras, p):
    if cameras is None:
        return p, np.broadcast_to(np.eye(3), (*p.shape[:2], 3, 3))
    h = np.einsum("cij,mnj->mnci", cameras[:, :, :3], p) + cameras[:, :, 3]
    uv = h[..., :2] / h[..., 2:]
    J = (cameras[:, :2, :3] - uv[..., None] * cameras[:, None, 2, :3]) / h[..., 2:, None]
    return uv.reshape(*p.shape[:2], 4), J.reshape(*p.shape[:2], 4, 3)


def skew(v):
    out = np.zeros((*v.shape, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    return out - np.swapaxes(out, -1, -2)


def cayley(omega):
    """A rotation that is I + [omega]x to first order."""
    half = 0.5 * skew(omega)
    return np.linalg.solve(np.eye(3) - half, np.eye(3) + half)
