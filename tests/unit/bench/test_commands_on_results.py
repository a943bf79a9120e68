"""Commands and gates on results of the bench: a folder and results in memory are turned into records by who calls."""

import json

import numpy as np
import pytest
from command import consistency, refused

import consistency as cs
from consistency.bench.runs.results_to_records import analyse, record_of
from consistency.testing import ConsistencyError, assert_consistent, assert_not_worse

RUNS = 40


@pytest.fixture(scope="module")
def results():
    world = cs.load_scenario("linear-gaussian").variant("short", truth__steps=12)
    return cs.run_trials(world, ["kf"], runs=RUNS, seed=11, jobs=1)


@pytest.fixture(scope="module")
def folder(results, tmp_path_factory):
    folder = tmp_path_factory.mktemp("results") / "kept"
    results.write(folder)
    return folder


def test_results_folder_and_records_have_one_verdict(results, folder):
    by_source = [analyse(each)["kf"] for each in (results, folder, str(folder), [record_of(results, "kf")])]
    assert {verdict.status for verdict in by_source} == {by_source[0].status}
    assert {verdict.scale.mean_anees for verdict in by_source} == {by_source[0].scale.mean_anees}
    assert cs.analyse is analyse


def test_a_verdict_of_a_folder(folder, capsys):
    out, _ = consistency(capsys, "analyse", str(folder), "--json")
    assert json.loads(out)["kf"]["status"] == analyse(folder)["kf"].status


def test_a_baseline_of_a_folder_is_compared_with_it(folder, tmp_path, capsys):
    kept = tmp_path / "base.json"
    consistency(capsys, "baseline", str(folder), "--out", str(kept))
    assert json.loads(kept.read_text(encoding="utf-8"))["scenario"] == "short"
    for other in (kept, folder):
        out, _ = consistency(capsys, "compare", str(folder), str(other))
        assert "run by run on the same trials" in out
        assert "every run is the same in both" in out


def test_innovations_of_a_folder_are_watched(results, folder, capsys):
    out, _ = consistency(capsys, "monitor", str(folder), "--run", "3", "--innovations", "optimal", "--json")
    counted = results.estimates.query("run == 3 and nis_dof > 0")
    assert json.loads(out)["judged"] == len(counted)
    assert "holds more than one run" in refused(capsys, "monitor", str(folder), "--innovations", "optimal")


def test_a_plan_like_a_folder_knows_its_filters(folder, capsys):
    out, _ = consistency(capsys, "plan", "--like", str(folder), "--json")
    assert "kf" in out
    assert "'ukf-uvd'" in refused(capsys, "plan", "--like", str(folder), "--filter", "ukf-uvd")


def test_a_gate_takes_results_and_names_what_it_lacks(results):
    loose = {"detect": 4.0, "power": 0.5, "false_alarm": 1e-9}
    assert assert_consistent(results, **loose).status == "consistent"
    assert assert_consistent(results, filter="kf", **loose).status == "consistent"
    with pytest.raises(ValueError, match=r"filter names one in the results of consistency\.run_trials"):
        assert_consistent(np.zeros((3, 2, 1)), filter="kf")


@pytest.mark.parametrize("kind", ["in memory", "folder", "text", "file"])
def test_a_reference_may_be_results_a_folder_or_a_file(kind, results, folder, tmp_path, capsys):
    """The same trials: no run differs, so that the candidate is not worse."""
    consistency(capsys, "baseline", str(folder), "--out", str(tmp_path / "base.json"))
    reference = {"in memory": results, "folder": folder, "text": str(folder), "file": tmp_path / "base.json"}[kind]
    compared = assert_not_worse(results, filter="kf", reference=reference)
    assert (compared.paired, compared.distance, compared.runs) == (True, 0.0, RUNS)
    with pytest.raises((ValueError, ConsistencyError)):
        assert_not_worse(results, filter="kf", reference=tmp_path / "none.json")
