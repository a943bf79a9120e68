"""Truth between its samples, against motions that are known in closed form."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from consistency.referee.geometry import wrap
from consistency.referee.readers.matching import BRIDGED, truth_at
from consistency.referee.types import Array

T = 100.0 + 0.1 * np.arange(30)


@pytest.fixture
def times() -> Array:
    return np.sort(np.random.default_rng().uniform(T[0], T[-1], 50))


def straight(t: Array) -> Array:
    return np.outer(t, [1.0, -2.0, 0.5]) + np.array([3.0, 1.0, 0.0])


def test_even_motion_is_met_exactly(times: Array) -> None:
    """Straight on, and about one axis of the body, in space."""
    axis = np.array([0.3, -0.5, 0.8])

    start = Rotation.from_euler("ZYX", [0.4, -0.7, 1.1])

    def motion(t: Array) -> Array:
        return np.hstack([straight(t), (start * Rotation.from_rotvec(np.outer(t - 100.0, axis))).as_quat()])

    known = truth_at(times, T, motion(T), "spatial", 0.0)
    assert known.rows.tolist() == list(range(50))
    np.testing.assert_allclose(known.truth[:, :3], straight(times), atol=1e-9)
    turn = Rotation.from_quat(known.truth[:, 3:]).inv() * Rotation.from_quat(motion(times)[:, 3:])
    assert turn.magnitude().max() < 1e-9
    np.testing.assert_allclose(known.bend, 0.0, atol=1e-9)


def test_a_quaternion_and_its_negative_are_one_turn(times: Array) -> None:
    poses = np.hstack([straight(T), Rotation.from_rotvec(np.outer(T, [0, 0, 0.4])).as_quat()])
    flipped = poses * np.where(np.arange(len(T))[:, None] % 2, np.append(np.ones(3), -np.ones(4)), 1.0)
    one, other = (Rotation.from_quat(truth_at(times, T, p, "spatial", 0.0).truth[:, 3:]) for p in (poses, flipped))
    assert (one.inv() * other).magnitude().max() < 1e-9


def test_headings_go_the_short_way(times: Array) -> None:
    heading = 1.7 * times
    values = np.column_stack([np.cos(T), np.sin(T), wrap(1.7 * T)])
    known = truth_at(times, T, values, "planar", 0.0)
    np.testing.assert_allclose(wrap(known.truth[:, 2] - heading), 0.0, atol=1e-9)
    assert np.abs(known.truth[:, 2]).max() <= np.pi
    between = (T[:-1] + T[1:]) / 2.0  # one of them where the heading jumps
    plain = truth_at(between, T, values, "vector", 0.0).truth[:, 2]
    assert np.abs(wrap(plain - 1.7 * between)).max() > 0.5, "negative control"


def test_at_a_sample_it_is_the_sample_to_the_bit() -> None:
    values = np.random.default_rng().normal(size=(len(T), 7))
    known = truth_at(T, T, values, "spatial", 0.0)
    assert np.array_equal(known.truth, values)
    assert known.before.tolist() == list(range(len(T)))
    assert not known.apart.any()


def test_what_is_bridged() -> None:
    """A gap of a second is not, but near one of its ends; nor is what is before the first or after the last sample."""
    reference = np.array([0.0, 0.1, 1.1, 1.1 + BRIDGED])
    times = np.array([-0.02, -0.005, 0.05, 0.108, 0.12, 1.095, 1.15, 1.206, 1.25])
    values = reference[:, None] * [1.0, 2.0]
    known = truth_at(times, reference, values, "vector", 0.01)
    assert known.rows.tolist() == [1, 2, 3, 5, 6, 7]
    np.testing.assert_allclose(known.truth[:, 0], [0.0, 0.05, 0.108, 1.095, 1.15, 1.1 + BRIDGED], atol=1e-12)
    np.testing.assert_allclose(known.truth[:, 1], 2.0 * known.truth[:, 0])
    np.testing.assert_allclose(known.apart, [0.005, 0.05, 0.008, 0.005, 0.05, 0.006], atol=1e-12)


def test_one_sample_serves_what_is_near() -> None:
    known = truth_at(np.array([0.9, 0.995, 1.004]), np.array([1.0]), np.array([[7.0]]), "vector", 0.01)
    assert (known.rows.tolist(), known.truth.ravel().tolist()) == ([1, 2], [7.0, 7.0])


def test_the_bend_bounds_the_error_under_even_acceleration(times: Array) -> None:
    a = np.array([2.0, -1.0, 0.5])
    values = 0.5 * T[:, None] ** 2 * a
    known = truth_at(times, T, values, "vector", 0.0)
    error = np.linalg.norm(known.truth - 0.5 * times[:, None] ** 2 * a, axis=1)
    np.testing.assert_allclose(known.bend, error, atol=1e-9)
