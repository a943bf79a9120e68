"""Relative poses, their angles, and covariances through composition."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from consistency.referee.errors import InputError
from consistency.stereo.visual_odometry.relative_pose import rotation_derivatives
from consistency.vision import GimbalLockError, RelativePose, compose, invert, register_svd, registration_covariance

A = np.array([0.3, -0.2, 0.9, 0.5, -0.7, 2.0])
B = np.array([-1.0, 0.4, 2.0, -1.2, 0.3, -2.8])
LOCKED = RelativePose(Rotation.from_euler("ZYX", [0.3, np.pi / 2, 0.1]).as_matrix(), np.zeros(3))


def covariance(rng):
    root = rng.normal(size=(6, 6))
    return root @ root.T


@given(st.floats(-3.1, 3.1), st.floats(-1.5, 1.5), st.floats(-3.1, 3.1))
def test_angles_are_those_of_scipy(roll, pitch, yaw):
    pose = RelativePose(Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix(), np.zeros(3))
    assert pose.rpy == pytest.approx([roll, pitch, yaw], abs=1e-9)
    assert np.abs(RelativePose.from_vector(pose.vector).R - pose.R).max() < 1e-12


def test_derivatives_of_the_rotation():
    h = 1e-6
    first, second = rotation_derivatives(RelativePose.from_vector(A))
    for k in range(3):
        up, down = (RelativePose.from_vector(A + sign * h * np.eye(6)[3 + k]) for sign in (1, -1))
        assert first[k] == pytest.approx((up.R - down.R) / (2 * h), abs=1e-9)
        slopes = (rotation_derivatives(up)[0] - rotation_derivatives(down)[0]) / (2 * h)
        assert second[k] == pytest.approx(slopes, abs=1e-9)


def test_composition_and_inverse():
    a, b, p = RelativePose.from_vector(A), RelativePose.from_vector(B), np.array([[1.0, 2.0, 3.0]])
    assert a.compose(b).apply(p) == pytest.approx(a.apply(b.apply(p)))
    assert a.inverse().apply(a.apply(p)) == pytest.approx(p)
    assert a.compose(b).matrix == pytest.approx(a.matrix @ b.matrix)


def test_covariance_of_composition_and_inverse(rng):
    """J S J' with J from differences."""
    S_a, S_b = covariance(rng), covariance(rng)

    def composed(x):
        return RelativePose.from_vector(x[:6]).compose(RelativePose.from_vector(x[6:])).vector

    def inverted(x):
        return RelativePose.from_vector(x).inverse().vector

    J = slopes(composed, np.concatenate([A, B]))
    pose, stated = compose(RelativePose.from_vector(A), S_a, RelativePose.from_vector(B), S_b)
    assert pose.vector == pytest.approx(composed(np.concatenate([A, B])))
    assert stated == pytest.approx(J[:, :6] @ S_a @ J[:, :6].T + J[:, 6:] @ S_b @ J[:, 6:].T, rel=1e-6, abs=1e-6)
    inverse, stated = invert(RelativePose.from_vector(A), S_a)
    J = slopes(inverted, A)
    assert inverse.vector == pytest.approx(inverted(A))
    assert stated == pytest.approx(J @ S_a @ J.T, rel=1e-6, abs=1e-6)
    assert stated != pytest.approx(S_a, rel=0.1)


def test_gimbal_lock_is_named(rng):
    p2 = rng.normal(size=(5, 3))
    assert np.abs(register_svd(LOCKED.apply(p2), p2).R - LOCKED.R).max() < 1e-9  # the motion itself is no problem
    for what in (
        lambda: LOCKED.vector,
        lambda: registration_covariance(LOCKED.apply(p2), p2, np.eye(3), np.eye(3), LOCKED),
        lambda: compose(LOCKED, np.eye(6), LOCKED, np.eye(6)),
    ):
        with pytest.raises(GimbalLockError, match="roll and yaw are not defined"):
            what()


@pytest.mark.parametrize(
    "R, t, message",
    [
        (np.eye(2), np.zeros(3), "R: shape"),
        (np.eye(3), np.zeros(2), "t: shape"),
        (2 * np.eye(3), np.zeros(3), "R: not a rotation"),
        (-np.eye(3), np.zeros(3), "determinant"),
        (np.eye(3), np.array([0, np.inf, 0]), "t: not finite"),
    ],
)
def test_a_pose_that_is_none(R, t, message):
    with pytest.raises(InputError, match=message):
        RelativePose(R, t)


def test_a_covariance_that_is_none():
    pose = RelativePose.from_vector(A)
    with pytest.raises(InputError, match="S_b: not positive"):
        compose(pose, np.eye(6), pose, -np.eye(6))
    with pytest.raises(InputError, match="vector: shape"):
        RelativePose.from_vector(np.zeros(5))


def slopes(fun, x, h=1e-6):
    return np.array([(fun(x + h * e) - fun(x - h * e)) / (2 * h) for e in np.eye(len(x))]).T
