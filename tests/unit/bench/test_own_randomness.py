"""A filter of the user's own that draws random numbers: each run has its own, and the same ones when it is repeated."""

import numpy as np
import pandas as pd
import pytest
from ensemble import Ensemble

import consistency as cs
from consistency.bench.filters.filter_inputs import random_numbers
from consistency.bench.filters.run_filter import run_filter
from consistency.diagnostics import Settings

RUNS = 80
STRICT = Settings(false_alarm=1e-4)  # chance that the right filter below is not called consistent


class Draws:
    """Its pose is a draw, so that estimates show which random numbers it has."""

    def __init__(self, name="draws"):
        self.name = name

    def init(self, problem):
        return problem.rng

    def predict(self, state, control):
        return state

    def update(self, state, observation):
        return state, None

    def pose(self, state):
        return cs.Gaussian(state.normal(size=3), np.eye(3))


@pytest.fixture(scope="module")
def world():
    return cs.load_scenario("linear-gaussian").variant(
        "linear-short", summary="A few landmarks and steps", truth__steps=8, truth__landmarks__count=60
    )


def poses(results):
    """Estimates (runs, steps, 3)."""
    table = results.estimates
    return table[["x", "y", "heading"]].to_numpy().reshape(table["run"].nunique(), -1, 3)


def test_an_ensemble_filter_that_is_right_is_consistent(world):
    """False-alarm rate 1e-4; one that begins each run with the same generator has an error that all runs share."""
    right, shared = (
        cs.analyse(cs.run_trials(world, [Ensemble(own)], RUNS, jobs=1), settings=STRICT)["my-enkf"] for own in (None, 0)
    )
    assert right.status == "consistent"
    assert shared.status != "consistent"
    assert any("mean error" in reason for reason in shared.reasons)


def test_a_repeated_run_has_the_same_random_numbers(world):
    once = cs.run_trials(world, [Ensemble()], 4, seed=3, jobs=1)
    two = cs.run_trials(world, [Ensemble()], 2, seed=3, jobs=1)
    for again in (
        cs.run_trials(world, [Ensemble()], 4, seed=3, jobs=2),
        cs.run_trials(world, [Ensemble()], 4, seed=3, jobs=1, previous=two),
        cs.run_trials(world, [Draws(), Ensemble()], 4, seed=3, jobs=1),
    ):
        of_it = again.estimates[again.estimates["filter"] == "my-enkf"].reset_index(drop=True)
        pd.testing.assert_frame_equal(of_it, once.estimates, check_exact=True)


def test_runs_seeds_and_filters_have_random_numbers_of_their_own(world):
    results = cs.run_trials(world, [Draws(), Draws("others")], 3, seed=3, jobs=1)
    tables = [results.estimates[results.estimates["filter"] == name] for name in ("draws", "others")]
    drawn = [table[["x", "y", "heading"]].to_numpy() for table in tables]
    other_seed = poses(cs.run_trials(world, [Draws()], 3, seed=4, jobs=1))
    assert len(np.unique(np.concatenate([*drawn, other_seed.reshape(-1, 3)]), axis=0)) == 3 * 3 * 8


def test_random_numbers_are_not_those_of_the_trial(world):
    trial = cs.simulate(world, run=5, seed=3)
    assert (trial.run, trial.seed) == (5, 3)
    expected = np.random.default_rng(np.random.SeedSequence(3, spawn_key=(5, 2, *b"draws"))).normal(size=(8, 3))
    np.testing.assert_array_equal(run_filter(Draws(), trial, world.belief).pose, expected)
    for purpose in (0, 1):
        noise = np.random.default_rng(np.random.SeedSequence(3, spawn_key=(5, purpose)))
        assert noise.normal() != random_numbers(trial, "draws").normal()


def test_one_filter_and_a_scenario_by_its_name(world):
    alone = cs.run_trials("linear-gaussian", "kf", 2, seed=1, jobs=1)
    assert alone.filters == ["kf"]
    listed = cs.run_trials(cs.load_scenario("linear-gaussian"), ["kf"], 2, seed=1, jobs=1)
    pd.testing.assert_frame_equal(alone.estimates, listed.estimates, check_exact=True)
    assert cs.run_trials(world, Draws(), 1, jobs=1).filters == ["draws"]
    np.testing.assert_array_equal(cs.simulate("linear-gaussian").z, cs.simulate(cs.load_scenario("linear-gaussian")).z)
    with pytest.raises(cs.InputError, match=r"linear-gausian.*did you mean 'linear-gaussian'"):
        cs.run_trials("linear-gausian", "kf")
    with pytest.raises(cs.InputError, match=r"is not a filter.*\(\)"):
        cs.run_trials(world, Draws)
