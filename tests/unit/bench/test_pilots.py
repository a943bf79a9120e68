"""Pilots of a plan are the runs that were asked for."""

import json

import numpy as np
import pytest

from consistency.bench.runs import montecarlo, results_to_records
from consistency.commands.app import main
from consistency.diagnostics import make_record


def test_a_pilot_runs_what_it_is_told(monkeypatch, capsys):
    asked = []
    nees = np.random.default_rng(5).chisquare(3, (40, 5))

    def run_trials(scenario, *rest):
        asked.append((scenario.name, *rest))
        return "results"

    def records_of_results(results, filters):
        asked.append((results, filters))
        return (make_record(name, nees=nees, dof=3, t=np.arange(5.0)) for name in filters)

    monkeypatch.setattr(montecarlo, "run_trials", run_trials)
    monkeypatch.setattr(results_to_records, "records_of_results", records_of_results)
    filters = ["kf", "ekf-xyz"]
    named = [word for name in filters for word in ("--filter", name)]
    with pytest.raises(SystemExit) as end:
        main(["plan", "linear-gaussian", *named, "--pilot-runs", "40", "--seed", "7", "--json"])
    assert not end.value.code, capsys.readouterr().err
    assert asked == [("linear-gaussian", filters, 40, 7), ("results", filters)]
    like = json.loads(capsys.readouterr().out)["like"]
    assert {name: pilot["pilot_runs"] for name, pilot in like.items()} == dict.fromkeys(filters, 40)
