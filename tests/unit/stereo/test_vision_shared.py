"""Errors that all motions of a drive share: their derivatives, and what a part of a drive tells about them."""

import dataclasses

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.linalg import block_diag
from scipy.spatial.transform import Rotation

import consistency as cs
from consistency.referee.diagnostics.uncertain_truth import posterior
from consistency.referee.errors import InputError
from consistency.stereo.visual_odometry.odometry import (
    RIG,
    SHARED,
    SharedError,
    bridged,
    fit_shared,
    perturbed,
    sensitivities,
)
from consistency.stereo.visual_odometry.relative_motion import RelativeMotion, diagonal_covariances
from consistency.vision import RelativePose, StereoRig, refine_reprojection

K = np.array([[700.0, 0.0, 600.0], [0.0, 700.0, 180.0], [0.0, 0.0, 1.0]])
ROTATED = Rotation.from_rotvec([0.01, -0.02, 0.005]).as_matrix()
TURNED = StereoRig(K, 1.01 * K + np.diag([0.0, 0.0, -0.01]), ROTATED, np.array([0.54, 0.01, -0.02]), (1200, 360))
POINTS = 40
FEWEST = 12  # motions: twice the numbers of the floor
NAMES = list(SHARED)
PRIOR = np.array(list(SHARED.values()))


def motion(rig, pose, rng):
    """Of exact pixels: the refined pose is ``pose``."""
    z = rng.uniform(5.0, 30.0, POINTS)
    p = np.column_stack([rng.uniform(-0.7, 0.7, POINTS) * z, rng.uniform(-0.2, 0.2, POINTS) * z, z])
    uv0, uv1 = rig.project(p), rig.project((p - pose.t) @ pose.R)
    sigma, rows = np.full_like(uv0, 0.3), np.zeros((POINTS, 2), np.int64)
    inliers = np.ones(POINTS, bool)
    return RelativeMotion(pose, 1e-6 * np.eye(6), inliers, 1.0, 1, uv0, uv1, sigma, sigma, rows)


def difference(pose, true):
    return np.concatenate([pose.t - true.t, Rotation.from_matrix(pose.R @ true.R.T).as_rotvec()])


def drive(rng, n=3):
    poses = [RelativePose.from_vector(np.array([0.05, -0.02, 1.2 + 0.1 * k, 0.01, -0.03 * k, 0.02])) for k in range(n)]
    return [motion(TURNED, pose, rng) for pose in poses]


@pytest.mark.parametrize("name", NAMES[:RIG])
def test_a_wrong_rig_errs_by_its_derivative(name, rng):
    """Pixels of one rig, refined with another; by 1 % of a prior sigma the second order is below 1 % of the error."""
    motions = drive(rng)
    k = NAMES.index(name)
    change = 0.01 * PRIOR[k] * np.eye(RIG)[k]
    J = sensitivities(TURNED, motions, 0.1 * np.arange(4.0))
    for m, derivative in zip(motions, J, strict=True):
        S = diagonal_covariances(m.sigma0)
        wrong = refine_reprojection(perturbed(TURNED, change), m.uv0, m.uv1, m.pose, S, robust="cauchy").pose
        error = difference(wrong, m.pose)
        expected = derivative[:, :RIG] @ change
        assert_allclose(error, expected, atol=0.01 * np.abs(expected).max() + 1e-9)


def test_what_a_changed_rig_is():
    rig = perturbed(TURNED, np.array([0.01, 2.0, -3.0, 0.02, 0.001, 0.0, 0.0]))
    assert_allclose(rig.K_left, [[707.0, 0.0, 602.0], [0.0, 707.0, 177.0], [0.0, 0.0, 1.0]])
    assert_allclose(rig.t, 1.02 * TURNED.t)
    assert_allclose(TURNED.R.T @ rig.R, Rotation.from_rotvec([0.001, 0.0, 0.0]).as_matrix(), atol=1e-12)


@pytest.mark.parametrize("axis", range(3))
def test_a_wrong_mounting_errs_by_its_derivative(axis, rng):
    """The truth is of a body that is turned against the camera: T_true = X' T X."""
    motions = drive(rng)
    J = sensitivities(TURNED, motions, 0.1 * np.arange(4.0))
    turn = 1e-6 * np.eye(3)[axis]
    X = Rotation.from_rotvec(turn).as_matrix()
    for m, derivative in zip(motions, J, strict=True):
        true = RelativePose(X.T @ m.pose.R @ X, X.T @ m.pose.t)
        assert_allclose(np.abs(difference(m.pose, true)), np.abs(derivative[:, RIG:-1] @ turn), rtol=1e-3, atol=1e-12)
        signs = np.sign(difference(m.pose, true) * (derivative[:, RIG:-1] @ turn))
        assert set(signs[np.abs(derivative[:, RIG:-1] @ turn) > 1e-10]) <= {1.0} or set(signs) <= {-1.0, 0.0}


def test_a_late_clock_errs_by_the_change_of_the_motion(rng):
    """The motions grow by 0.1 m a frame of 0.1 s: 10 ms are 10 mm."""
    J = sensitivities(TURNED, drive(rng), 0.1 * np.arange(4.0))
    assert_allclose(0.01 * J[:, 2, -1], 0.01, rtol=0.01)
    assert not sensitivities(TURNED, drive(rng, 1), 0.1 * np.arange(2.0))[:, :, -1].any()  # nothing to change from


def test_a_bridge_errs_as_its_neighbours_do(rng):
    """Measured with another rig and bridged again, by the rule of ``bridged``; small turns, to 1 % of the largest."""
    t = np.cumsum([0.0, 0.1, 0.15, 0.1, 0.15, *np.full(8, 0.1)])
    motions, change = drive(rng, 12), 0.01 * PRIOR[:RIG]
    found = [InputError("dark") if k in (0, 3) else each for k, each in enumerate(motions)]
    before = bridged(found, t)
    J = sensitivities(TURNED, before, t)
    wrong = [each if isinstance(each, InputError) else remeasured(each, change) for each in found]
    for k in (0, 3):
        error = difference(bridged(wrong, t)[k].pose, before[k].pose)
        expected = J[k, :, :RIG] @ change
        assert_allclose(error, expected, atol=0.02 * np.abs(expected).max())
        assert np.abs(expected).max() > 1e-6
        assert_array_equal(J[k, 3:, RIG:-1], before[k].pose.R - np.eye(3))
    with pytest.raises(InputError, match="all are bridges"):
        sensitivities(TURNED, [dataclasses.replace(m, fault="dark") for m in motions], t)


def remeasured(m, change):
    """The same pixels, with a rig that is ``change`` (7,) off."""
    S = diagonal_covariances(m.sigma0)
    pose = refine_reprojection(perturbed(TURNED, change), m.uv0, m.uv1, m.pose, S, robust="cauchy").pose
    return dataclasses.replace(m, pose=pose)


def simulated(rng, n, J=None):
    """Errors of n motions, their J and S, what is shared and the floor."""
    J = rng.normal(size=(n, 6, len(PRIOR))) if J is None else J
    theta = PRIOR * rng.normal(size=len(PRIOR))
    floor = np.array([2e-3, 1e-3, 4e-3, 2e-4, 1e-4, 3e-4])
    S = np.tile(np.diag(np.full(6, 1e-4) ** 2), (n, 1, 1))
    errors = J @ theta + floor * rng.normal(size=(n, 6)) + 1e-4 * rng.normal(size=(n, 6))
    return errors, J, S, theta, floor


def test_the_likelihood_is_that_of_all_errors_together(rng):
    """By the dense covariance of 5 motions; mean and covariance by regression; the slope by central differences."""
    errors, J, S, _, floor = simulated(rng, 5, J=1e-2 * rng.normal(size=(5, 6, len(PRIOR))))
    S = S * rng.uniform(0.5, 2.0, (5, 1, 1)) + 1e-9
    rows, Pi = J.reshape(30, -1), np.diag(PRIOR**2)

    def minus_twice(log_floor):
        V = block_diag(*(S + np.diag(np.exp(2.0 * log_floor)))) + rows @ Pi @ rows.T
        return float(np.linalg.slogdet(V)[1] + errors.ravel() @ np.linalg.solve(V, errors.ravel()))

    mean, covariance, value, slope = posterior(floor, errors, J, S, PRIOR)
    assert value == pytest.approx(minus_twice(np.log(floor)), rel=1e-9)
    steps = 1e-5 * np.eye(6)
    by_differences = [(minus_twice(np.log(floor) + h) - minus_twice(np.log(floor) - h)) / 2e-5 for h in steps]
    assert_allclose(slope, by_differences, rtol=1e-5, atol=1e-5)
    V = block_diag(*(S + np.diag(floor**2))) + rows @ Pi @ rows.T
    gain = Pi @ rows.T @ np.linalg.inv(V)
    assert_allclose(mean, gain @ errors.ravel(), rtol=1e-7, atol=1e-12)
    assert_allclose(covariance, Pi - gain @ rows @ Pi, rtol=1e-4, atol=1e-9)


def test_shared_errors_and_floor_are_found(rng):
    """2,000 motions: theta within 6 of its standard deviations, a floor within 6 x 1.6 % (false alarm below 1e-7)."""
    errors, J, S, theta, floor = simulated(rng, 2000)
    fit = fit_shared(errors, J, S)
    off = fit.mean - theta
    assert off @ np.linalg.solve(fit.covariance, off) < 75.0  # chi-square with 11 degrees of freedom: 1e-11
    assert_allclose(fit.floor, floor, rtol=0.1)


def test_predictions_of_other_motions_are_honest():
    """300 drives of 20 motions, one more predicted: the mean NEES is 6, and more as the floor is an estimate of 20.

    With f degrees of freedom left to each of its variances it is 6 f / (f - 2): 6.7 to 7.5 for 20 to 10. Beyond the
    limits it is by chance below 1e-5: a standard error is 0.25.
    """
    rng, nees = np.random.default_rng(77310), []
    for _ in range(300):
        errors, J, S, _, _ = simulated(rng, 21)
        fit = fit_shared(errors[:20], J[:20], S[:20])
        bias, P = fit.predict(J[20:], S[20:])
        e = errors[20] - bias[0]
        nees.append(e @ np.linalg.solve(P[0], e))
    assert 5.0 < np.mean(nees) < 9.0


def test_what_cannot_be_fitted(rng):
    errors, J, S, *_ = simulated(rng, FEWEST - 1)
    with pytest.raises(cs.InputError, match=r"of 11 motions, at least 12 are needed"):
        fit_shared(errors, J, S)
    with pytest.raises(cs.InputError, match="do not fit"):
        fit_shared(errors, J[:, :, :5], S)
    errors, J, S, *_ = simulated(rng, FEWEST)
    assert (fit_shared(errors, J, S).floor > 0.0).all()


def test_a_prediction_has_all_three_parts(rng):
    J, S = rng.normal(size=(2, 6, len(PRIOR))), np.tile(np.eye(6), (2, 1, 1))
    root = rng.normal(size=(len(PRIOR),) * 2)
    shared = SharedError(PRIOR, root @ root.T, np.arange(1.0, 7.0))
    bias, P = shared.predict(J, S)
    assert_allclose(bias[1], J[1] @ PRIOR)
    assert_allclose(P[1], S[1] + J[1] @ root @ root.T @ J[1].T + np.diag(np.arange(1.0, 7.0) ** 2))
