"""Angles and rigid motions."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from consistency.bench.filters.kernel.part_functions import Frame, world_point
from consistency.bench.filters.methods.equivariant import SensorPoint
from consistency.bench.filters.parts.invariant_pose import exponential, left_jacobian, move_pose, shifted_covariance
from consistency.bench.scenario.models import Mounting
from consistency.referee.geometry import pose_error, rotation, wrap


@given(st.floats(-1e4, 1e4))
def test_wrap_stays_in_its_interval_and_keeps_the_direction(angle):
    wrapped = wrap(np.array(angle))
    assert -np.pi <= wrapped < np.pi
    assert np.cos(wrapped) == pytest.approx(np.cos(angle), abs=1e-10)
    assert np.sin(wrapped) == pytest.approx(np.sin(angle), abs=1e-10)


def test_wrap_ends():
    assert np.allclose(wrap(np.array([np.pi, -np.pi, 3 * np.pi, 0.5])), [-np.pi, -np.pi, -np.pi, 0.5])


def test_pose_error_is_truth_minus_estimate_with_the_heading_wrapped():
    truth, estimate = np.array([[1.0, 2.0, 3.1]]), np.array([[0.5, 2.5, -3.1]])
    error = pose_error(truth, estimate)
    assert np.allclose(error, [[0.5, -0.5, 6.2 - 2 * np.pi]])
    assert truth[0, 2] == 3.1
    # a whole turn apart is no error
    assert pose_error(truth, truth + np.array([0, 0, 4 * np.pi]))[0, 2] == pytest.approx(0.0, abs=1e-12)


@given(st.floats(-3, 3), st.floats(-3, 3), st.floats(-3, 3))
def test_rotation_is_roll_then_pitch_then_heading(roll, pitch, heading):
    oracle = Rotation.from_euler("ZYX", [heading, pitch, roll]).as_matrix()
    assert np.allclose(rotation(roll, pitch, heading), oracle, rtol=0, atol=1e-14)
    assert np.linalg.det(rotation(roll, pitch, heading)) == pytest.approx(1.0)


# --- what kernels know of SE(2), as plain Python ---------------------------------------------------------


@pytest.mark.parametrize("angle", [0.0, 1e-6, 9e-5, -9e-5, 1.1e-4, 0.7, -2.0])
def test_a_planar_motion_is_the_matrix_exponential(angle):
    x, y, pose, moved = 2.0, -3.0, np.array([0.5, -1.5, 0.3]), np.empty(3)
    T = expm(np.array([[0.0, -angle, x], [angle, 0.0, y], [0.0, 0.0, 0.0]]))
    c, s, along, across = exponential(angle)
    assert_allclose([[c, -s], [s, c]], T[:2, :2], atol=1e-14)
    assert_allclose([along * x - across * y, across * x + along * y], T[:2, 2], rtol=0, atol=4e-12)
    move_pose(pose, np.array([x, y, angle]), moved)
    assert_allclose(moved, [*(T @ [pose[0], pose[1], 1.0])[:2], pose[2] + angle], rtol=0, atol=4e-12)


def test_the_left_jacobian_is_its_series():
    x, y, t = xi = np.array([0.3, -0.2, 0.1])
    J, adjoint = np.empty((3, 3)), np.array([[0.0, -t, y], [t, 0.0, -x], [0.0, 0.0, 0.0]])
    left_jacobian(xi, J)
    assert_allclose(J, np.eye(3) + adjoint / 2 + adjoint @ adjoint / 6, atol=1e-15)


def test_covariance_of_the_additive_error(rng):
    pose, A, out = np.array([40.0, -30.0, 0.3]), rng.standard_normal((3, 3)), np.empty((3, 3))
    D = np.array([[1.0, 0.0, -pose[1]], [0.0, 1.0, pose[0]], [0.0, 0.0, 1.0]])
    shifted_covariance(pose, A @ A.T, out)
    assert_allclose(out, D @ A @ A.T @ D.T, rtol=1e-12)
    known = np.linalg.inv(D) @ np.diag([0.0, 2.0, 0.1])  # x is known, so that its row is zero
    shifted_covariance(pose, known @ known.T, out)
    assert not out[0].any()
    assert_allclose(out, np.diag([0.0, 4.0, 0.01]), atol=1e-10)


def test_the_world_point_of_a_point_in_a_tilted_sensor_has_its_jacobians():
    mount = Mounting(0.3, -0.2, 0.5, *map(float, rotation(0.1, -0.4, 0.7).ravel()))
    values, steps = np.array([0.5, -0.2, 0.9, 2.0, -1.0, 4.0]), 1e-6 * np.eye(6)  # pose, then point

    def at(v, Dp, Dl):
        point = np.empty(3)
        frame = Frame(v[0], v[1], float(np.cos(v[2])), float(np.sin(v[2])))
        world_point(SensorPoint(mount), frame, v[3:], point, Dp, Dl)
        return point

    Dp, Dl, unused = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    at(values, Dp, Dl)
    ends = [(at(values + h, unused, unused.copy()), at(values - h, unused, unused.copy())) for h in steps]
    assert_allclose(np.hstack([Dp, Dl]), np.transpose([(b - a) / 2e-6 for b, a in ends]), atol=1e-8)
