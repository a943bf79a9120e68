"""How many times: trials through filters, in parallel, with the same bits whatever the number of workers."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, overload

import joblib
import pandas as pd

from consistency.errors import InputError
from consistency.filters import filter_names, get_filter, usable_names
from consistency.filters.compiled import one_blas_thread
from consistency.filters.stepping import error_of, name_of, optimal_gain
from consistency.geometry.conventions import ADDITIVE
from consistency.protocols import Filter, WholeTrial
from consistency.runs.gather import Gathered
from consistency.runs.isolating import Isolation
from consistency.runs.resuming import place_for
from consistency.scenario import Belief, Scenario
from consistency.simulation import draw_landmarks, require_landmarks_in_view
from consistency.store.log import Log, write_log
from consistency.store.results import Outcome, Results, StoredResults, Tables, outcome_of
from consistency.store.stopping import stoppable
from consistency.store.storage import manifest_of, require_free
from consistency.terminal.progress import KERNELS, progress
from consistency.types import Trial

Outcomes = Generator[Outcome, None, None]
AHEAD = 8  # runs a worker that may be finished before an earlier one is


class Interrupted(KeyboardInterrupt):
    """Ctrl-C in :func:`run_trials`; ``results`` holds the runs that were finished, ``status`` is for the exit."""

    def __init__(self, results: Results | StoredResults, status: int = 130) -> None:
        super().__init__("interrupted")
        self.results, self.status = results, status


# fmt: off
@overload
def run_trials(
    scenario: Scenario, filters: Sequence[str | Filter], runs: int = ..., seed: int = ..., jobs: int = ...,
    timeout: float | None = ..., previous: Tables | None = ..., out: None = ..., overwrite: bool = ...,
    resume: bool = ..., memory: float | None = ...,
) -> Results: ...
@overload
def run_trials(
    scenario: Scenario, filters: Sequence[str | Filter], runs: int = ..., seed: int = ..., jobs: int = ...,
    timeout: float | None = ..., previous: Tables | None = ..., *, out: str | Path, overwrite: bool = ...,
    resume: bool = ..., memory: float | None = ...,
) -> StoredResults: ...
# fmt: on
def run_trials(
    scenario: Scenario,
    filters: Sequence[str | Filter],
    runs: int = 50,
    seed: int = 0,
    jobs: int = -1,
    timeout: float | None = None,
    previous: Tables | None = None,
    out: str | Path | None = None,
    overwrite: bool = False,
    resume: bool = False,
    memory: float | None = None,
) -> Results | StoredResults:
    """Simulate ``runs`` trials of ``scenario`` and put each through every filter.

    Parameters
    ----------
    filters : names of built-in filters, or objects with ``init``, ``predict``, ``update`` and ``pose``
    seed : the results are a function of (scenario, filter, seed, run) alone
    jobs : workers; -1 for one a core. Compiled filters share threads, each other filter has processes of its own.
    timeout : seconds a trial, after which the process of a filter that is not compiled is killed
    previous : results of the same scenario, filters and seed to go on from; its runs are not done again
    out : folder for the results, which appears as a whole at the end. Finished runs are kept in a journal beside it
        as they come, so that memory does not grow with the runs, and none is lost, whatever ends the process
    overwrite : replace ``out``, where it is an output folder of this bench, and drop unfinished work on it; that of
        ``previous`` is replaced anyway
    resume : go on with what is in ``out`` and in its journal
    memory : GiB that a filter that is not compiled may allocate in a trial; Linux only

    Returns
    -------
    Results in memory; with ``out`` those in the folder, which are read when they are asked for

    Raises
    ------
    InputError
        An unknown filter, one that does not fit the sensor, a number out of range, nothing in view, or a folder that
        cannot be written, holds unfinished work, or is worked on by another process.
    Interrupted
        Ctrl-C, or a signal that is taken as such; carries what is finished, and the folder, if any, is written.
    """
    instances = resolve_filters(filters, scenario.belief)
    _require_counts(runs, seed)
    world = require_landmarks_in_view(scenario)
    names = [name_of(f) for f in instances]
    errors = _own_errors(instances)
    isolation = Isolation(instances, scenario.belief, timeout, memory)
    study = {"scenario_hash": scenario.hash, "filters": names, "error": errors, "seed": seed}
    with place_for(study, None if out is None else Path(out), previous, resume, overwrite) as place:
        done = place.finished
        if done and max(done) >= runs:
            raise InputError(f"runs must be at least {max(done) + 1}: so many are there already, got {runs}")
        todo = [run for run in range(runs) if run not in done]
        work = _Work(lambda run: world.trial(run, seed), isolation, jobs)
        manifest_fields = {"seed": seed, "runs": runs, "machines": place.machines} | _scenario_entry(scenario)
        gathered = Gathered(names, errors, place.new, place.journal, place.previous, place.kept)
        return _finish(work, todo, gathered, manifest_fields, _landmarks_table(scenario))


def run_log(
    log: Log,
    filters: Sequence[str | Filter],
    jobs: int = -1,
    timeout: float | None = None,
    memory: float | None = None,
) -> Results:
    """Put every run of a recorded log through every filter; raises as :func:`run_trials`."""
    instances = resolve_filters(filters, log.belief)
    trials = {trial.run: trial for trial in log.trials}
    work = _Work(trials.__getitem__, Isolation(instances, log.belief, timeout, memory), jobs)
    manifest_fields = {"seed": None, "runs": len(trials), "log": log.name, "log_sha256": log.sha256}
    manifest_fields |= {"belief": log.belief.model_dump(mode="json")}
    results = _finish(
        work,
        list(trials),
        Gathered([name_of(f) for f in instances], _own_errors(instances)),
        manifest_fields,
        log.landmarks,
    )
    assert isinstance(results, Results)
    return results


def resolve_filters(filters: Sequence[str | Filter], belief: Belief) -> list[Filter]:
    """Filters by name or as they are, checked against the sensor."""
    instances = [get_filter(f) if isinstance(f, str) else f for f in filters]
    if not instances:
        raise InputError(f"no filter given; known: {', '.join(filter_names())}")
    for filter_ in instances:
        if isinstance(filter_, type) or not isinstance(filter_, Filter):
            hint = (
                "give an object of it, with ()" if isinstance(filter_, type) else "it needs init, predict, update, pose"
            )
            raise InputError(f"{filter_!r} is no filter: {hint}")
    names = [name_of(f) for f in instances]
    if len(set(names)) < len(names):
        raise InputError(f"a filter is given twice: {', '.join(sorted({n for n in names if names.count(n) > 1}))}")
    model = belief.sensor.model
    for filter_ in instances:
        error_of(filter_)
        sensors = getattr(filter_, "sensors", None)
        if sensors is not None and model not in sensors:
            fitting = [name for name in usable_names() if model in getattr(get_filter(name), "sensors", (model,))]
            raise InputError(
                f"filter '{name_of(filter_)}' works on a sensor {' or '.join(sensors)}, not '{model}'; "
                f"filters that fit: {', '.join(fitting)}"
            )
    return instances


def worker_count(jobs: int) -> int:
    """Number of workers that ``jobs`` stands for: itself, or one a core for -1.

    Raises
    ------
    InputError
        Any other number.
    """
    if jobs == 0 or jobs < -1:
        raise InputError(f"jobs must be at least 1, or -1 for one worker a core, got {jobs}")
    return jobs if jobs > 0 else int(joblib.cpu_count())


def compile_for(filters: Sequence[Filter], trial: Trial, belief: Belief) -> None:
    """Compile what the filters need for ``trial`` and is not yet compiled, and say so."""
    for filter_ in filters:
        if isinstance(filter_, WholeTrial) and not filter_.is_ready(trial, belief):
            with progress(f"compiling {name_of(filter_)} (once on this machine)", 1, KERNELS) as advance:
                filter_.compile(trial, belief)
                advance(1)


# --- the work --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Work:
    """What is done for each run."""

    make_trial: Callable[[int], Trial]
    isolation: Isolation
    jobs: int

    def __post_init__(self) -> None:
        worker_count(self.jobs)

    def __call__(self, run: int) -> Outcome:
        return _one(self.make_trial(run), self.isolation)

    @property
    def filters(self) -> list[Filter]:
        return self.isolation.filters

    def compile(self, run: int) -> None:
        """Compile what a run needs and is not yet compiled, and say so."""
        compile_for(self.isolation.compiled, self.make_trial(run), self.isolation.belief)

    def outcomes(self, runs: list[int]) -> Outcomes:
        """In order of the runs, whoever does them; BLAS has one thread in each worker, for the bits depend on it."""
        workers = min(worker_count(self.jobs), len(runs))
        if workers > 1:
            yield from self._in_threads(runs, workers)
        else:
            with self.isolation:
                yield from (self(run) for run in runs)

    def _in_threads(self, runs: list[int], workers: int) -> Outcomes:
        """Kernels release the GIL, and who waits for a process does."""
        pool, waiting = ThreadPoolExecutor(workers), deque[Future[Outcome]]()
        try:
            with self.isolation:  # left first, so that no thread waits for a process that hangs
                for run in runs:
                    waiting.append(pool.submit(self, run))
                    if len(waiting) > AHEAD * workers:
                        yield waiting.popleft().result()
                while waiting:
                    yield waiting.popleft().result()
        finally:
            pool.shutdown(cancel_futures=True)


def _one(trial: Trial, isolation: Isolation) -> Outcome:
    return outcome_of(trial, isolation.run(trial))


def _finish(
    work: _Work, runs: list[int], gathered: Gathered, manifest_fields: dict[str, Any], landmarks: pd.DataFrame | None
) -> Results | StoredResults:
    """Do the runs and hand over the results, or, after Ctrl-C, what there is of them."""
    with stoppable() as stop:
        started, complete = time.monotonic(), True
        try:
            if runs:
                work.compile(runs[0])
                started = time.monotonic()
            with one_blas_thread(), closing(work.outcomes(runs)) as outcomes, progress("runs", len(runs)) as advance:
                for outcome in outcomes:
                    gathered.add(outcome)
                    advance(1)
                    if stop.number is not None:  # and whoever was called took it for an error of its own
                        raise KeyboardInterrupt
        except KeyboardInterrupt:
            complete = False
        except Exception:
            if stop.number is None:
                raise
            complete = False
        manifest_fields = manifest_fields | {"optimal_gain": [name_of(f) for f in work.filters if optimal_gain(f)]}
        manifest_fields |= {"error": gathered.errors} if gathered.errors else {}
        manifest = manifest_of(
            filters=gathered.filters, wall=time.monotonic() - started, complete=complete, **manifest_fields
        )
        if complete:
            return gathered.results(manifest, landmarks)
        results = gathered.results(manifest | {"finished_runs": len(gathered.finished)}, landmarks)
        raise Interrupted(results, stop.status)


def _own_errors(filters: Sequence[Filter]) -> dict[str, str]:
    """Convention of each filter's own error, of those where it is not the additive one."""
    errors = {name_of(f): error_of(f) for f in filters}
    return {name: error for name, error in errors.items() if error != ADDITIVE}


def simulate_log(scenario: Scenario, runs: int, seed: int, out: Path, overwrite: bool = False) -> None:
    """Write ``runs`` simulated trials as a log folder; raises as :func:`run_trials`."""
    _require_counts(runs, seed)
    world = require_landmarks_in_view(scenario)
    require_free(out, overwrite, "log")
    started = time.monotonic()
    trials = [world.trial(run, seed) for run in range(runs)]
    manifest = manifest_of(kind="log", seed=seed, runs=runs, wall=time.monotonic() - started, complete=True)
    manifest |= _scenario_entry(scenario) | {"failures": 0}
    sensor = scenario.truth.sensor
    view = None if sensor.image is None else (sensor.image, sensor.centre)
    write_log(out, trials, scenario.belief, _landmarks_table(scenario), manifest, overwrite, view)


def _require_counts(runs: int, seed: int) -> None:
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
