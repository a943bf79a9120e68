"""The table of all filters: its rules, its costs and how a report shows it; and the rates of verdicts on maps."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

import consistency as cs
from consistency.bench.pages.sections.filters_table import filters_table
from consistency.bench.runs.reproduce_findings import Study, experiments
from consistency.referee.show.blocks import Status

ROW = {
    "filter": "a", "realisable": "yes", "error": "so2", "status": "consistent",
    "diagnosis": "consistent: one; two; three", "anees": 3.1, "rmse": 0.06, "rmse_heading_deg": 0.5,
    "map_status": "consistent", "map_diagnosis": "consistent: x", "map_nees": 1.02, "joint_nees": 1.01,
    "joint_low": 0.98, "joint_high": 1.04, "cost": 1.5, "failures": 0,
}  # fmt: skip


@pytest.fixture(scope="module")
def e16():
    return experiments()["e16_filters"]


def table(*changes):
    return pd.DataFrame([ROW | change for change in changes])


OVER = {"map_status": "overconfident"}


@pytest.mark.parametrize(
    "changes, verdict",
    [
        ([{}], "reproduced"),
        ([{}, {"status": "overconfident", "filter": "b"} | OVER], "reproduced"),
        ([{}, {"realisable": "no", "filter": "bound"} | OVER], "reproduced"),
        ([{}, {"filter": "b"} | OVER], "not reproduced"),
        ([{"status": "undecided"}], "not reproduced"),
    ],
)
def test_the_rule_of_maps(e16, changes, verdict):
    finding = e16.map_finding(Study(2, 0, 1), table(*changes))
    assert (finding.id, finding.verdict) == (e16.FINDINGS[0], verdict)


@pytest.mark.parametrize(
    "changes, verdict",
    [
        ([{"cost": 2.0}], "reproduced"),
        ([{"cost": 9.0}, {"cost": 1.9}], "reproduced"),
        ([{"cost": 2.1}, {"cost": 1.0, "status": "biased"}], "not reproduced"),
    ],
)
def test_the_rule_of_costs(e16, changes, verdict):
    finding = e16.cost_finding(Study(2, 0, 1), table(*changes))
    assert (finding.id, finding.verdict) == (e16.FINDINGS[1], verdict)


def test_costs_are_medians_of_rounds(e16, monkeypatch):
    clock, runs = [0.0], {"ekf-uvd": 0, "fast": 0, "slow": 0}

    def run_filter(filter_, *_):
        runs[filter_] += 1
        disturbed = 50.0 if runs[filter_] == 3 else 0.0
        clock[0] += {"ekf-uvd": 0.1, "fast": 0.25, "slow": 3.0}[filter_] + disturbed

    monkeypatch.setattr(e16, "run_filter", run_filter)
    monkeypatch.setattr(e16, "get_filter", lambda name: name)
    monkeypatch.setattr(e16.time, "perf_counter", lambda: clock[0])
    cost = e16.costs(["ekf-uvd", "fast", "slow"], 0)
    assert cost["ekf-uvd"] == 1.0
    assert cost["fast"] == pytest.approx(2.5)
    assert runs["slow"] == 1 + e16.FEW
    assert cost["slow"] == pytest.approx(30.0)


def test_a_row_says_what_the_verdicts_say(e16):
    scenario = cs.load_scenario("herath2007-stereo").variant("few", truth__steps=12)
    verdict = cs.analyse(cs.run_trials(scenario, ["ekf-uvd"], runs=5, seed=3, jobs=1))["ekf-uvd"]
    row = e16.row(verdict, 1.25)
    assert set(row) == set(ROW)
    assert (row["status"], row["map_status"], row["cost"]) == (verdict.status, verdict.map.verdict.status, 1.25)
    assert row["joint_nees"] == verdict.map.verdict.joint.both.value


def test_the_report_shows_the_table(tmp_path):
    report = SimpleNamespace(folder=tmp_path)
    assert filters_table(report) == ()
    rows = table(
        {}, {"filter": "bound", "realisable": "no", "map_status": "-", "map_nees": np.nan, "joint_nees": np.nan}
    )
    rows.assign(runs=20, false_alarm=0.01, scenario="world").to_parquet(tmp_path / "filters.parquet")
    (shown,) = filters_table(report)
    ((_, (first, second)),) = shown.groups
    assert first[0].text == "a"
    assert [small.text for small in first[0].below] == ["Pose: consistent: one; two.", "Map: consistent: x."]
    assert first[1:] == (Status("consistent"), "3.10", "0.06", Status("consistent"), "1.02", "1.01", "1.50", "0")
    assert (second[0].text, *second[4:7]) == ("bound (a bound)", "–", "–", "–")
    assert "world, 20 runs" in shown.caption


def test_calibration_rows_of_maps(monkeypatch):
    """Counted, not judged: 20 gates at 5 % say little of a rate."""
    monkeypatch.syspath_prepend(Path(__file__).parents[3] / "benchmarks")
    import calibration_map

    monkeypatch.setattr(calibration_map, "QUICK_GATES", {0.05: 20, 0.01: 10})
    monkeypatch.setattr(calibration_map, "POWER_GATES", 25)
    rows = calibration_map.rows(True, 5)
    assert {(r["stated"], r["gates"]) for r in rows} == {(0.05, 20), (0.01, 10), (0.95, 5)}
    assert {r["world"] for r in rows} | {r["question"] for r in rows} == set(calibration_map.ABOUT)
    assert all(r["found"] == r["gates"] for r in rows if r["question"] == calibration_map.POWER)
    assert all(r["found"] < r["gates"] for r in rows if r["question"] == calibration_map.ALARM)
    assert rows == calibration_map.rows(True, 5)
