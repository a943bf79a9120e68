"""Angles and rigid motions."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from consistency.referee.geometry import pose_error, rotation, wrap


@given(st.floats(-1e4, 1e4))
def test_wrap_stays_in_its_interval_and_keeps_the_direction(angle: float) -> None:
    wrapped = wrap(np.array(angle))
    assert -np.pi <= wrapped < np.pi
    assert np.cos(wrapped) == pytest.approx(np.cos(angle), abs=1e-10)
    assert np.sin(wrapped) == pytest.approx(np.sin(angle), abs=1e-10)


def test_wrap_ends() -> None:
    assert np.allclose(wrap(np.array([np.pi, -np.pi, 3 * np.pi, 0.5])), [-np.pi, -np.pi, -np.pi, 0.5])


def test_pose_error_is_truth_minus_estimate_with_the_heading_wrapped() -> None:
    truth, estimate = np.array([[1.0, 2.0, 3.1]]), np.array([[0.5, 2.5, -3.1]])
    error = pose_error(truth, estimate)
    assert np.allclose(error, [[0.5, -0.5, 6.2 - 2 * np.pi]])
    assert truth[0, 2] == 3.1
    # a whole turn apart is no error
    assert pose_error(truth, truth + np.array([0, 0, 4 * np.pi]))[0, 2] == pytest.approx(0.0, abs=1e-12)


@given(st.floats(-3, 3), st.floats(-3, 3), st.floats(-3, 3))
def test_rotation_is_roll_then_pitch_then_heading(roll: float, pitch: float, heading: float) -> None:
    oracle = Rotation.from_euler("ZYX", [heading, pitch, roll]).as_matrix()
    assert np.allclose(rotation(roll, pitch, heading), oracle, rtol=0, atol=1e-14)
    assert np.linalg.det(rotation(roll, pitch, heading)) == pytest.approx(1.0)
