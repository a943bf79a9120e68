"""The simulated world against the contract, brute force and exact distributions.

Every statistical test here is a two-sided chi-square test with a false-alarm rate of 1e-5.
"""

import numpy as np
import pytest
from scipy import stats

import consistency as cs
from consistency.bench.filters.textbook.basics import PointSensor, motion_jacobians
from consistency.bench.simulation import draw_landmarks, planned_controls, planned_path, require_landmarks_in_view
from consistency.bench.types import Control
from consistency.referee.geometry import rotation

FALSE_ALARM = 1e-5


def variance_fits(normalised):
    """Whether the sum of squares of standard normal values is inside its 1 - 1e-5 interval."""
    total = float(np.sum(np.square(normalised)))
    low, high = stats.chi2.interval(1 - FALSE_ALARM, normalised.size)
    return bool(low <= total <= high)


def same(a, b):
    return all(np.array_equal(x, y) for x, y in zip(_arrays(a), _arrays(b), strict=True))


def _arrays(t):
    assert t.truth is not None
    assert t.landmarks is not None
    return t.start, t.controls, t.first, t.landmark, t.z, t.truth, t.landmarks


# --- seeds -----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["herath2007-xyz", "herath2007-stereo", "linear-gaussian"])
def test_a_run_depends_on_nothing_but_scenario_seed_and_number(small, name):
    scenario = small(name)
    alone = cs.simulate(scenario, run=7, seed=3)
    among = [cs.simulate(scenario, run=run, seed=3) for run in range(9)]
    assert same(alone, among[7])
    assert alone.run == 7
    for other in (among[6], among[8], cs.simulate(scenario, run=7, seed=4)):
        assert not same(alone, other)
        assert not np.array_equal(alone.controls, other.controls) or name == "linear-gaussian"


def test_belief_and_name_do_not_change_the_world(small):
    told_less = small("herath2007-xyz", belief__motion__sigma_v=0.4, belief__sensor__sigma=(1.0, 1.0, 1.0))
    assert same(cs.simulate(small("herath2007-xyz"), 2, 5), cs.simulate(told_less, 2, 5))


def test_motion_noise_does_not_depend_on_the_sensor(small):
    blind = small("herath2007-xyz", truth__sensor__range=(0.5, 1.0), truth__sensor__sigma=(1.0, 1.0, 1.0))
    a, b = cs.simulate(small("herath2007-xyz")), cs.simulate(blind)
    assert np.array_equal(a.controls, b.controls)
    assert len(a.z) != len(b.z)


def test_a_longer_trial_begins_like_the_shorter_one(small):
    short, long = (cs.simulate(small("herath2007-xyz", truth__steps=steps)) for steps in (60, 90))
    assert np.array_equal(long.controls[:60], short.controls)
    assert np.array_equal(long.z[: len(short.z)], short.z)


@pytest.mark.parametrize("name", ["herath2007-xyz", "linear-gaussian"])
def test_landmarks_are_the_same_in_all_runs_and_inside_their_box(small, name):
    scenario = small(name)
    worlds = [cs.simulate(scenario, run, seed).landmarks for run, seed in ((0, 0), (1, 0), (0, 9))]
    assert np.array_equal(worlds[0], worlds[1])
    assert np.array_equal(worlds[0], worlds[2])
    box = scenario.truth.landmarks
    low, high = np.array([box.x, box.y, box.z]).T
    assert worlds[0].shape == (box.count, 3)
    assert np.all((worlds[0] >= low) & (worlds[0] <= high))
    other = small(name, truth__landmarks__seed=1)
    assert not np.array_equal(draw_landmarks(other.truth), worlds[0])


def test_listed_landmarks_stand_where_they_are_listed(small):
    points = [[3.0, 1.0, 0.5], [2.0, 2.0, 0.0]]
    scenario = small("herath2007-xyz", truth__landmarks={"layout": "listed", "points": points})
    assert np.array_equal(cs.simulate(scenario).landmarks, points)


# --- what is seen ------------------------------------------------------------------------------


def seen_by_hand(scenario, path, landmarks):
    """The contract's rule, landmark by landmark: true position in range, true projection in the image."""
    sensor = scenario.truth.sensor
    turn, seen = rotation(*sensor.mount.rotation), set()
    for step, (px, py, heading) in enumerate(path[1:], start=1):
        for label, landmark in enumerate(landmarks):
            body = rotation(0, 0, heading).T @ (landmark - [px, py, 0.0])
            x, y, z = turn.T @ (body - sensor.mount.position)
            if not sensor.range[0] <= np.sqrt(x * x + y * y + z * z) <= sensor.range[1]:
                continue
            if sensor.image is not None:
                column = sensor.centre[0] - sensor.f * y / x
                row = sensor.centre[1] - sensor.f * z / x
                if x <= 0 or not (0 <= column < sensor.image[0] and 0 <= row < sensor.image[1]):
                    continue
            seen.add((step, label))
    return seen


WORLDS = {
    "principal point aside": {"truth__sensor__principal_point": (100.0, 60.0)},
    "no image": {"truth__sensor__image": None},
}


@pytest.mark.parametrize("world", WORLDS)
def test_seen_is_what_is_in_range_and_in_the_image(small, world):
    scenario = small("herath2007-xyz", truth__steps=40, **WORLDS[world])
    trial = cs.simulate(scenario, run=1)
    expected = seen_by_hand(scenario, trial.truth, trial.landmarks)
    assert expected
    assert set(zip(trial.step, trial.landmark, strict=True)) == expected


def test_nothing_in_view_is_unusable_input(small):
    scenario = small("herath2007-xyz", truth__landmarks={"layout": "listed", "points": [[500.0, 0.0, 0.0]]})
    with pytest.raises(cs.InputError, match=r"no landmark comes into view.*truth\.sensor.*truth\.landmarks"):
        require_landmarks_in_view(scenario)
    assert len(cs.simulate(scenario).z) == 0


# --- noise -------------------------------------------------------------------------------------


def test_observation_noise_of_a_linear_world_has_the_stated_variance(small):
    sigma = (0.02, 0.05, 0.11)
    scenario = small("linear-gaussian", truth__sensor__sigma=sigma, truth__steps=250)
    trial = cs.simulate(scenario)
    sensor, planned = PointSensor(scenario.belief.sensor, uvd=False), planned_path(scenario.truth)
    pose, reference, landmark = trial.truth[trial.step], planned[trial.step], trial.landmarks[trial.landmark]
    H = np.array([sensor.jacobians(p, m)[0] for p, m in zip(reference, landmark, strict=True)])
    residual = trial.z - sensor.measure(reference, landmark) - np.einsum("mij,mj->mi", H, pose - reference)
    for axis in range(3):
        assert variance_fits(residual[:, axis] / sigma[axis])
        assert not variance_fits(residual[:, axis] / (1.3 * sigma[axis]))  # negative control


def test_start_is_exact_and_time_counts_from_zero(uvd):
    trial = cs.simulate(uvd)
    assert np.array_equal(trial.truth[0], trial.start)
    assert np.allclose(trial.t, 0.1 * np.arange(61))


# --- the linear world ----------------------------------------------------------------------------


def test_linear_world_superposes(small):
    """Three times the noise is three times the deviation, in the path and in every observation."""
    changes = {"truth__motion__sigma_v": 0.3, "truth__motion__sigma_omega": 0.5}
    threefold = {key: 3 * value for key, value in changes.items()}
    once = small("linear-gaussian", **changes, truth__sensor__sigma=(0.1, 0.2, 0.3))
    thrice = small("linear-gaussian", **threefold, truth__sensor__sigma=(0.3, 0.6, 0.9))
    a, b = cs.simulate(once), cs.simulate(thrice)
    reference = planned_path(once.truth)
    assert np.allclose(b.truth - reference, 3 * (a.truth - reference), rtol=0, atol=1e-12)
    assert np.array_equal(a.landmark, b.landmark)
    nominal = PointSensor(once.belief.sensor, uvd=False).measure(reference[a.step], a.landmarks[a.landmark])
    assert np.allclose(b.z - nominal, 3 * (a.z - nominal), rtol=0, atol=1e-12)
    assert np.abs(a.truth - reference).max() > 0.1


def test_linear_world_moves_by_the_jacobians_at_the_plan(linear):
    """Deviation <- F deviation + G noise: the part across the planned heading has no noise of its own."""
    trial, reference = cs.simulate(linear), planned_path(linear.truth)
    deviation, noises = trial.truth - reference, []
    for k in range(trial.steps):
        F, G = motion_jacobians(reference[k], Control(*planned_controls(linear.truth)[k]))
        noise, _, _, _ = np.linalg.lstsq(G, deviation[k + 1] - F @ deviation[k], rcond=None)
        assert np.allclose(G @ noise, deviation[k + 1] - F @ deviation[k], rtol=0, atol=1e-12)
        noises.append(noise)
    assert variance_fits(np.array(noises) / [linear.truth.motion.sigma_v, linear.truth.motion.sigma_omega])


def test_linear_world_sees_the_same_in_every_run(linear):
    a, b = cs.simulate(linear, 0), cs.simulate(linear, 1)
    assert np.array_equal(a.landmark, b.landmark)
    assert np.array_equal(a.first, b.first)
    assert not np.array_equal(a.truth, b.truth)
    expected = seen_by_hand(linear, planned_path(linear.truth), a.landmarks)
    assert set(zip(a.step, a.landmark, strict=True)) == expected


def test_waypoints_that_lead_nowhere_are_refused():
    path = {
        "shape": "waypoints", "points": [(1.0, 2.0)], "turn_rate": 1.0,
        "start": (1.0, 2.0), "heading": 0.0, "speed": 1.0,
    }  # fmt: skip
    with pytest.raises(ValueError, match="other than start"):
        cs.load_scenario("herath2007-xyz").variant("still", truth__path=path)
