"""The commands as a newcomer types them, in a process of their own, from an empty folder."""

import json
import re
import subprocess
import sys

import numpy as np
import pandas as pd
import pytest
from documents import blocks
from numpy.testing import assert_allclose
from own_process import consistency
from scipy import stats

import consistency as cs
from consistency.bench.scenario import data_folder

RUNS = 6


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with ``sim`` (a simulated log) and ``out`` (results of two filters, all runs)."""
    at = tmp_path_factory.mktemp("cli")
    scenario = (data_folder("scenarios") / "herath2007-stereo.toml").read_text()
    (at / "small.toml").write_text(scenario.replace("steps = 500", "steps = 80"))
    consistency("simulate", "small.toml", "--runs", "2", "--seed", "3", "--out", "sim", cwd=at)
    arguments = ("run", "small.toml", "--filter", "ekf-uvd", "--filter", "ukf-uvd", "--runs", str(RUNS), "--seed", "3")
    consistency(*arguments, "--jobs", "2", "--out", "out", cwd=at)
    return at


def test_a_simulated_log_gives_the_same_estimates(folder):
    consistency("run", "--log", "sim", "--filter", "ekf-uvd", "--out", "from-log", cwd=folder)
    log = pd.read_parquet(folder / "from-log/estimates.parquet")
    direct = pd.read_parquet(folder / "out/estimates.parquet").query("filter == 'ekf-uvd' and run < 2")
    pd.testing.assert_frame_equal(log, direct.reset_index(drop=True), check_exact=False, rtol=1e-9)


def test_nees_by_hand(folder):
    """NEES from the files with nothing but NumPy; ANEES and its interval with SciPy."""
    table = pd.read_parquet(folder / "out/estimates.parquet")
    truth = pd.read_parquet(folder / "out/truth.parquet")
    joined = table.merge(truth, on=["run", "step"], suffixes=("", "_true")).sort_values(["filter", "run", "step"])
    error = np.stack([joined[f"{axis}_true"] - joined[axis] for axis in ("x", "y", "heading")], axis=1)
    error[:, 2] = np.arctan2(np.sin(error[:, 2]), np.cos(error[:, 2]))
    entries = [["P_xx", "P_xy", "P_xh"], ["P_xy", "P_yy", "P_yh"], ["P_xh", "P_yh", "P_hh"]]
    P = np.array([[joined[name] for name in row] for row in entries]).transpose(2, 0, 1)
    stored = joined["nees"].to_numpy()
    judged = np.isfinite(stored)
    assert set(joined["step"][~judged]) == {1}
    by_hand = np.array([e @ np.linalg.inv(p) @ e for e, p in zip(error[judged], P[judged], strict=True)])
    assert_allclose(by_hand, stored[judged], rtol=1e-9)

    verdict = json.loads(consistency("analyse", "out", "--json", cwd=folder).stdout)["ekf-uvd"]["statistics"]
    curve = joined[joined["filter"] == "ekf-uvd"].groupby("step")["nees"].mean().to_numpy()
    assert_allclose(np.array(verdict["anees"][1:], float), curve[1:], rtol=1e-12)
    band = stats.chi2.ppf([0.025, 0.975], 3 * RUNS) / RUNS
    assert_allclose(verdict["band"][1], band, rtol=1e-12)
    share = next(a["share"] for a in verdict["answers"] if a["question"] == "scale in some step")
    tail = 0.025 * share / 79  # so few runs that all steps count
    simultaneous = [stats.chi2.ppf(tail, 3 * RUNS) / RUNS, stats.chi2.isf(tail, 3 * RUNS) / RUNS]
    assert_allclose(verdict["simultaneous"][1], simultaneous, rtol=1e-9)


def test_list_names_everything(folder):
    listed = json.loads(consistency("list", "--json", cwd=folder).stdout)
    assert {"herath2007-stereo", "linear-gaussian", "long-loop"} <= set(listed["scenarios"])
    assert {"kf", "ukf-uvd", "filterpy-ukf-xyz"} <= set(listed["filters"])
    assert "e04_stereo" in listed["experiments"]
    assert {"regime", "small"} <= set(listed["sweeps"])
    assert list(listed["filter_summaries"]) == listed["filters"]
    summary = listed["filter_summaries"]["ispkf-uvd"]
    assert f"ispkf-uvd            {summary}\n" in consistency("list", cwd=folder).stdout


def test_reproduce_writes_findings(folder):
    consistency("reproduce", "--only", "interval-eq17", "--only", "fig12a", "--out", "found", cwd=folder)
    findings = json.loads((folder / "found/findings.json").read_text())
    assert [finding["id"] for finding in findings] == ["interval-eq17", "fig12a"]
    keys = {"id", "source", "claim", "statistic", "published", "measured", "accept", "verdict"}
    assert all(set(finding) == keys | {"runs", "seed", "scenario"} for finding in findings)
    assert (folder / "found/report.html").exists()
    assert (folder / "found/report.pdf").read_bytes().startswith(b"%PDF")


RUN = ("run", "small.toml", "--filter", "ekf-uvd", "--out", "o")
BAD = {
    "unknown filter": (("run", "small.toml", "--filter", "ekf-uvdd", "--out", "o"), "did you mean 'ekf-uvd'"),
    "no filter": (("run", "small.toml", "--out", "o"), "--filter"),
    "folder of somebody else": ((*RUN[:-1], "mine", "--overwrite"), "not overwritten"),
    "unknown command": (("judge",), "judge"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD)
def test_bad_input(folder, refused, case):
    (folder / "mine").mkdir(exist_ok=True)
    (folder / "mine/thesis.txt").write_text("all of it")
    arguments, expected = BAD[case]
    assert expected in refused(folder, *arguments)


def test_the_documented_filter_runs(tmp_path):
    """The example of a filter of one's own, with fewer runs: too few to show that it is right."""
    (example,) = (block.text for block in blocks("docs/own-filter.md", "python") if "class MyEkf" in block.text)
    (tmp_path / "mine.py").write_text(example.replace("runs=50", "runs=4"))
    done = subprocess.run([sys.executable, "mine.py"], cwd=tmp_path, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("my-ekf: ")
    assert "failed runs" not in done.stdout
    assert "ekf-uvd: " in done.stdout


class ThrowsInRun7:
    """Dead reckoning without any uncertainty growth in mind; breaks in step 20 of run 7."""

    name = "throws-in-run-7"

    def __init__(self, mark):
        self.inner, self.mark = cs.get_filter("ekf-uvd"), mark

    def init(self, problem):
        self.steps = 0
        return self.inner.init(problem)

    def predict(self, state, control):
        return self.inner.predict(state, control)

    def update(self, state, observation):
        self.steps += 1
        if self.steps == 20 and np.isclose(observation.z.sum(), self.mark):
            raise RuntimeError("diverged")
        return self.inner.update(state, observation)

    def pose(self, state):
        return self.inner.pose(state)


def test_a_failed_run_is_in_results_verdict_and_report(tmp_path):
    scenario = cs.load_scenario("herath2007-stereo").variant("short", truth__steps=40)
    mark = float(cs.simulate(scenario, run=7, seed=0).observation(20).z.sum())
    results = cs.run_trials(scenario, [ThrowsInRun7(mark), "ekf-uvd"], runs=12, jobs=1)
    ((name, run, step, reason),) = results.failures.values.tolist()
    assert (name, run, step) == ("throws-in-run-7", 7, 20)
    assert re.fullmatch(r"RuntimeError: diverged \(in update, test_cli\.py:\d+\)", reason)
    verdict = cs.analyse(results)["throws-in-run-7"]
    assert not verdict.consistent
    assert any("1 of 12 runs failed, first run 7 in step 20" in reason for reason in verdict.reasons)
    results.write(tmp_path / "out")
    consistency("report", "out", "--html", "r.html", cwd=tmp_path)
    assert "RuntimeError: diverged" in (tmp_path / "r.html").read_text()
