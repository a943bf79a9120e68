"""Closed-form derivatives of every cost of the front-end against automatic differentiation, to 1e-8."""

import numpy as np
import pytest
from hyperdual import HyperDual, derivatives

from consistency.referee.geometry import rotation
from consistency.stereo.visual_odometry.maximum_likelihood import (
    PixelMatches,
    PointMatches,
    TwoFrames,
    _profile,
    loss,
    registration_derivatives,
    triangulation_derivatives,
)
from consistency.stereo.visual_odometry.maximum_likelihood import cost_derivatives as two_frame_derivatives
from consistency.vision import RelativePose, StereoRig, register_svd, triangulate

TOLERANCE = 1e-8  # of the largest entry
K = np.array([[500.0, 1.5, 320.0], [0.0, 510.0, 240.0], [0.0, 0.0, 1.0]])
RIG = StereoRig(K, K + np.diag([9.0, -7.0, 0.0]), rotation(0.04, 0.016, 0.014), [0.385, 0.007, 0.02], (640, 480))
POSES = [(0.0,) * 6, (0.3, -0.2, 0.9, 0.04, -0.03, 0.2), (-4.0, 2.0, 7.0, 2.5, -1.1, -2.9)]


def close(a, b):
    return a.shape == b.shape and float(np.abs(a - b).max()) <= TOLERANCE * float(np.abs(b).max())


def matrix(angles):
    """Rz Ry Rx written out."""
    (sr, sp, sy), (cr, cp, cy) = [a.sin() for a in angles], [a.cos() for a in angles]
    return [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]


def moved(d, q):
    return [sum((m * x for m, x in zip(row, q, strict=True)), t) for row, t in zip(matrix(d[3:]), d[:3], strict=True)]


def seen(p):
    """u, v, u', v' from the cameras' matrices."""
    out = []
    for camera in RIG.cameras:
        a, b, w = (row[0] * p[0] + row[1] * p[1] + row[2] * p[2] + row[3] for row in camera)
        out += [a / w, b / w]
    return out


def quadratic(e, W):
    terms = [e[i] * e[j] * W[i, j] for i in range(len(e)) for j in range(len(e))]
    return 0.5 * sum(terms[1:], terms[0])


def test_triangulation(rng):
    """Eq. 2.25 at noisy matches, where the residual's part of the mixed derivative is not zero."""
    points = rng.uniform([-2, -1, 3], [2, 1, 9], (5, 3))
    uv = RIG.project(points) + rng.normal(0, 2, (5, 4))
    A, b = RIG.equations(uv)
    A, b, p = np.moveaxis(A, -1, 0), b.T, triangulate(RIG, uv)
    C_pp, C_pu = triangulation_derivatives(RIG, A, b, p)

    def cost(x):  # x: p, u
        rows = [
            (camera[2] @ [0, 0, 0, 1] * x[3 + 2 * i + j]) - camera[j, 3]
            + sum((x[3 + 2 * i + j] * camera[2, k] - camera[j, k]) * x[k] for k in range(3))
            for i, camera in enumerate(RIG.cameras) for j in range(2)
        ]  # fmt: skip
        return quadratic(rows, np.eye(4))

    for n in range(len(p)):
        gradient, H = derivatives(cost, np.concatenate([p[n], uv[n]]))
        assert np.abs(gradient[:3]).max() < 1e-8 * np.abs(H[:3, :3]).max()
        assert close(C_pp[n], H[:3, :3])
        assert close(C_pu[n], H[:3, 3:])
        depth = (RIG.cameras[:, 2, :3] @ p[n] + RIG.cameras[:, 2, 3]).repeat(2)
        without = A[n].T * depth
        assert not close(without, H[:3, 3:])  # negative control: the residual's part left out


@pytest.mark.parametrize("vector", POSES)
def test_registration(vector, rng):
    """Eq. 2.28 at noisy points, near the identity and far from it."""
    truth = RelativePose.from_vector(np.array(vector))
    p2 = rng.uniform([-2, -1, 3], [2, 1, 9], (5, 3))
    p1 = truth.apply(p2) + rng.normal(0, 0.3, (5, 3))
    pose = register_svd(p1, p2)
    C_d, C_dd, C_dp = registration_derivatives(p1, p2, pose)

    def cost(x):  # x: d, p1, p2
        total = 0.0
        for n in range(5):
            a, q = x[6 + 3 * n : 9 + 3 * n], x[21 + 3 * n : 24 + 3 * n]
            total += quadratic([u - v for u, v in zip(a, moved(x[:6], q), strict=True)], np.eye(3))
        return total

    gradient, H = derivatives(cost, np.concatenate([pose.vector, p1.ravel(), p2.ravel()]))
    assert np.abs(C_d - gradient[:6]).max() < TOLERANCE
    assert close(C_dd, H[:6, :6])
    assert close(C_dp.transpose(1, 0, 2).reshape(6, -1), H[:6, 6:])
    turned = C_dd.copy()
    turned[3:, 3:] += np.eye(3) * 1e-6 * np.abs(C_dd).max()
    assert not close(turned, H[:6, :6])  # negative control


@pytest.mark.parametrize("vector", POSES[:2])
@pytest.mark.parametrize("measure", [PointMatches(), PixelMatches(RIG)], ids=["points", "pixels"])
def test_two_frames(measure, vector, rng):
    """All blocks of the cost of pose and points, at noisy measurements with correlated noise."""
    pose = RelativePose.from_vector(np.array(vector))
    n = 4
    q = rng.uniform([-2, -1, 4], [2, 1, 9], (n, 3))
    z1, z2 = measure.value(pose.apply(q)), measure.value(q)
    k = z1.shape[1]
    z1, z2 = z1 + rng.normal(0, 1, z1.shape), z2 + rng.normal(0, 1, z2.shape)
    root = rng.normal(size=(2, n, k, k))
    W1, W2 = root @ np.swapaxes(root, -1, -2)
    f = two_frame_derivatives(TwoFrames(measure, z1, z2, W1, W2), pose, q, exact=True)
    sensed = seen if isinstance(measure, PixelMatches) else list
    for i in range(n):

        def cost(x, i=i):  # x: d, q, z1, z2
            e1 = [a - b for a, b in zip(x[9 : 9 + k], sensed(moved(x[:6], x[6:9])), strict=True)]
            e2 = [a - b for a, b in zip(x[9 + k :], sensed(x[6:9]), strict=True)]
            return quadratic(e1, W1[i]) + quadratic(e2, W2[i])

        g, H = derivatives(cost, np.concatenate([pose.vector, q[i], z1[i], z2[i]]))
        d, p, first, second = slice(0, 6), slice(6, 9), slice(9, 9 + k), slice(9 + k, None)
        for ours, theirs in [(f.d, g[d]), (f.q, g[p]), (f.z1, g[first]), (f.z2, g[second])]:
            assert close(ours[i], theirs)
        for ours, theirs in [
            (f.dd, H[d, d]), (f.dq, H[d, p]), (f.qq, H[p, p]),
            (f.dz1, H[d, first]), (f.qz1, H[p, first]), (f.qz2, H[p, second]),
        ]:  # fmt: skip
            assert close(ours[i], theirs)
        assert np.abs(H[d, second]).max() == 0.0


@pytest.mark.parametrize("robust", [None, "huber", "cauchy"])
def test_elimination_and_loss(robust, rng):
    """Schur complement and loss: with linear measurements of one point the profile cost has a formula.

    f = e' (S1 + R S2 R')^-1 e / 2 with e = z1 - (R z2 + t); its derivatives by t and z1, through the loss, are
    differentiated automatically.
    """
    pose = RelativePose.from_vector(np.array(POSES[1]))
    z2 = rng.uniform(1, 3, (1, 3))
    z1 = pose.apply(z2) + rng.normal(0, 2, (1, 3))
    root = rng.normal(size=(2, 1, 3, 3))
    S1, S2 = root @ np.swapaxes(root, -1, -2)
    G = np.linalg.inv(S1 + pose.R @ S2 @ pose.R.T)[0]
    W1, W2 = np.linalg.inv(S1), np.linalg.inv(S2)
    e = (z1 - pose.apply(z2))[0]
    best = z2 + (S2 @ pose.R.T @ G @ e[:, None])[:, :, 0]
    frames = TwoFrames(PointMatches(), z1, z2, W1, W2)
    s = frames.squared(pose, best)
    assert s == pytest.approx(e @ G @ e, rel=1e-10)
    c = 0.7 * float(np.sqrt(s[0]))
    _, weight, bend = loss(robust, s, c)
    C_dd, C_dz = _profile(two_frame_derivatives(frames, pose, best, exact=True), weight, bend)

    def cost(x):  # x: t, z1
        d = [HyperDual(a) for a in pose.R @ z2[0]]
        half = quadratic([x[3 + k] - x[k] - d[k] for k in range(3)], G)
        value = half.parts[0] * 2.0
        _, first, second = loss(robust, np.atleast_1d(value), c)
        return (2.0 * half).map(loss(robust, np.atleast_1d(value), c)[0], first, second) * 0.5

    _, H = derivatives(cost, np.concatenate([pose.t, z1[0]]))
    assert close(C_dd[:3, :3], H[:3, :3])
    assert close(C_dz[0][:3], H[:3, 3:])


@pytest.mark.parametrize("robust", [None, "huber", "cauchy"])
def test_loss(robust):
    """rho' and rho'' by the complex step and by differences, on both sides of the threshold."""
    s, c, h = np.array([0.3, 3.9, 4.1, 90.0]), 2.0, 1e-6
    rho, first, second = loss(robust, s, c)
    up, down = loss(robust, s + h, c), loss(robust, s - h, c)
    assert (up[0] - down[0]) / (2 * h) == pytest.approx(first, rel=1e-6)
    assert (up[1] - down[1]) / (2 * h) == pytest.approx(second, rel=1e-5, abs=1e-9)
    assert rho[0] <= s[0]


def test_triangulation_is_the_printed_system(rng):
    """Eq. 2.3 and 2.26 as printed, with R' and -R't for its [R t], give the same points."""
    plain = np.array([[500.0, 0.0, 320.0], [0.0, 510.0, 240.0], [0.0, 0.0, 1.0]])
    rig = StereoRig(plain, plain, RIG.R, RIG.t, (640, 480))
    uv = rig.project(rng.uniform([-2, -1, 3], [2, 1, 9], (20, 3))) + rng.normal(0, 2, (20, 4))
    r, (tx, ty, tz) = RIG.R.T, -RIG.R.T @ RIG.t
    for match, p in zip(uv, triangulate(rig, uv), strict=True):
        u, v, u_, v_ = match - [320, 240, 320, 240]
        A = np.array([u_ * r[2] - 500 * r[0], v_ * r[2] - 510 * r[1], [-500, 0, u], [0, -510, v]])
        b = np.array([-u_ * tz + 500 * tx, -v_ * tz + 510 * ty, 0, 0])
        assert np.linalg.inv(A.T @ A) @ A.T @ b == pytest.approx(p, rel=1e-9)
