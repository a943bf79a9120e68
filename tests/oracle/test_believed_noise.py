"""What filters do with a belief in noise that grows with the disparity, and in local biases: all filters on pixels.

The oracles are equivalences. Where all measured disparities are alike, a growth is another sigma. A filter that is told
of a bias map is one without it on data that somebody else has cleaned.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import consistency as cs
from consistency.bench.filters import MODULES, usable_names
from consistency.bench.filters.filter_inputs import sensor_noise
from consistency.bench.filters.run_filter import run_filter, step_through
from consistency.bench.scenario import BelievedSensor, BiasMap
from consistency.bench.types import Gaussian
from consistency.referee.types import Array

pytestmark = pytest.mark.usefixtures("dense")

NAMES = [name for name in MODULES if name.endswith(("-uvd", "-xyz"))]
COMPILED = [
    "ekf-uvd",
    "ekf-xyz",
    "predicted-ekf-xyz",
    "debiased-ekf-xyz",
    "parked-ekf-uvd",
    "ukf-uvd",
]  # as kernels too
PREDICTING = {"predicted-ekf-xyz", "debiased-ekf-xyz", "parked-ekf-uvd", "robocentric-ekf-uvd"}
CASES = [*((name, False) for name in NAMES), *((name, True) for name in COMPILED)]
GROWTH = {"disparity": [4.0, 8.0], "ratio": [0.5, 2.5]}
SHIFT = 0.75  # px, of every disparity, by which a search range moves
MAP = {
    "u": [-150.0, 0.0, 150.0], "v": [-100.0, 100.0], "bias_u": [[1.0, 0.0, -1.5], [0.5, 0.0, 0.0]],
    "bias_v": [[0.0, 1.0, -1.0], [0.3, 0.0, 0.7]], "bias_d": [[SHIFT] * 3] * 2,
}  # fmt: skip


def filter_of(name, kernel):
    """A built-in filter, or its plain twin where it has one."""
    if name not in usable_names():
        pytest.skip(f"the library of {name} is not installed")
    filter_ = cs.get_filter(name)
    return filter_ if kernel else getattr(filter_, "textbook", filter_)


def same(a, b, tolerance):
    """Poses and covariances are the same to a part of the standard deviation; a failure is no estimate."""
    assert a.failure is None, a.failure
    assert b.failure is None, b.failure
    sigma = np.sqrt(np.einsum("kii->ki", b.covariance)) + 1e-9
    scale = sigma[:, :, None] * sigma[:, None, :]
    return bool(
        (np.abs(a.pose - b.pose) / sigma).max() < tolerance
        and (np.abs(a.covariance - b.covariance) / scale).max() < tolerance
    )


def short(small, **changes):
    scenario = small("herath2007-stereo", truth__steps=12, **changes)
    return scenario, cs.simulate(scenario, run=1)


def believing(scenario, **changes):
    return scenario.variant("other", **{f"belief__sensor__{key}": value for key, value in changes.items()})


@pytest.mark.parametrize("name, kernel", CASES)
def test_where_all_disparities_are_alike_a_growth_is_another_sigma(small, name, kernel):
    """At the measured disparity, except where a filter takes all its noise at the prediction, which is not 6 px."""
    scenario, trial = short(small)
    z = np.array(trial.z)
    z[:, 2] = 6.0
    trial, filter_ = replace(trial, z=z), filter_of(name, kernel)
    su, sv, sd = scenario.belief.sensor.sigma
    grown = run_filter(filter_, trial, believing(scenario, disparity_growth=GROWTH).belief)
    scaled = run_filter(filter_, trial, believing(scenario, sigma=(su, sv, 1.5 * sd)).belief)
    assert same(grown, scaled, 1e-6) == (name not in PREDICTING)
    assert not same(grown, run_filter(filter_, trial, scenario.belief), 1e-3)  # negative control


@pytest.mark.parametrize("name, kernel", [case for case in CASES if case[0] in PREDICTING | {"ekf-uvd"}])
def test_filters_with_their_noise_at_the_prediction_take_the_growth_there(small, name, kernel):
    """One landmark is seen at 6 px, is expected near that in the next step, and is measured at 9 px."""
    scenario, trial = short(small)
    z = np.array([[10.0, 5.0, 6.0], [10.5, 5.0, 9.0]])
    trial = replace(
        trial, controls=trial.controls[:2], truth=trial.truth[:3], first=np.arange(3), landmark=np.zeros(2, int), z=z
    )
    filter_, (su, sv, sd) = filter_of(name, kernel), scenario.belief.sensor.sigma
    plateau = {"disparity": [4.9, 5.0, 7.0, 7.1], "ratio": [0.5, 1.5, 1.5, 0.5]}
    grown = run_filter(filter_, trial, believing(scenario, disparity_growth=plateau).belief)
    scaled = run_filter(filter_, trial, believing(scenario, sigma=(su, sv, 1.5 * sd)).belief)
    assert same(grown, scaled, 1e-9) == (name in PREDICTING)


@pytest.mark.parametrize("name, kernel", CASES)
def test_a_believed_bias_is_subtracted_before_anything_else(small, name, kernel):
    scenario, trial = short(small)
    filter_ = filter_of(name, kernel)
    told = run_filter(filter_, trial, believing(scenario, bias=MAP).belief)
    cleaned = replace(trial, z=trial.z - BiasMap.model_validate(MAP).at(trial.z[:, 0], trial.z[:, 1]))
    low, high = scenario.belief.sensor.disparity
    moved = believing(scenario, disparity=(low - SHIFT, high - SHIFT))
    assert same(told, run_filter(filter_, cleaned, moved.belief), 1e-9)
    assert not same(told, run_filter(filter_, trial, scenario.belief), 1e-3)  # negative control


@pytest.mark.parametrize("name", ["parked-ekf-uvd", "gtsam-batch-uvd"])
def test_the_search_range_moves_with_the_bias(small, name):
    """Negative control of the test above, near the least disparity."""
    _, trial = short(small)
    least = trial.z[:, 2].min() - 0.01
    scenario, _ = short(small, belief__sensor__disparity=(least, 32.0))
    told = run_filter(filter_of(name, False), trial, believing(scenario, bias=MAP).belief)
    cleaned = replace(trial, z=trial.z - BiasMap.model_validate(MAP).at(trial.z[:, 0], trial.z[:, 1]))
    moved = believing(scenario, disparity=(least - SHIFT, 32.0 - SHIFT))
    assert same(told, run_filter(filter_of(name, False), cleaned, moved.belief), 1e-9)
    assert not same(told, run_filter(filter_of(name, False), cleaned, scenario.belief), 1e-4)


@pytest.mark.parametrize("name", COMPILED)
def test_kernels_equal_their_twins_with_both(small, name):
    effects = [{"kind": "local-bias", **MAP, "bias_d": [[1.0, -0.5, 0.3], [0.0, 0.6, -0.2]]}]
    bias = {key: value for key, value in effects[0].items() if key != "kind"}
    scenario = small(
        "herath2007-stereo", truth__steps=120, truth__sensor__effects=effects, belief__sensor__bias=bias,
        truth__sensor__disparity_growth=GROWTH, belief__sensor__disparity_growth=GROWTH,
    )  # fmt: skip
    trial, filter_ = cs.simulate(scenario, run=1), cs.get_filter(name)
    assert same(filter_.run(trial, scenario.belief), step_through(filter_.textbook, trial, scenario.belief), 1e-7)


def test_the_noise_of_a_point_is_that_of_its_own_pixels():
    """Eq. 21 by hand: x = f B / d, y = -B u / d, z = -B v / d, with sigma_d at each disparity and no bias left."""
    f, B, sigma = 150.0, 0.09, np.array([1.34, 1.53, 0.65])
    sensor = BelievedSensor.model_validate(
        {"model": "uvd", "f": f, "B": B, "sigma": sigma.tolist(), "disparity_growth": GROWTH, "bias": MAP}
    )
    z = np.array([[30.0, -20.0, 4.75], [-80.0, 50.0, 7.25], [10.0, 5.0, 30.75]])
    bias = BiasMap.model_validate(MAP).at(z[:, 0], z[:, 1])
    clean, R = sensor_noise(z, sensor, converted=False)
    points, C = sensor_noise(z, sensor, converted=True)
    assert np.array_equal(clean, z - bias)
    for i, (u, v, d) in enumerate(z - bias):
        own = sigma * [1.0, 1.0, np.interp(d, [4.0, 8.0], [0.5, 2.5])]
        J = np.array([[0, 0, -f * B / d**2], [-B / d, 0, B * u / d**2], [0, -B / d, B * v / d**2]])
        assert np.allclose(R[i], np.diag(own**2), rtol=1e-14, atol=0)
        assert np.allclose(points[i], [f * B / d, -B * u / d, -B * v / d], rtol=1e-14, atol=0)
        assert np.allclose(C[i], J @ np.diag(own**2) @ J.T, rtol=1e-12, atol=1e-18)
    assert len({R[i, 2, 2] for i in range(3)}) == 3


class Recorder:
    """A filter of a user's own that keeps what it is given."""

    def __init__(self):
        self.z: list[Array] = []
        self.sensor: BelievedSensor | None = None

    def init(self, problem):
        self.sensor = problem.belief.sensor
        return 0

    def predict(self, state, control):
        return state

    def update(self, state, observation):
        self.z.append(observation.z)
        return state, None

    def pose(self, state):
        return Gaussian(np.zeros(3), np.eye(3))


def test_a_filter_of_the_users_own_gets_what_was_measured_and_the_belief(small):
    scenario, trial = short(small, belief__sensor__bias=MAP, belief__sensor__disparity_growth=GROWTH)
    recorder = Recorder()
    step_through(recorder, trial, scenario.belief)
    assert np.array_equal(np.concatenate(recorder.z), trial.z)
    assert recorder.sensor == scenario.belief.sensor
