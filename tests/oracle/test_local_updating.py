"""Local updating is the dense filter: the same numbers whatever is active, when it is settled and how often."""

import numpy as np
import pytest
from bench_trials import growing, grown
from estimates import apart

import consistency as cs
from consistency.bench.filters.run_filter import step_through

NEVER = 10**9
ALL = [
    ("kf", "linear-gaussian"),
    ("ekf-xyz", "herath2007-xyz"),
    ("ekf-xyz", "herath2007-stereo"),
    ("ekf-uvd", "herath2007-stereo"),
    ("ukf-xyz", "herath2007-xyz"),
    ("ukf-uvd", "herath2007-stereo"),
    ("debiased-ekf-xyz", "herath2007-stereo"),
    ("ispkf-uvd", "herath2007-stereo"),
    ("parked-ekf-uvd", "herath2007-stereo"),
]


def run(name, trial, belief, local_from, monkeypatch):
    filter_ = cs.get_filter(name)
    monkeypatch.setattr(filter_, "local_from", local_from)
    said = filter_.run(trial, belief)
    return said


def gap(a, b):
    """As :func:`apart`, and of the maps."""
    assert np.array_equal(a.map.landmarks, b.map.landmarks)
    spread = np.abs(b.map.covariance).max(axis=(1, 2), keepdims=True)
    points = max(np.abs(a.map.mean - b.map.mean).max(), (np.abs(a.map.covariance - b.map.covariance) / spread).max())
    return float(max(apart(a, b), points))


@pytest.mark.parametrize("name, world", ALL)
def test_every_filter_equals_its_dense_self(monkeypatch, name, world):
    scenario = cs.load_scenario(world)
    trial = cs.simulate(scenario, run=2)
    local, dense = (run(name, trial, scenario.belief, each, monkeypatch) for each in (10, NEVER))
    assert gap(local, dense) < 1e-9
    assert not np.array_equal(local.covariance, dense.covariance), "nothing was updated locally"


def test_first_estimates_are_kept_while_updating_is_local(monkeypatch):
    """``dense`` is the same kernel with a bound that the state does not reach."""
    scenario = cs.load_scenario("herath2007-xyz")
    trial = cs.simulate(scenario, run=2)
    local, dense = (run("fej-ekf-xyz", trial, scenario.belief, each, monkeypatch) for each in (10, 363))
    assert gap(local, dense) < 1e-9
    assert not np.array_equal(local.covariance, dense.covariance), "nothing was updated locally"


def test_the_textbook_twin_says_the_same(monkeypatch):
    case = growing(80, 3)
    local = run("ekf-xyz", case.trial, case.belief, 10, monkeypatch)
    assert gap(local, step_through(cs.get_filter("ekf-xyz").textbook, case.trial, case.belief)) < 1e-9


@pytest.mark.parametrize("local_from", [4, 60, 150])
def test_places_seen_again(monkeypatch, local_from):
    """A loop of which every landmark is left and met again."""
    scenario = cs.load_scenario("long-loop")
    trial = cs.simulate(scenario)
    local, dense = (run("ekf-xyz", trial, scenario.belief, each, monkeypatch) for each in (local_from, NEVER))
    assert gap(local, dense) < 1e-9
    assert not np.array_equal(local.covariance, dense.covariance)


@pytest.mark.parametrize("name", ["ekf-xyz", "ukf-xyz"])
@pytest.mark.parametrize("make", [lambda: growing(300, 2), lambda: grown(200, 150)], ids=["new ones", "known ones"])
def test_one_landmark_more_in_each_step(monkeypatch, name, make):
    case = make()
    local, dense = (run(name, case.trial, case.belief, each, monkeypatch) for each in (40, NEVER))
    assert gap(local, dense) < 1e-9
    assert not np.array_equal(local.covariance, dense.covariance)


def test_steps_without_a_landmark(monkeypatch):
    """The robot alone stays active; then it sees again what it saw at first."""
    case = grown(30, 60)
    trial = case.trial
    step = trial.step - 1
    kept = (step < 8) | (step > 40)
    first = np.searchsorted(step[kept], np.arange(trial.steps + 1))
    assert (np.diff(first) == 0).sum() > 30
    sparse = cs.Trial(
        0, trial.start, trial.controls, first, trial.landmark[kept], trial.z[kept], trial.n_landmarks, trial.truth
    )
    local, dense = (run("ekf-xyz", sparse, case.belief, each, monkeypatch) for each in (10, NEVER))
    assert gap(local, dense) < 1e-9


@pytest.mark.parametrize("steps", [3, 30, 80])
def test_a_failure_is_in_the_same_step(monkeypatch, steps):
    case = growing(100, 1)
    z = case.trial.z.copy()
    z[case.trial.first[steps - 1]] = np.nan
    t = case.trial
    broken = cs.Trial(0, t.start, t.controls, t.first, t.landmark, z, t.n_landmarks, t.truth)
    local, dense = (run("ekf-xyz", broken, case.belief, each, monkeypatch) for each in (10, NEVER))
    assert local.failure == dense.failure
    assert local.failure.step >= steps
