"""A filter that takes its Jacobians at the truth is marked, is told it, and is refused where there is none."""

from dataclasses import replace

import numpy as np
import pytest

import consistency as cs
from consistency.bench.filters import BOUNDS, filter_summaries, usable_names
from consistency.bench.filters.filter_inputs import problem_for, problem_of
from consistency.bench.filters.run_filter import run_filter, step_through
from consistency.bench.protocols import is_realisable
from consistency.bench.runs.montecarlo import run_log, simulate_log
from consistency.bench.store.recorded_log import read_log


def test_only_the_ideal_filters_are_marked():
    assert {name for name in usable_names() if not is_realisable(cs.get_filter(name))} == BOUNDS


def test_a_name_says_the_data_and_the_summary_too():
    said = filter_summaries()
    assert said["iekf-uvd"] == "EKF with an iterated update, on pixels"
    assert said["iekf-rb"] == "EKF with an iterated update, in the plane, on range and bearing"
    assert said["kf"].startswith("Kalman filter of a linear world")


def test_no_other_filter_is_told_the_truth(uvd):
    trial = cs.simulate(uvd)
    for name in ("ekf-uvd", "fej-ekf-uvd", "oc-ekf-uvd"):
        told, plain = (
            vars(of) for of in (problem_for(cs.get_filter(name), trial, uvd.belief), problem_of(trial, uvd.belief))
        )
        assert all(told[field] is plain[field] for field in plain if field != "rng")
    told = problem_for(cs.get_filter("ideal-ekf-uvd"), trial, uvd.belief).truth
    assert told.path is trial.truth
    assert told.landmarks is trial.landmarks


@pytest.mark.parametrize("table", ["truth", "landmarks"])
def test_a_log_without_truth_is_refused(uvd, tmp_path, table):
    simulate_log(uvd, runs=1, seed=1, out=tmp_path / "log")
    (tmp_path / "log" / f"{table}.parquet").unlink()
    with pytest.raises(
        cs.InputError, match=f"'ideal-ekf-uvd' is a bound .* run 0 has none; a log needs {table}.parquet"
    ):
        run_log(read_log(tmp_path / "log"), ["ideal-ekf-uvd"], jobs=1)


def test_measurements_alone_are_refused(uvd):
    trial, filter_ = cs.simulate(uvd), cs.get_filter("ideal-ekf-uvd")
    with pytest.raises(cs.InputError, match="cannot be stepped on measurements alone"):
        filter_.init(problem_of(trial, uvd.belief))
    unknown = replace(trial, truth=None)
    for run in (run_filter, step_through):
        with pytest.raises(cs.InputError, match="or leave the filter out"):
            run(filter_, unknown, uvd.belief)


def test_things_that_are_no_landmark_are_refused(uvd):
    trial, filter_ = cs.simulate(uvd), cs.get_filter("ideal-ekf-uvd")
    landmark = np.array(trial.landmark)
    landmark[-1] = trial.n_landmarks
    with pytest.raises(cs.InputError, match="things that are not landmarks"):
        run_filter(filter_, replace(trial, landmark=landmark, n_landmarks=trial.n_landmarks + 1), uvd.belief)
