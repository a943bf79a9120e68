"""The parts of the experiment on real images that need no images, and its figures."""

import numpy as np
import pytest
import scripts
from numpy.testing import assert_allclose

from consistency.vision import RelativePose

figures = scripts.experiment("front_end_figures")

META = """
	.pose_fixedFrame_robotFrame.data:
		.orientation: -0.50.5-0.50.5
		.translation: -75.2624-11.0862-4.27392
	.pose_robotFrame_sensorFrame.data:
		.orientation: 0.00.00.01.0
		.translation: 0.2959220.1245421.66978
"""


@pytest.fixture(scope="module")
def experiment():
    return scripts.experiment("e11_front_end_images")


def test_numbers_that_run_together_are_told_apart(experiment, tmp_path):
    path = tmp_path / "a.meta"
    path.write_text(META)
    pose = experiment.data._onboard(path)
    R = RelativePose(pose.R, np.zeros(3)).R
    assert_allclose(pose.t, [-75.2624, -11.0862, -4.27392] + R @ [0.295922, 0.124542, 1.66978])


def test_interpolated_truth_is_told_apart(experiment):
    turns = [0.001, 0.001, 0.001, 0.0013, 0.0009]
    truth = [RelativePose.from_vector(np.array([0, 0, 1.0, 0, turn, 0])) for turn in turns]
    case = experiment.Case("x", None, [], truth, np.empty((0, 0)), np.empty(0))
    assert case.surveyed.tolist() == [False, False, False, True, True]


def test_bias_and_floor_of_errors_with_too_small_covariances(experiment, rng):
    """20,000 errors: means within 6 sigma of sampling, variances within 6 (false alarm below 1e-7)."""
    n, bias = 20_000, np.arange(6.0)
    found, floor = experiment.floored(bias + 2.0 * rng.normal(size=(n, 6)), np.tile(np.eye(6), (n, 1, 1)))
    assert_allclose(found, bias, atol=6 * 2 / np.sqrt(n))
    assert_allclose(floor, 3.0, atol=6 * 4 * np.sqrt(2 / n))
    _, none = experiment.floored(rng.normal(size=(n, 6)), np.tile(9 * np.eye(6), (n, 1, 1)))
    assert not none.any()


def test_figures_are_png(rng):
    image, S = np.zeros((40, 60), np.uint8), np.eye(6)
    for png in (figures.matches_png(image, np.array([[10.0, 10.0]]), np.eye(2)[None], 50),
                figures.samples_png(1e-3 * rng.normal(size=(50, 6)), np.zeros(6), 1e-6 * S, 50)):  # fmt: skip
        assert png.startswith(b"\x89PNG")
