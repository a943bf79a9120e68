"""Pilots of a plan are the runs that were asked for."""

import numpy as np

from consistency.bench.runs import scores_by_run
from consistency.diagnostics import Record


def test_a_pilot_runs_what_it_is_told(monkeypatch):
    asked = []

    def run_trials(scenario, *rest):
        asked.append((scenario.name, *rest))
        return "results"

    def records_of(results, filters):
        asked.append((results, filters))
        return [Record("kf", nees=np.full((40, 5), 6.0), dof=3, t=np.arange(5.0))]

    monkeypatch.setattr(scores_by_run, "run_trials", run_trials)
    monkeypatch.setattr(scores_by_run, "records_of_results", records_of)
    ((name, (means, steps)),) = scores_by_run.pilots_in_world("linear-gaussian", ["kf"], 40, 7).items()
    assert asked == [("linear-gaussian", ["kf"], 40, 7), ("results", ["kf"])]
    assert (name, steps) == ("kf", 5)
    np.testing.assert_array_equal(means, np.full(40, 2.0))
