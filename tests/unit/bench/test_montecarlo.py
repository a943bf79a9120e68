"""Runs are a function of (scenario, filter, seed, run) alone, and whatever a filter does is a result."""

import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from misbehaving import Still

import consistency as cs
from consistency.bench.filters.run_filter import run_filter
from consistency.bench.runs.outcomes_to_results import Interrupted
from consistency.bench.types import Trial


class Mine:
    """The built-in EKF as a user would wrap it: no ``run``, so it goes step by step."""

    name = "mine"

    def __init__(self):
        self.inner = cs.get_filter("ekf-xyz")

    def init(self, problem):
        return self.inner.init(problem)

    def predict(self, state, control):
        return self.inner.predict(state, control)

    def update(self, state, observation):
        return self.inner.update(state, observation)

    def pose(self, state):
        return self.inner.pose(state)


def equal(a, b):
    """Same tables to the bit."""
    for name in ("estimates", "failures", "truth", "landmarks"):
        pd.testing.assert_frame_equal(getattr(a, name), getattr(b, name), check_exact=True)
    return True


@pytest.fixture(scope="module")
def ten(uvd):
    return cs.run_trials(uvd, ["ekf-uvd", "ekf-xyz"], runs=10, seed=3, jobs=1)


# --- the same bits -------------------------------------------------------------------------------


def test_number_of_runs_does_not_matter(uvd, ten):
    more = cs.run_trials(uvd, ["ekf-uvd", "ekf-xyz"], runs=15, seed=3, jobs=2)
    for name in ("estimates", "truth"):
        table = getattr(more, name)
        first = table[table["run"] < 10].reset_index(drop=True)
        pd.testing.assert_frame_equal(first, getattr(ten, name), check_exact=True)


def test_an_untouched_process_gives_the_same_bits(xyz):
    """A filter of one's own is sent to processes; the built-in one beside it must not notice."""
    pooled = cs.run_trials(xyz, ["ekf-xyz", Mine()], runs=4, seed=1, jobs=2)
    alone = cs.run_trials(xyz, ["ekf-xyz", Mine()], runs=4, seed=1, jobs=1)
    assert equal(pooled, alone)
    compiled = cs.run_trials(xyz, ["ekf-xyz"], runs=4, seed=1, jobs=2)
    among = pooled.estimates[pooled.estimates["filter"] == "ekf-xyz"].reset_index(drop=True)
    pd.testing.assert_frame_equal(among, compiled.estimates, check_exact=True)


# --- filters of the user's own -----------------------------------------------------------------------


def test_own_filter_beside_a_name(xyz):
    results = cs.run_trials(xyz, ["ekf-xyz", Mine()], runs=3, seed=1, jobs=1)
    assert results.filters == ["ekf-xyz", "mine"]
    ours, theirs = (results.estimates[results.estimates["filter"] == name] for name in results.filters)
    numbers = [column for column in ours.columns if column not in ("filter",)]
    assert np.allclose(ours[numbers], theirs[numbers], rtol=1e-6, atol=1e-12, equal_nan=True)
    verdict = cs.analyse(results)["mine"]
    assert verdict.statistics["nis_dof"] > 0


def test_a_filter_without_a_name_has_that_of_its_class(xyz):
    class Nameless(Mine):
        name = property()  # type: ignore[assignment]

    assert cs.run_trials(xyz, [Nameless()], runs=1, jobs=1).filters == ["Nameless"]


def test_a_pose_that_is_no_gaussian_is_named(xyz):
    class Tuple(Mine):
        name = "tuple"

        def pose(self, state):
            estimate = super().pose(state)
            return estimate.mean, estimate.covariance

    results = cs.run_trials(xyz, [Tuple()], runs=1, jobs=1)
    (reason,) = results.failures["reason"]
    assert reason == "TypeError: pose must return cs.Gaussian(mean, covariance), not tuple"


def test_a_filter_that_breaks_at_once(xyz):
    class Stillborn(Mine):
        name = "stillborn"

        def init(self, problem):
            return self.look_up(problem)

        def look_up(self, problem):
            raise KeyError("no such map")

    results = cs.run_trials(xyz, [Stillborn()], runs=3, jobs=1)
    assert len(results.estimates) == 0
    assert list(results.failures["step"]) == [1, 1, 1]
    (reason,) = set(results.failures["reason"])
    place = re.fullmatch(r"KeyError: 'no such map' \(in init, test_montecarlo\.py:(\d+)\)", reason)
    assert "raise KeyError" in Path(__file__).read_text("utf-8").splitlines()[int(place[1]) - 1]
    verdict = cs.analyse(results)["stillborn"]
    assert verdict.status == "failed"
    assert verdict.statistics["runs"] == 3
    assert verdict.reasons[0] == f"failed: 3 of 3 runs failed, first run 0: {reason}"
    assert "coverage" not in str(verdict)


def test_a_compiled_filter_that_breaks(small):
    """No motion noise believed: the pose covariance never gets any rank, and nothing is claimed of it."""
    scenario = small("herath2007-xyz", belief__motion__sigma_v=0.0, belief__motion__sigma_omega=0.0)
    results = cs.run_trials(scenario, ["ekf-xyz"], runs=2, jobs=1)
    assert results.estimates["nees"].isna().all()
    assert cs.analyse(results)["ekf-xyz"].status == "failed"


def test_a_compiled_filter_given_nonsense_says_in_which_step(uvd):
    trial = cs.simulate(uvd)
    z = trial.z.copy()
    z[trial.first[20] :] = np.nan
    hurt = Trial(
        0, trial.start, trial.controls, trial.first, trial.landmark, z, trial.n_landmarks, trial.truth, trial.landmarks
    )
    estimates = run_filter(cs.get_filter("ekf-uvd"), hurt, uvd.belief)
    assert estimates.failure.step == 21 + int(np.flatnonzero(np.diff(trial.first)[20:])[0])
    assert estimates.failure.reason == "the estimate is not finite"
    assert np.isnan(estimates.pose[estimates.failure.step - 1 :]).all()
    assert np.isfinite(estimates.pose[: estimates.failure.step - 1]).all()


# --- what is refused -----------------------------------------------------------------------------


class Same(Mine):
    name = "ekf-xyz"


@pytest.mark.parametrize(
    "options, complaint",
    [
        ({"filters": ["ekf-xyz", "ekf-xyz"]}, "a filter is given twice: ekf-xyz"),
        ({"filters": ["ekf-xyz", Same()]}, "given twice: ekf-xyz"),
        ({"filters": [Same()]}, "filter 'ekf-xyz': is a built-in filter; give yours another name"),
        ({"filters": ["ekf-uvd"]}, r"filter 'ekf-uvd' works on a sensor uvd, not 'xyz'.*fit: .*ekf-xyz"),
        ({"filters": ["ekf-xyzz"]}, r"unknown filter 'ekf-xyzz' \(did you mean 'ekf-xyz'\?\); known: kf, "),
        ({"filters": []}, "no filter given; known: kf"),
        ({"filters": [object()]}, r"init.*predict.*update.*pose"),
        ({"runs": 0}, "runs must be at least 1, got 0"),
        ({"seed": -1}, "seed must not be negative, got -1"),
        ({"jobs": 0}, "jobs must be at least 1, or -1"),
        ({"jobs": -2}, "jobs must be at least 1, or -1"),
    ],
)
def test_arguments_that_are_refused(xyz, options, complaint):
    with pytest.raises(cs.InputError, match=complaint):
        cs.run_trials(xyz, **{"filters": ["ekf-xyz"], "runs": 1, "jobs": 1, **options})


# --- stopped and resumed -------------------------------------------------------------------------


def test_stopped_and_resumed_gives_the_same_bits(uvd, ten, stop_at, monkeypatch, tmp_path):
    stop_at(4, KeyboardInterrupt())
    with pytest.raises(Interrupted) as stop:
        cs.run_trials(uvd, ["ekf-uvd", "ekf-xyz"], runs=10, seed=3, jobs=1)
    part = stop.value.results
    finished = part.finished_runs(part.filters)
    assert {0, 1, 2, 3} <= finished  # a later run may have ended before the stop is seen
    assert 4 not in finished
    assert part.manifest["finished_runs"] == len(finished)
    assert not part.manifest["complete"]
    first = ten.estimates[ten.estimates["run"].isin(finished)].reset_index(drop=True)
    pd.testing.assert_frame_equal(part.estimates, first, check_exact=True)
    part.write(tmp_path / "out")
    monkeypatch.undo()
    previous = cs.read_results(tmp_path / "out")
    resumed = cs.run_trials(uvd, ["ekf-uvd", "ekf-xyz"], runs=10, seed=3, jobs=1, previous=previous)
    assert equal(resumed, ten)
    assert resumed.manifest["complete"]
    assert "finished_runs" not in resumed.manifest


def test_resuming_what_is_complete_needs_no_compiler(uvd, ten, monkeypatch):
    monkeypatch.setattr("consistency.bench.filters.compiled.Compiled.is_ready", lambda *_: False)
    assert equal(cs.run_trials(uvd, ["ekf-uvd", "ekf-xyz"], runs=10, seed=3, jobs=1, previous=ten), ten)


@pytest.mark.parametrize(
    "change, key",
    [({"seed": 4}, "seed"), ({"filters": ["ekf-uvd"]}, "filter"), ({"truth__steps": 61}, "scenario")],
)
def test_resuming_something_else_is_refused(small, ten, tmp_path, change, key):
    ten.write(tmp_path / "out")
    scenario = small("herath2007-stereo", **{k: v for k, v in change.items() if k.startswith("truth")})
    filters, seed = change.get("filters", ["ekf-uvd", "ekf-xyz"]), change.get("seed", 3)
    with pytest.raises(cs.InputError, match=f"to resume have another {key}"):
        cs.run_trials(scenario, filters, runs=10, seed=seed, jobs=1, previous=cs.read_results(tmp_path / "out"))


class InPlace(Still):
    """Works on what it is given instead of on a copy."""

    def init(self, problem):
        problem.start += 1.0


def test_a_filter_cannot_change_what_the_next_one_is_given(xyz):
    results = cs.run_trials(xyz, [InPlace("in-place"), "ekf-xyz"], runs=2, jobs=1)
    alone = cs.run_trials(xyz, ["ekf-xyz"], runs=2, jobs=1)
    both = results.estimates[results.estimates["filter"] == "ekf-xyz"].reset_index(drop=True)
    pd.testing.assert_frame_equal(both, alone.estimates)
    assert list(results.failures["filter"]) == ["in-place"] * 2
    assert results.failures["reason"].str.contains("read-only").all()


def test_fewer_runs_than_there_are_are_refused(linear):
    results = cs.run_trials(linear, ["kf"], runs=3, jobs=1)
    with pytest.raises(cs.InputError, match="runs must be at least 3: so many are there already, got 2"):
        cs.run_trials(linear, ["kf"], runs=2, jobs=1, previous=results)
    assert cs.run_trials(linear, ["kf"], runs=3, jobs=1, previous=results).finished_runs(["kf"]) == {0, 1, 2}
