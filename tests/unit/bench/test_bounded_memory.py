"""Verdicts on thousands of runs: how much memory each run takes, and that blocks change nothing."""

import os
import subprocess
import sys
import tracemalloc
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from records import changed

import consistency as cs
from consistency.bench.runs.results_to_records import analyse, record_of
from consistency.bench.store.results import open_results
from consistency.diagnostics import Settings, judge, make_record, summary
from consistency.referee.diagnostics.sample import sample_of
from consistency.referee.diagnostics.whitening import all_finite, squared_length
from consistency.referee.show.as_json import render
from consistency.referee.verdicts.tables import document

STEPS = 200
RUNS = 4000


def evidence(runs, steps=STEPS, bias=0.3):
    """Errors with a mean, so that every question is asked twice."""
    rng = np.random.default_rng(0)
    P = np.tile(0.2 + np.diag([0.8, 1.8, 2.8]), (runs, steps, 1, 1))
    error = rng.standard_normal((runs, steps, 3)) + bias
    nis = rng.chisquare(2, (runs, steps))
    return make_record("f", error, P, nis=nis, nis_dof=np.full((runs, steps), 2), axes=("x", "y", "heading"))


def numbers_a_cell(work, runs=1400):
    """Most numbers of 8 bytes that ``work`` holds beside what it is given, for each further pair of run and step."""
    most = []
    for count in (runs, 3 * runs):
        given = evidence(count)
        tracemalloc.start()
        work(given)
        most.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    # from 1400 runs on a block of steps is not all of them
    return (most[1] - most[0]) / (2 * runs * STEPS * 8)


@pytest.mark.parametrize("settings", [Settings(), Settings(allow="conservative")], ids=["both", "conservative"])
def test_a_verdict_takes_six_numbers_for_each_step_of_a_run(settings):
    """Four are kept (whitened errors and NEES), one is on the way; the whole-array copies of before took 15."""
    assert numbers_a_cell(lambda given: judge(given, settings)) < 6.5


def test_a_summary_of_runs_takes_hardly_any():
    nees = np.random.default_rng(0).chisquare(3, (4200, STEPS))
    assert (
        numbers_a_cell(
            lambda g: summary(nees[: len(np.asarray(g.innovations.nis))], 3, g.errors.error, g.errors.covariance)
        )
        < 0.5
    )


def test_errors_about_their_mean():
    """With variances 1, 2, 3 alone the NEES about the mean has a closed form."""
    given = evidence(30, 8)
    P = np.tile(np.diag([1.0, 2.0, 3.0]), (30, 8, 1, 1))
    sample = sample_of(changed(given, covariance=P), Settings())
    about = (given.errors.error - given.errors.error.mean(axis=0)) * np.sqrt(30 / 29)
    nees = (np.square(about) / [1.0, 2.0, 3.0]).sum(axis=-1)
    assert_allclose(sample.centred_means(slice(2, None)), nees[:, 2:].mean(axis=1) / 3)
    centred = sample.centred()
    assert_allclose(centred.nees, nees)
    assert_allclose(centred.group_means([1]), (np.square(about[..., 1]) / 2.0).mean(axis=1))


@pytest.mark.parametrize("n", range(1, 12))
def test_lengths_and_missing_components(n):
    w = np.random.default_rng(0).standard_normal((6, 7, n))
    assert_array_equal(squared_length(w), np.square(w).sum(axis=-1))
    w[2, 3, n - 1] = np.inf
    assert_array_equal(all_finite(w), np.isfinite(w).all(axis=-1))


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Results of 20 and of 4000 runs of 150 steps with maps, the same few runs again and again."""
    out = tmp_path_factory.mktemp("many")
    scenario = cs.load_scenario("herath2007-stereo").variant("many", truth__steps=150)
    few = cs.run_trials(scenario, ["ekf-uvd"], runs=20, seed=1, jobs=1)
    few.write(out / "few")
    tables = {name: _again(getattr(few, name), RUNS // 20) for name in ("estimates", "truth", "map")}
    manifest = few.manifest | {"runs": RUNS}
    cs.Results(tables["estimates"], few.failures, tables["truth"], few.landmarks, manifest, tables["map"]).write(
        out / "many"
    )
    return out / "few", out / "many"


def _again(table, times):
    parts = [table.assign(run=table["run"] + 20 * k) for k in range(times)]
    return pd.concat(parts, ignore_index=True)


def test_a_filter_read_in_parts_is_judged_as_in_whole(folders):
    results = open_results(folders[0])
    whole = {name: judge(record_of(results, name)) for name in results.filters}
    assert whole["ekf-uvd"].map is not None
    assert render(document(analyse(results))) == render(document(whole))


MEASURE = """
import sys
from pathlib import Path
{work}
def most():  # of this program: ru_maxrss is that of the parent, too
    return 1024 * int(Path("/proc/self/status").read_text().split("VmHWM:")[1].split()[0])
few, many = map(Path, sys.argv[1:])
work(few)
before = most()
work(many)
print(most() - before)
"""
READ = "from consistency.bench.store.results import open_results\n"
WORK = {
    "analyse": READ
    + "from consistency.bench.runs.results_to_records import analyse\nwork = lambda f: analyse(open_results(f))",
    "report": "from consistency.bench.pages.results_report import build_report as work",
    "baseline": "from consistency.referee.verdicts.compare_sources import baseline\n"
    + "from consistency.bench.runs.results_to_records import results_source\n"
    + "work = lambda f: baseline(results_source(f), str(f))",
}


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="reads the memory from /proc")
@pytest.mark.parametrize("name, most", [("analyse", 40), ("report", 40), ("baseline", 45)])
def test_a_filter_is_read_and_judged_in_bounded_memory(folders, name, most):
    """Twelve numbers a cell are read, five are worked out; allocators keep about as much again of so little.

    With whole tables or whole-array copies it was 49, 49 and 77.
    """
    command = [sys.executable, "-c", MEASURE.format(work=WORK[name]), *map(str, folders)]
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=os.environ | {"PYTHONHASHSEED": "0"})
    grown = int(done.stdout) / (RUNS * 150 * 8)
    assert grown < most
