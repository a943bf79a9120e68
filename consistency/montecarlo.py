"""How many times: trials through filters, in parallel, with the same bits whatever the number of workers."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import joblib
import numpy as np
import pandas as pd
from threadpoolctl import threadpool_limits

from consistency.errors import InputError
from consistency.filters import filter_names, get_filter
from consistency.filters.compiled import Compiled
from consistency.filters.stepping import name_of, run_filter
from consistency.log import Log, write_log
from consistency.progress import progress
from consistency.protocols import Filter
from consistency.results import Results, estimates_table, failures_table, truth_table
from consistency.scenario import Belief, Scenario
from consistency.simulation import draw_landmarks, require_landmarks_in_view, simulate
from consistency.storage import manifest_of, require_free
from consistency.types import Estimates, Trial

Outcome = tuple[Trial, list[Estimates]]


class Interrupted(KeyboardInterrupt):
    """Ctrl-C in :func:`run_trials`; ``results`` holds the runs that were finished."""

    def __init__(self, results: Results) -> None:
        super().__init__("interrupted")
        self.results = results


def run_trials(
    scenario: Scenario,
    filters: Sequence[str | Filter],
    runs: int = 50,
    seed: int = 0,
    jobs: int = -1,
    timeout: float | None = None,
    previous: Results | None = None,
) -> Results:
    """Simulate ``runs`` trials of ``scenario`` and put each through every filter.

    Parameters
    ----------
    filters : names of built-in filters, or objects with ``init``, ``predict``, ``update`` and ``pose``
    seed : the results are a function of (scenario, filter, seed, run) alone
    jobs : workers; -1 for one a core. Compiled filters share threads, others get processes.
    timeout : seconds a trial, for filters that are not compiled
    previous : results of the same scenario, filters and seed to go on from; its runs are not done again

    Raises
    ------
    InputError
        An unknown filter, one that does not fit the sensor, a number out of range, or nothing in view.
    Interrupted
        Ctrl-C; carries what is finished.
    """
    chosen = resolve_filters(filters, scenario.belief)
    _require_counts(runs, seed)
    require_landmarks_in_view(scenario)
    names = [name_of(f) for f in chosen]
    done = set() if previous is None else _same_study(previous, scenario, names, seed).finished_runs(names)
    if done and max(done) >= runs:
        raise InputError(f"runs must be at least {max(done) + 1}: so many are there already, got {runs}")
    todo = [run for run in range(runs) if run not in done]
    outcomes, wall, complete = _map(
        lambda run: simulate(scenario, run, seed), todo, chosen, scenario.belief, jobs, timeout
    )
    results = _gather(outcomes, chosen, previous)
    manifest = manifest_of(seed=seed, runs=runs, filters=names, wall=wall, complete=complete)
    return _finish(results, manifest | _scenario_entry(scenario), _landmarks_table(scenario))


def run_log(log: Log, filters: Sequence[str | Filter], jobs: int = -1, timeout: float | None = None) -> Results:
    """Put every run of a recorded log through every filter; raises as :func:`run_trials`."""
    chosen = resolve_filters(filters, log.belief)
    trials = {trial.run: trial for trial in log.trials}
    outcomes, wall, complete = _map(trials.__getitem__, list(trials), chosen, log.belief, jobs, timeout)
    results = _gather(outcomes, chosen, None)
    manifest = manifest_of(
        seed=None, runs=len(trials), filters=[name_of(f) for f in chosen], wall=wall, complete=complete
    )
    manifest |= {"log": log.name, "log_sha256": log.sha256, "belief": log.belief.model_dump(mode="json")}
    return _finish(results, manifest, log.landmarks)


def resolve_filters(filters: Sequence[str | Filter], belief: Belief) -> list[Filter]:
    """Filters by name or as they are, checked against the sensor."""
    chosen = [get_filter(f) if isinstance(f, str) else f for f in filters]
    if not chosen:
        raise InputError(f"no filter given; known: {', '.join(filter_names())}")
    for filter_ in chosen:
        if isinstance(filter_, type) or not isinstance(filter_, Filter):
            hint = (
                "give an object of it, with ()" if isinstance(filter_, type) else "it needs init, predict, update, pose"
            )
            raise InputError(f"{filter_!r} is no filter: {hint}")
    names = [name_of(f) for f in chosen]
    if len(set(names)) < len(names):
        raise InputError(f"a filter is given twice: {', '.join(sorted({n for n in names if names.count(n) > 1}))}")
    model = belief.sensor.model
    for filter_ in chosen:
        sensors = getattr(filter_, "sensors", None)
        if sensors is not None and model not in sensors:
            fitting = [name for name in filter_names() if model in get_filter(name).sensors]
            raise InputError(
                f"filter '{name_of(filter_)}' works on a sensor {' or '.join(sensors)}, not '{model}'; "
                f"filters that fit: {', '.join(fitting)}"
            )
    return chosen


def _one(trial: Trial, filters: list[Filter], belief: Belief, timeout: float | None) -> Outcome:
    estimates = [run_filter(f, trial, belief, timeout) for f in filters]
    # the observations are most of a trial, and no table of results needs them
    none = np.zeros(0, np.int64)
    return replace(trial, first=np.zeros_like(trial.first), landmark=none, z=np.zeros((0, 3))), estimates


def _map(
    make_trial: Callable[[int], Trial],
    runs: list[int],
    filters: list[Filter],
    belief: Belief,
    jobs: int,
    timeout: float | None,
) -> tuple[list[Outcome], float, bool]:
    """Outcomes in order of the runs, wall time in s, and whether all were finished."""
    if jobs == 0 or jobs < -1:
        raise InputError(f"jobs must be at least 1, or -1 for one worker a core, got {jobs}")
    if timeout is not None and not timeout > 0:
        raise InputError(f"timeout must be positive, got {timeout}")
    for filter_ in filters if runs else []:
        if isinstance(filter_, Compiled) and not filter_.is_compiled:
            with progress(f"compiling {name_of(filter_)} (once on this machine)", 1, "kernels") as advance:
                filter_.run(_head(make_trial(runs[0])), belief)
                advance(1)
    # kernels release the GIL; filters in Python need processes. One BLAS thread each: bits depend on it
    threads = all(isinstance(f, Compiled) for f in filters)
    workers = {"backend": "threading"} if threads else {"backend": "loky", "inner_max_num_threads": 1}
    n_jobs = min(jobs, max(len(runs), 1)) if jobs > 0 else jobs
    started = time.monotonic()
    outcomes: list[Outcome] = []
    complete = True
    try:
        with (
            threadpool_limits(1),
            joblib.parallel_config(**workers, n_jobs=n_jobs),
            progress("runs", len(runs)) as advance,
        ):
            parallel = joblib.Parallel(return_as="generator_unordered")
            tasks: Iterable[Any] = (joblib.delayed(_one)(make_trial(run), filters, belief, timeout) for run in runs)
            for outcome in parallel(tasks):
                outcomes.append(outcome)
                advance(1)
    except KeyboardInterrupt:
        complete = False
    return sorted(outcomes, key=lambda outcome: outcome[0].run), time.monotonic() - started, complete


def _head(trial: Trial) -> Trial:
    """The first two steps of a trial: enough to compile on."""
    last = trial.first[min(2, trial.steps)]
    return Trial(
        trial.run, trial.start, trial.controls[:2], trial.first[:3], trial.landmark[:last], trial.z[:last],
        trial.n_landmarks, None, trial.landmarks,
    )  # fmt: skip


def _gather(outcomes: list[Outcome], filters: list[Filter], previous: Results | None) -> dict[str, pd.DataFrame]:
    """Tables in order of the filters, then of the runs, as ``outcomes`` are."""
    tables = {
        "estimates": estimates_table(outcomes),
        "truth": truth_table([trial for trial, _ in outcomes]),
        "failures": failures_table(
            [each.failure for said in zip(*(e for _, e in outcomes), strict=True) for each in said if each.failure]
        ),
    }
    if previous is None:
        return tables
    rank = {name_of(f): i for i, f in enumerate(filters)}
    for name, before in (("estimates", previous.estimates), ("truth", previous.truth), ("failures", previous.failures)):
        both = pd.concat([t for t in (before, tables[name]) if t is not None and len(t)] or [tables[name]])
        if name != "truth":
            both = both.assign(_rank=both["filter"].map(rank)).sort_values(["_rank", "run", "step"])
        tables[name] = both.drop(columns="_rank", errors="ignore").reset_index(drop=True)
    tables["truth"] = tables["truth"].sort_values(["run", "step"], ignore_index=True)
    return tables


def _finish(tables: dict[str, pd.DataFrame], manifest: dict[str, Any], landmarks: pd.DataFrame | None) -> Results:
    manifest["failures"] = len(tables["failures"])
    truth = tables["truth"] if len(tables["truth"]) else None
    results = Results(tables["estimates"], tables["failures"], truth, landmarks, manifest)
    if not manifest["complete"]:
        manifest["finished_runs"] = len(results.finished_runs(manifest["filters"]))
        raise Interrupted(results)
    return results


def _same_study(previous: Results, scenario: Scenario, names: list[str], seed: int) -> Results:
    """The results to go on from, refused unless scenario, filters and seed are the same."""
    for key, now, before in (
        ("scenario", scenario.hash, previous.manifest.get("scenario_hash")),
        ("filter", names, previous.manifest.get("filters")),
        ("seed", seed, previous.manifest.get("seed")),
    ):
        if now != before:
            raise InputError(f"the results to resume have another {key}; use the same command as before")
    return previous


def simulate_log(scenario: Scenario, runs: int, seed: int, out: Path, overwrite: bool = False) -> None:
    """Write ``runs`` simulated trials as a log folder; raises as :func:`run_trials`."""
    _require_counts(runs, seed)
    require_landmarks_in_view(scenario)
    require_free(out, overwrite, "log")
    started = time.monotonic()
    trials = [simulate(scenario, run, seed) for run in range(runs)]
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
