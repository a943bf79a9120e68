"""The robot-centred filter: geometry by finite differences, conversion by quadrature, kernel by its twin."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.stats import truncnorm

import consistency as cs
from consistency.filters import centred, plain
from consistency.filters.compiled import problem_of
from consistency.filters.kernel.slam import State
from consistency.filters.methods import robocentric as rc
from consistency.filters.stepping import step_through
from consistency.filters.upkeep.parking import Parking, make_clones, unpark
from consistency.types import Array

Small = Callable[..., cs.Scenario]
Y = np.array([[0.3, -0.2, 0.4], [-0.6, 0.1, 0.15], [2.4, 0.3, 0.9]])  # the last one is behind the robot
STEP = 1e-6


def close(a: Array, b: Array, tolerance: float = 1e-7) -> bool:
    return bool(np.abs(a - b).max() <= tolerance)


def along(function: Callable[[Array], Array], x: Array) -> Array:
    """Derivative of a function of x by central differences, its last axis that of x."""
    steps = STEP * np.eye(len(x))
    return np.stack([(function(x + d) - function(x - d)) / (2.0 * STEP) for d in steps], axis=-1)


@pytest.fixture
def sensor(small: Small, tilted: dict[str, Any]) -> Any:
    return small("herath2007-stereo", belief__sensor__mount=tilted).belief.sensor


# --- geometry ------------------------------------------------------------------------------------


@pytest.mark.parametrize("i", range(len(Y)))
def test_carrying_a_landmark_has_the_derivatives_it_says(sensor: Any, i: int) -> None:
    R, t = plain.heading_matrix(-0.3), np.array([-0.4, 0.2, 0.0])
    _, J, _, _ = centred.carried(Y, R, t, sensor)
    assert close(J[i], along(lambda y: centred.carried(y[None], R, t, sensor)[0][0], Y[i]))
    assert not close(1.001 * J[i], along(lambda y: centred.carried(y[None], R, t, sensor)[0][0], Y[i]))


def test_carrying_there_and_back_changes_nothing(sensor: Any) -> None:
    R, t = plain.heading_matrix(-0.3), np.array([-0.4, 0.2, 0.0])
    there = centred.carried(Y, R, t, sensor)[0]
    assert close(centred.carried(there, R.T, -R.T @ t, sensor)[0], Y, 1e-12)


@pytest.mark.parametrize("y", Y)
def test_a_parked_landmark_has_the_derivatives_it_says(small: Small, tilted: dict[str, Any], y: Array) -> None:
    scenario = small("herath2007-stereo", belief__sensor__mount=tilted)
    trial = cs.simulate(scenario)
    clone, pose = np.array([1.0, -0.5, 0.4]), np.array([1.6, 0.3, -0.7])

    def seen(y: Array, clone: Array, pose: Array) -> tuple[Array, Array, Array]:
        state = rc.CentredState(pose, np.zeros((3, 3)), problem_of(trial, scenario.belief))
        return rc._seen_from(state, clone, y)

    _, J, by_shift = seen(y, clone, pose)
    assert close(J, along(lambda y: seen(y, clone, pose)[0], y))
    assert close(by_shift, along(lambda xi: seen(y, centred.moved(clone, xi), pose)[0], np.zeros(3)))
    assert close(-by_shift, along(lambda xi: seen(y, clone, centred.moved(pose, xi))[0], np.zeros(3)))
    assert not close(by_shift, 0.0 * by_shift, 1e-3)


def test_the_left_jacobian_is_that_of_exp_up_to_the_third_order() -> None:
    pose = np.array([1.0, -0.5, 0.4])
    gaps = []
    for size in (0.2, 0.1):
        xi = size * np.array([0.8, -0.6, 0.5])
        ahead = along(lambda error, xi=xi: centred.moved(pose, xi + error), np.zeros(3))
        left = along(lambda error, xi=xi: centred.moved(centred.moved(pose, xi), error), np.zeros(3))
        gaps.append(np.abs(ahead - left @ centred.left_jacobian(xi)).max())
    assert gaps[0] < 1e-3
    assert gaps[1] < gaps[0] / 6.0
    assert close(
        along(lambda error: centred.moved(pose, error), np.zeros(3)), np.linalg.inv(centred.shift_matrix(pose)), 1e-7
    )


# --- conversion ----------------------------------------------------------------------------------

Z = np.array([[20.0, -35.0, 4.0], [-110.0, 60.0, 1.7], [5.0, 90.0, 12.0]])


def test_the_conversion_is_the_inverse_of_the_image_and_has_the_derivatives_it_says(sensor: Any) -> None:
    y, J = centred.converted(Z, sensor)
    assert close(centred.imaged(y, sensor), Z, 1e-9)
    for i in range(len(Z)):
        assert close(J[i], along(lambda z: centred.converted(z[None], sensor)[0][0], Z[i]))
        x = np.array([sensor.f * sensor.B / Z[i, 2]])
        point = np.array([x[0], -x[0] * Z[i, 0] / sensor.f, -x[0] * Z[i, 1] / sensor.f])
        assert y[i, 2] == pytest.approx(1.0 / np.linalg.norm(point))


def test_the_bias_is_that_of_quadrature(sensor: Any) -> None:
    nodes, weights = np.polynomial.hermite_e.hermegauss(15)
    u, v = np.meshgrid(nodes * sensor.sigma[0], nodes * sensor.sigma[1], indexing="ij")
    weight = np.outer(weights, weights).ravel() / (2.0 * np.pi)
    steps = np.stack([u.ravel(), v.ravel(), np.zeros(u.size)], axis=1)
    said = centred.bias(Z, sensor)
    for i in range(len(Z)):
        values = centred.converted(Z[i] + steps, sensor)[0]
        exact = weight @ values - centred.converted(Z[i][None], sensor)[0][0]
        assert np.abs(said[i] - exact).max() < 0.01 * np.abs(exact).max()
        assert np.abs(exact).max() > 1e-6


@pytest.mark.parametrize("expected", [0.6, 1.0, 1.69, 5.0, 31.5])
def test_a_disparity_freed_of_its_range_has_the_expected_mean_and_the_variance_it_says(expected: float) -> None:
    low, high, sigma = 1.0, 32.0, 0.65
    inside = truncnorm((low - expected) / sigma, (high - expected) / sigma, loc=expected, scale=sigma)
    d = np.array([inside.mean()])
    mean, variance = centred.untruncated(d, np.array([expected]), sigma, (low, high))
    assert mean[0] == pytest.approx(expected)
    slope = centred.untruncated(d + 1.0, np.array([expected]), sigma, (low, high))[0] - mean
    assert variance[0] == pytest.approx(slope[0] ** 2 * inside.var())


# --- kernel and twin -----------------------------------------------------------------------------

CLOSING = {  # a lap in 150 steps: what was parked is seen again
    "truth__path__radius": 1.2, "truth__steps": 320, "truth__sensor__range": (0.5, 3.0),
    "truth__landmarks__x": (-4.0, 4.0), "truth__landmarks__y": (-4.0, 4.0), "truth__landmarks__count": 30,
}  # fmt: skip


@pytest.mark.parametrize("left_out", ["nothing", *centred.Corrections._fields])
def test_kernel_equals_its_twin_round_a_loop(small: Small, tilted: dict[str, Any], left_out: str) -> None:
    changes = {"truth__sensor__mount": tilted, "belief__sensor__mount": tilted}
    scenario = small("herath2007-stereo", **CLOSING, **changes)
    trial = cs.simulate(scenario, run=3)
    which = centred.Corrections()._replace(**({} if left_out == "nothing" else {left_out: False}))
    filter_ = rc.compiled(rc.RobotCentredKalman("trial", which))
    ours, twin = filter_.run(trial, scenario.belief), step_through(filter_.twin, trial, scenario.belief)
    assert ours.failure is None
    assert twin.failure is None
    size = np.abs(twin.covariance).max(axis=(1, 2), keepdims=True)
    assert np.abs(ours.pose - twin.pose).max() < 1e-9
    assert (np.abs(ours.covariance - twin.covariance) / size).max() < 1e-8
    assert np.nanmax(np.abs(ours.nis - twin.nis) / np.maximum(twin.nis, 1.0)) < 1e-8
    assert ours.map is not None
    assert twin.map is not None
    assert np.allclose(ours.map.mean, twin.map.mean, rtol=1e-7, atol=1e-9)
    assert ours.map.joint is not None
    assert twin.map.joint is not None
    assert np.abs(ours.map.joint - twin.map.joint).max() < 1e-8 * np.abs(twin.map.joint).max()
    whole = rc.compiled(rc.RobotCentredKalman("trial", centred.Corrections())).run(trial, scenario.belief)
    assert (left_out == "nothing") == bool(np.array_equal(ours.pose, whole.pose))  # each correction does something


@pytest.mark.parametrize("local_from", [10, 40])
def test_updating_locally_changes_no_number_round_a_loop(
    monkeypatch: pytest.MonkeyPatch, small: Small, local_from: int
) -> None:
    """Clones are called back, freed and taken again while the rest is passive."""
    scenario = small("herath2007-stereo", **CLOSING)
    filter_ = rc.compiled(rc.RobotCentredKalman("trial", centred.Corrections()))
    for run in range(3):
        trial = cs.simulate(scenario, run=run)
        said = []
        for each in (local_from, 10**9):
            monkeypatch.setattr(filter_, "local_from", each)
            said.append(filter_.run(trial, scenario.belief))
        local, dense = said
        size = np.abs(dense.covariance).max(axis=(1, 2), keepdims=True)
        assert np.abs(local.pose - dense.pose).max() < 1e-10
        assert (np.abs(local.covariance - dense.covariance) / size).max() < 1e-9
        assert np.nanmax(np.abs(local.nis - dense.nis) / np.maximum(dense.nis, 1.0)) < 1e-9
        assert np.allclose(local.map.mean, dense.map.mean, rtol=1e-9, atol=1e-11)
        assert np.allclose(local.map.covariance, dense.map.covariance, rtol=1e-7, atol=1e-12)
        assert not np.array_equal(local.covariance, dense.covariance), "nothing was updated locally"


def test_noise_of_the_motion_that_is_seen_at_once_turns_nothing() -> None:
    """A world that `consistency challenge` found: with the pose turned by whole corrections the mean NEES is 10.6.

    The mean over 24 runs, of 3.2 with seed 7, spreads by 0.35 between seeds: less than one in a million is above 5.5.
    """
    scenario = cs.load_scenario("herath2007-stereo")
    path = scenario.truth.path.model_dump(exclude={"shape"}) | {"shape": "figure-of-eight", "radius": 2.0}
    sigma = {f"{half}__sensor__sigma": (0.844, 0.964, 0.41) for half in ("truth", "belief")}
    noise = {f"{half}__motion__{key}": value for half in ("truth", "belief")
             for key, value in (("sigma_v", 0.095), ("sigma_omega", 0.1658))}  # fmt: skip
    world = scenario.variant(
        "eight", truth__steps=950, truth__path=path | {"start": (0.0, 0.0), "heading": 0.0},
        truth__landmarks=scenario.truth.landmarks.model_dump() | {
            "count": 79, "seed": 20, "x": (-6.0, 6.0), "y": (-8.0, 8.0)},
        truth__sensor__range=(0.5, 5.3), **sigma, **noise,
    )  # fmt: skip
    results = cs.run_trials(world, [rc.PARKED], runs=24, seed=7)
    assert len(results.failures) == 0
    assert results.estimates["nees"].mean() < 5.5


def test_landmarks_are_parked_and_come_back(small: Small) -> None:
    scenario = small("herath2007-stereo", **CLOSING)
    trial, filter_ = cs.simulate(scenario, run=3), rc.RobotCentredKalman("trial", centred.Corrections())
    state = filter_.init(problem_of(trial, scenario.belief))
    parked, back = set(), set()
    for k in range(1, trial.steps + 1):
        before = dict(state.parked)
        state, _ = filter_.update(filter_.predict(state, trial.control(k)), trial.observation(k))
        parked |= set(state.parked)
        back |= set(before) - set(state.parked)
        assert set(state.clones) == set(state.parked.values())
        assert len(state.x) == 3 + 3 * (len(state.places) + len(state.clones))
    assert len(parked) > 5
    assert len(back) > 5


def test_the_place_of_a_clone_that_is_needed_no_more_is_free_again() -> None:
    clones = make_clones(Parking(50, 20, 4e-4, True, start=10), 3, 3, 36, 100, 2)
    clones.factors.Phi[:] = 1.0
    clones.of[:], clones.uses[0], clones.here[0] = 0, 2, 9
    state = State(np.ones(12), np.ones((12, 12)), 12, 9, np.array([3, 6]))
    unpark(0, state, clones)
    assert clones.uses[0] == 1
    assert state.P.all()
    unpark(1, state, clones)
    assert clones.of.tolist() == [-1, -1]
    assert clones.uses[0] == 0
    assert not state.P[:9, 9:].any()
    assert not np.triu(state.P[9:, 9:]).any()
    assert not state.x[9:].any()
    assert state.P[:9, :9].all()
    assert not clones.factors.Phi[9:12, :9].any()
    assert clones.factors.Phi[:9].all()


# --- bad input -----------------------------------------------------------------------------------


def test_a_belief_without_search_range_is_refused(small: Small) -> None:
    scenario = small("herath2007-stereo", belief__sensor__disparity=None)
    with pytest.raises(cs.InputError, match=r"'parked-ekf-uvd' needs key 'belief.sensor.disparity_px'"):
        cs.run_trials(scenario, ["parked-ekf-uvd"], runs=1)


def test_a_search_range_must_be_an_interval(small: Small) -> None:
    with pytest.raises(ValueError, match=r"disparity must be \[low, high\] with low < high"):
        small("herath2007-stereo", belief__sensor__disparity=(4.0, 4.0))


def test_a_belief_without_search_range_has_the_hash_it_had(small: Small) -> None:
    content = small("herath2007-stereo", belief__sensor__disparity=None).model_dump(mode="json")
    assert "disparity" not in content["belief"]["sensor"]
