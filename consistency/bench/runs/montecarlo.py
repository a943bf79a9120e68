"""Monte Carlo studies: filters on trials, in parallel, with the same bits for any number of workers."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pandas as pd

from consistency.bench.filters.filter_declarations import name_of, own_errors
from consistency.bench.filters.resolve_filters import resolve_filters
from consistency.bench.protocols import Filter
from consistency.bench.runs.executor_batches import ExecutorWorkers
from consistency.bench.runs.isolation.filter_process import Isolation
from consistency.bench.runs.local_workers import LocalThreads
from consistency.bench.runs.resume_results import PLAN, gathered_in
from consistency.bench.runs.rounds_of_runs import Interrupted as Interrupted
from consistency.bench.runs.rounds_of_runs import StudyRounds
from consistency.bench.runs.trial_work import Recorded, Simulated, TrialWork, Workers
from consistency.bench.scenario import Scenario, load_scenario
from consistency.bench.simulation import draw_landmarks, require_landmarks_in_view
from consistency.bench.store.journal import Journal
from consistency.bench.store.recorded_log import Log, require_format, write_log
from consistency.bench.store.results import Results, StoredResults, Tables
from consistency.referee.errors import InputError
from consistency.referee.system.folders import require_free
from consistency.referee.system.provenance import manifest_of


def run_trials(
    scenario: Scenario | str | Path,
    filters: str | Filter | Sequence[str | Filter],
    runs: int = 50,
    seed: int = 0,
    jobs: int = -1,
    timeout: float | None = None,
    previous: Tables | None = None,
    out: str | Path | None = None,
    overwrite: bool = False,
    resume: bool = False,
    memory: float | None = None,
    executor: Executor | None = None,
) -> Results | StoredResults:
    """Simulate ``runs`` trials of ``scenario`` and put each through every filter.

    Parameters
    ----------
    scenario : a scenario, its name or file
    filters : names of built-in filters, or objects with ``init``, ``predict``, ``update`` and ``pose``; or a single one
    seed : the results are a function of (scenario, filter, seed, run) alone
    jobs : workers; -1 for one per core. Compiled filters share threads, each other filter has processes of its own.
        An ``executor`` has workers of its own
    timeout : seconds per trial, after which the process of a filter that is not compiled is killed
    previous : results of the same scenario, filters and seed to continue from; its runs are not done again
    out : folder for the results, which appears as a whole at the end. Finished runs are kept in a journal beside it
        as they come, so that memory does not grow with the runs, and none is lost, whatever ends the process
    overwrite : replace ``out``, where it is an output folder of this bench, and drop unfinished work on it; that of
        ``previous`` is replaced anyway
    resume : continue from the runs in ``out`` and in its journal
    memory : GiB that a filter that is not compiled may allocate in a trial; Linux only
    executor : any executor of :mod:`concurrent.futures` that does the runs, in place of ``jobs`` threads of this
        process; it is not shut down. Work is sent to it as bytes, in batches of about 1.5 s or of its own
        ``batch_seconds``, of which it has at most 1000, or its own ``at_a_time``. A run that its worker does not
        survive has failed, if it was done alone

    Returns
    -------
    Results in memory; with ``out`` those in the folder, which are read on demand

    Raises
    ------
    InputError
        An unknown filter, one that does not fit the sensor, a number out of range, nothing in view, or a folder that
        cannot be written, holds unfinished work, or is worked on by another process.
    Interrupted
        Ctrl-C, which is answered when the trials in progress have ended; carries the finished runs. With ``out`` it
        is a plain KeyboardInterrupt, and the journal has them. SIGTERM and SIGHUP end the process.
    """
    require_counts(runs, seed)
    with studied(
        scenario, filters, seed, workers_for(jobs, executor), timeout, memory, out=out, previous=previous,
        resume=resume, overwrite=overwrite,
    ) as study_rounds:  # fmt: skip
        study_rounds.gathered.require_more(runs)
        return study_rounds.finish([range(runs)])


def run_log(
    log: Log,
    filters: str | Filter | Sequence[str | Filter],
    jobs: int = -1,
    timeout: float | None = None,
    memory: float | None = None,
    executor: Executor | None = None,
    out: str | Path | None = None,
    resume: bool = False,
    overwrite: bool = False,
) -> Results | StoredResults:
    """Put every run of a recorded log through every filter.

    Parameters and exceptions are those of :func:`run_trials`. A resume is refused if a file of the log or its screening
    has changed.
    """
    instances = resolve_filters(filters, log.belief, log.name)
    trials = {trial.run: trial for trial in log.trials}
    work = TrialWork(Recorded(trials), Isolation(instances, log.belief, timeout, memory))
    own = {"log_sha256": log.sha256} | ({"screening": log.screening} if log.screening else {})
    fields = {"seed": None, "log": log.name, "belief": log.belief.model_dump(mode="json")} | own
    place = None if out is None else Path(out)
    with gathered_in(_known(instances) | own, place, None, resume, overwrite) as gathered:
        return StudyRounds(workers_for(jobs, executor), work, gathered, fields, log.landmarks).finish([sorted(trials)])


def workers_for(jobs: int, executor: Executor | None) -> Workers:
    """Those of the executor, or threads of this process where there is none."""
    return LocalThreads(jobs) if executor is None else ExecutorWorkers(executor)


@contextmanager
def studied(
    scenario: Scenario | str | Path,
    filters: str | Filter | Sequence[str | Filter],
    seed: int,
    workers: Workers,
    timeout: float | None,
    memory: float | None,
    *,
    out: str | Path | None,
    previous: Tables | None,
    resume: bool,
    overwrite: bool,
    plan: Mapping[str, Any] | None = None,
    journal: Journal | None = None,
) -> Iterator[StudyRounds]:
    """Runs of a scenario, continued from earlier ones; see :func:`run_trials`, which raises the same exceptions.

    Parameters
    ----------
    plan : by which the number of runs is found
    journal : in place of ``out``: what keeps the finished runs, and may hold some; the caller knows that they are of
        this study
    """
    scenario = load_scenario(scenario)
    instances = resolve_filters(filters, scenario.belief)
    work = TrialWork(Simulated(scenario, seed), Isolation(instances, scenario.belief, timeout, memory))
    planned = {} if plan is None else {PLAN: dict(plan)}
    known = _known(instances) | {"scenario_hash": scenario.hash, "seed": seed} | planned
    fields = {"seed": seed} | _scenario_entry(scenario) | planned
    place = None if out is None else Path(out)
    with gathered_in(known, place, previous, resume, overwrite, journal) as gathered:
        yield StudyRounds(workers, work, gathered, fields, _landmarks_table(scenario))


def _known(filters: Sequence[Filter]) -> dict[str, Any]:
    """What a resume must have in common, of the filters."""
    return {"filters": [name_of(f) for f in filters], "error": own_errors(filters)}


def simulate_log(
    scenario: Scenario, runs: int, seed: int, out: Path, overwrite: bool = False, form: str = "parquet"
) -> None:
    """Write ``runs`` simulated trials as a log folder, in Parquet or as CSV; raises as :func:`run_trials`."""
    require_counts(runs, seed)
    require_format(form)
    world = require_landmarks_in_view(scenario)
    require_free(out, overwrite, "log")
    started = time.monotonic()
    trials = [world.trial(run, seed) for run in range(runs)]
    manifest = manifest_of(kind="log", seed=seed, runs=runs, wall=time.monotonic() - started, complete=True)
    manifest |= _scenario_entry(scenario) | {"failures": 0}
    sensor = scenario.truth.sensor
    view = None if sensor.image is None else (sensor.image, sensor.centre)
    write_log(out, trials, scenario.belief, _landmarks_table(scenario), manifest, overwrite, view, form=form)


def require_counts(runs: int, seed: int) -> None:
    """Refuse a number of runs, or a seed, out of its range."""
    if runs < 1:
        raise InputError(f"runs must be at least 1, got {runs}")
    if seed < 0:
        raise InputError(f"seed must not be negative, got {seed}")


def _scenario_entry(scenario: Scenario) -> dict[str, Any]:
    return {"scenario": scenario.model_dump(mode="json"), "scenario_hash": scenario.hash}


def _landmarks_table(scenario: Scenario) -> pd.DataFrame:
    table = pd.DataFrame(draw_landmarks(scenario.truth), columns=["x", "y", "z"])
    table.insert(0, "landmark", range(len(table)))
    return table
