"""Monte Carlo studies: filters on trials, in parallel, with the same bits for any number of workers.

A study has a fixed number of runs, or ends when the verdict is clear.
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager
from itertools import count
from pathlib import Path
from typing import Any

import pandas as pd

from consistency.bench.filters.run_filter import resolve_filters
from consistency.bench.protocols import Filter, name_of, own_errors
from consistency.bench.runs.isolation import Isolation
from consistency.bench.runs.outcomes_to_results import PLAN, StudyRounds, gathered_in
from consistency.bench.runs.results_to_records import record_of
from consistency.bench.runs.run_outcome import Recorded, Simulated, TrialWork, Workers
from consistency.bench.runs.workers import ExecutorWorkers, LocalThreads
from consistency.bench.scenario import Scenario, load_scenario
from consistency.bench.simulation import draw_landmarks, require_landmarks_in_view
from consistency.bench.store.journal import Journal
from consistency.bench.store.recorded_log import Log, require_format, write_log
from consistency.bench.store.results import Results, StoredResults, Tables
from consistency.referee.column_names import POSE
from consistency.referee.defaults import DETECT, FALSE_ALARM, POWER
from consistency.referee.diagnostics.judge_record import looks, progress_text
from consistency.referee.diagnostics.planning import Design, sequential_design
from consistency.referee.diagnostics.record import Record
from consistency.referee.diagnostics.verdict import Verdict
from consistency.referee.errors import InputError
from consistency.referee.system import manifest_of, require_free, say
from consistency.referee.verdicts.judge_sources import refused


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


def run_until_decided(
    scenario: Scenario,
    filters: Sequence[str | Filter],
    *,
    detect: float = DETECT,
    false_alarm: float = FALSE_ALARM,
    power: float = POWER,
    max_runs: int | None = None,
    lost: float | None = None,
    seed: int = 0,
    jobs: int = -1,
    timeout: float | None = None,
    previous: Tables | None = None,
    memory: float | None = None,
    out: str | Path | None = None,
    resume: bool = False,
    overwrite: bool = False,
    executor: Executor | None = None,
    journal: Journal | None = None,
) -> tuple[Results | StoredResults, dict[str, Verdict]]:
    """Simulate and judge at the inspections of a :class:`Design` until every filter is decided.

    A filter is decided at the first inspection that finds a fault, or shows the ratio of true to stated covariance to
    lie in [1 / detect, detect] and, where ``lost`` is given, the share of lost runs to be that at most. This verdict is
    final, however many runs other filters take. With ``max_runs``, a filter still open after that many is undecided.
    Which runs are drawn does not depend on the looks.

    Parameters
    ----------
    seed, jobs, timeout, previous, memory, out, resume, overwrite, executor : as for :func:`run_trials`. A look then
        holds the arrays of one filter in memory, and nothing else grows with the runs.
    journal : in place of ``out``: what keeps the finished runs while the results stay in memory. It may hold runs of
        the same scenario, filters and seed.

    Returns
    -------
    Results of all runs, with the plan in their manifest, and the verdict of each filter at the look that decided it

    Raises
    ------
    InputError, Interrupted
        As :func:`run_trials`; a plan that cannot be, or is not that of the results to resume.
    """
    plan: dict[str, Any] = {
        "dof": len(POSE), "detect": detect, "false_alarm": false_alarm, "power": power, "max_runs": max_runs,
    }  # fmt: skip
    plan |= {} if lost is None else {"lost": lost}
    design, decided = plan_of(plan), dict[str, Verdict]()
    with studied(
        scenario, filters, seed, workers_for(jobs, executor), timeout, memory,
        out=out, previous=previous, resume=resume, overwrite=overwrite, plan=plan, journal=journal,
    ) as study_rounds:  # fmt: skip
        _require_less(study_rounds, max_runs)
        names = study_rounds.gathered.filters

        def read(runs: int, name: str) -> Record:
            return record_of(study_rounds.so_far(runs), name, scenario.truth.steps)

        results = study_rounds.finish(
            _runs_up_to_looks(study_rounds, looks(design, names, read, decided), decided, names)
        )
    return results, {name: decided[name] for name in names}


def _runs_up_to_looks(
    study_rounds: StudyRounds, counts: Iterator[int], decided: dict[str, Verdict], names: list[str]
) -> Iterator[range]:
    """Runs up to each look; says how it stands after those that were new."""
    is_new, runs = False, 0
    for runs_at_look in counts:
        if is_new:
            say(f"{runs} runs: {progress_text(decided, names)}")
        runs, is_new = runs_at_look, not study_rounds.gathered.finished.issuperset(range(runs_at_look))
        yield range(runs)
    if is_new:
        say(f"{runs} runs: {progress_text(decided, names)}")
    elif study_rounds.gathered.is_complete:
        done = len(study_rounds.gathered.finished)
        raise InputError(f"the {done} runs of the results to resume have decided every filter")


def _require_less(study_rounds: StudyRounds, max_runs: int | None) -> None:
    """Refuse results to which no run can be added."""
    finished_runs = study_rounds.gathered.finished
    runs = next(run for run in count() if run not in finished_runs)
    if max_runs is not None and (runs > max_runs or (runs == max_runs and study_rounds.gathered.is_complete)):
        raise InputError(f"the results to resume have {runs} runs; the plan looks for the last time at {max_runs}")


def plan_of(plan: dict[str, Any]) -> Design:
    """The design of a plan; raises InputError where it cannot be."""
    try:
        return sequential_design(**plan)
    except ValueError as error:
        raise refused(error) from None
