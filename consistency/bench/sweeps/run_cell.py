"""One filter in one cell: runs until decided, what they said, and what a step costs."""

from __future__ import annotations

import time
import warnings
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, fields
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from consistency.bench.filters import get_filter
from consistency.bench.filters.compiled import Compiled, one_blas_thread
from consistency.bench.filters.run_filter import run_filter
from consistency.bench.protocols import Filter
from consistency.bench.runs.isolation.filter_process import Isolation
from consistency.bench.runs.missing_kernels import compile_all
from consistency.bench.runs.results_to_records import record_of
from consistency.bench.runs.run_until_decided import run_until_decided
from consistency.bench.runs.scores_by_run import mean_nees_of_runs
from consistency.bench.scenario import Scenario
from consistency.bench.simulation import simulate
from consistency.bench.sweeps.sweep_file import Cell, Sweep
from consistency.bench.types import Trial
from consistency.referee.diagnostics.records.record import Record
from consistency.referee.diagnostics.verdict.verdict import Verdict
from consistency.referee.system.progress import quiet

TIMED = 3  # times that a trial is timed, of which the least counts, and trials that are tried
SLOW = 1.0  # s, a trial that takes longer is timed once
PATIENCE = 60.0  # s, a trial of a filter that is not compiled is not timed if it takes longer
RUN_COLUMNS = ("run", "nees", "rmse_position", "rmse_heading", "failed_at", "reason")


@dataclass(frozen=True)
class CellResult:
    """What a filter's runs in a cell said; NaN where there is nothing to say."""

    status: str  # as that of a verdict; failed also where the cell raised
    diagnosis: str
    runs: int
    failures: int  # runs that failed
    anees: float
    anees_low: float  # interval without a fault
    anees_high: float
    ratio: float  # of true to stated covariance
    ratio_low: float  # 95 % interval
    ratio_high: float
    rmse_position: float  # m
    rmse_heading: float  # rad
    cost: float  # CPU time of a step, that of the reference being 1
    step_us: float  # CPU time of a step in microseconds, on the machine that did it


NUMBERS = tuple(f.name for f in fields(CellResult) if f.type == "float")


class CellOutcome(NamedTuple):
    """Result of one filter in one cell, with a row for each of its runs."""

    result: CellResult
    runs: pd.DataFrame  # RUN_COLUMNS


def run_cell(sweep: Sweep, cell: Cell, filter_name: str, **how: Any) -> CellOutcome:
    """Run one filter in one cell until it is decided.

    The trials depend on the sweep's seed and the cell's scenario alone. An exception is a result, too: the filter has
    failed there; but not what the system refuses.

    Parameters
    ----------
    how : who does the runs and what keeps them, as for :func:`run_until_decided`

    Raises
    ------
    OSError, InputError with an OSError as its cause
        No space left, no process can be started, a connection is lost.
    """
    rule, seed = sweep.rule.model_dump(), sweep.seed_of(cell)
    try:
        with quiet():
            results, verdicts = run_until_decided(cell.scenario, [filter_name], **rule, seed=seed, **how)
        verdict, record = verdicts[filter_name], record_of(results, filter_name)
    except Exception as error:  # what breaks one cell must not end a night of others
        if isinstance(error, OSError) or isinstance(error.__cause__, OSError):  # it would break all of them
            raise
        failed = CellResult("failed", f"failed: {type(error).__name__}: {error}", 0, 0, *[np.nan] * len(NUMBERS))
        return CellOutcome(failed, pd.DataFrame(columns=list(RUN_COLUMNS)))
    try:
        cost, step_us = cost_of(filter_name, sweep.reference, cell.scenario, seed)
    except Exception:  # the verdict stands without it
        cost, step_us = np.nan, np.nan
    return CellOutcome(result_of(verdict, cost, step_us), runs_table(record))


def result_of(verdict: Verdict, cost: float, step_us: float) -> CellResult:
    """The numbers of a verdict that a map keeps."""
    accuracy = verdict.in_world.accuracy
    rmse_position, rmse_heading = np.nan, np.nan
    if accuracy is not None:
        rmse_position, rmse_heading = float(accuracy.rmse_position), float(accuracy.rmse_heading)
    low, high = verdict.threshold
    ratio_low, ratio_high = verdict.inflation_interval
    return CellResult(
        status=verdict.status,
        diagnosis=verdict.reasons[0],
        runs=verdict.runs,
        failures=len({failure.run for failure in verdict.failures}),
        anees=float(verdict.statistic),
        anees_low=float(low),
        anees_high=float(high),
        ratio=float(verdict.inflation),
        ratio_low=float(ratio_low),
        ratio_high=float(ratio_high),
        rmse_position=rmse_position,
        rmse_heading=rmse_heading,
        cost=cost,
        step_us=step_us,
    )


def runs_table(record: Record) -> pd.DataFrame:
    """A row for each run: mean NEES, RMSE of position (m) and heading (rad) in judged steps, and failure."""
    error, runs = record.in_world.error, record.run_numbers
    assert error is not None
    assert record.nees is not None
    squared_errors = np.where(np.isfinite(record.nees)[..., None], error**2, np.nan)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Mean of empty slice")  # a run without an estimate
        mean_squares = np.nanmean(squared_errors, axis=1)
    failed = {failure.run: failure for failure in record.failures}
    failed_steps = [failed[run].step if run in failed else None for run in runs]
    reasons = [failed[run].reason if run in failed else None for run in runs]
    position, heading = np.sqrt(mean_squares[:, 0] + mean_squares[:, 1]), np.sqrt(mean_squares[:, 2])
    columns = (runs, mean_nees_of_runs(record), position, heading, pd.array(failed_steps, "Int64"), reasons)
    return pd.DataFrame(dict(zip(RUN_COLUMNS, columns, strict=True)))


# --- what a step costs ------------------------------------------------------------------------------


def cost_of(filter_name: str, reference: str, scenario: Scenario, seed: int) -> tuple[float, float]:
    """CPU time of a step against that of the reference, and in microseconds.

    Both take the same trial by turns, in one thread with one BLAS thread, and each counts with its fastest: other work
    on the machine then matters little. The trial is the first of three that neither fails; NaN where there is none.
    """
    filters = [get_filter(name) for name in dict.fromkeys((filter_name, reference))]
    for run in range(TIMED):
        seconds = _fastest(filters, simulate(scenario, run, seed), scenario)
        if np.isfinite(seconds).all():
            return seconds[0] / seconds[-1], 1e6 * seconds[0] / scenario.truth.steps
    return np.nan, np.nan


def _fastest(filters: list[Filter], trial: Trial, scenario: Scenario) -> list[float]:
    """Seconds that each filter takes at best; infinite where it fails, which is tried where it can do no harm."""
    belief = scenario.belief
    if not_compiled := [filter_ for filter_ in filters if not isinstance(filter_, Compiled)]:
        with Isolation(not_compiled, belief, PATIENCE) as isolation:
            if any(estimates.failure for estimates in isolation.run(trial)):
                return [np.inf] * len(filters)
    compile_all((filter_, trial, belief) for filter_ in filters)
    fastest_seconds = [np.inf] * len(filters)
    # a thread of its own, in which a kernel runs, too: from the main thread it would run in another one
    with one_blas_thread(), ThreadPoolExecutor(1) as thread:
        for _ in range(TIMED):
            for i, filter_ in enumerate(filters):
                seconds = thread.submit(_cpu_time, filter_, trial, scenario).result()
                fastest_seconds[i] = min(fastest_seconds[i], seconds)
            if sum(fastest_seconds) > SLOW:
                break
    return fastest_seconds


def _cpu_time(filter_: Filter, trial: Trial, scenario: Scenario) -> float:
    """Seconds of this thread that a trial takes; infinite where the run fails."""
    started = time.thread_time()
    estimates = run_filter(filter_, trial, scenario.belief)
    spent = time.thread_time() - started
    return np.inf if estimates.failure is not None else spent


def plain_numbers(result: CellResult) -> dict[str, Any]:
    """Fields by name, for JSON: five digits of every number, text for an infinite one and null for NaN."""
    data = asdict(result)
    for name in NUMBERS:
        value = data[name]
        if np.isnan(value):
            data[name] = None
        elif np.isinf(value):
            data[name] = str(float(value))
        else:
            data[name] = float(f"{value:.5g}")
    return data


def result_from(numbers: Mapping[str, Any]) -> CellResult:
    """The result that :func:`plain_numbers` gave; raises ValueError where a field is missing, unknown or no number."""
    if not isinstance(numbers, Mapping) or set(numbers) != {f.name for f in fields(CellResult)}:
        raise ValueError("the fields are not those of a cell's result")
    result_fields = dict(numbers)
    for name in NUMBERS:
        value = result_fields[name]
        if value is None:
            result_fields[name] = np.nan
        elif isinstance(value, (int, float, str)):
            result_fields[name] = float(value)
        else:
            raise ValueError(f"'{name}' is not a number")
    return CellResult(**result_fields)
