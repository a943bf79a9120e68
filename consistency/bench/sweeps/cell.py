"""One filter in one cell: runs until decided, what they said, and what a step costs."""

from __future__ import annotations

import threading
import time
import warnings
from collections.abc import Mapping
from concurrent.futures import Executor
from dataclasses import asdict, dataclass, fields
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from consistency.bench.filters import get_filter
from consistency.bench.filters.compiled import Compiled, one_blas_thread
from consistency.bench.filters.stepping import run_filter
from consistency.bench.protocols import Filter, WholeTrial
from consistency.bench.runs.isolation.filter_process import Isolation
from consistency.bench.runs.results_to_records import record_of
from consistency.bench.runs.run_scores import run_means
from consistency.bench.runs.sequential import run_until_decided
from consistency.bench.scenario import Scenario
from consistency.bench.simulation import simulate
from consistency.bench.store.journal import Journal
from consistency.bench.sweeps.plan import Cell, Sweep
from consistency.bench.types import Trial
from consistency.referee.diagnostics import Record, Verdict
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
    result: CellResult
    runs: pd.DataFrame  # RUN_COLUMNS


def run_cell(
    sweep: Sweep,
    cell: Cell,
    filter_name: str,
    jobs: int = -1,
    executor: Executor | None = None,
    journal: Journal | None = None,
) -> CellOutcome:
    """Run one filter in one cell until it is decided.

    The trials depend on the sweep's seed and the cell's scenario alone. An exception is a result, too: the filter has
    failed there; but not what the system refuses.

    Parameters
    ----------
    journal : where finished runs are kept; what is in it is of the same cell

    Raises
    ------
    OSError, InputError with an OSError as its cause
        No space left, no process can be started, a connection is lost.
    """
    try:
        with quiet():
            results, verdicts = run_until_decided(
                cell.scenario, [filter_name], **sweep.rule.model_dump(), seed=sweep.seed_of(cell), jobs=jobs,
                executor=executor, journal=journal,
            )  # fmt: skip
        verdict, found = verdicts[filter_name], record_of(results, filter_name)
    except Exception as error:  # what breaks one cell must not end a night of others
        if isinstance(error, OSError) or isinstance(error.__cause__, OSError):  # it would break all of them
            raise
        failed = CellResult("failed", f"failed: {type(error).__name__}: {error}", 0, 0, *[np.nan] * len(NUMBERS))
        return CellOutcome(failed, pd.DataFrame(columns=list(RUN_COLUMNS)))
    try:
        cost, step_us = cost_of(filter_name, sweep.reference, cell.scenario, sweep.seed_of(cell))
    except Exception:  # the verdict stands without it
        cost, step_us = np.nan, np.nan
    return CellOutcome(result_of(verdict, cost, step_us), runs_table(found))


def result_of(verdict: Verdict, cost: float, step_us: float) -> CellResult:
    """The numbers of a verdict that a map keeps."""
    accuracy = verdict.in_world.accuracy
    low, high = verdict.threshold
    return CellResult(
        status=verdict.status, diagnosis=verdict.reasons[0], runs=verdict.runs,
        failures=len({failure.run for failure in verdict.failures}),
        anees=float(verdict.statistic), anees_low=float(low), anees_high=float(high), ratio=float(verdict.inflation),
        ratio_low=float(verdict.inflation_interval[0]), ratio_high=float(verdict.inflation_interval[1]),
        rmse_position=np.nan if accuracy is None else float(accuracy.rmse_position),
        rmse_heading=np.nan if accuracy is None else float(accuracy.rmse_heading), cost=cost, step_us=step_us,
    )  # fmt: skip


def runs_table(found: Record) -> pd.DataFrame:
    """A row for each run: mean NEES, RMSE of position (m) and heading (rad) in judged steps, and failure."""
    error, runs = found.in_world.error, found.run_numbers
    assert error is not None
    assert found.nees is not None
    failed = {failure.run: failure for failure in found.failures}
    square = np.where(np.isfinite(found.nees)[..., None], error**2, np.nan)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Mean of empty slice")  # a run without an estimate
        mean = np.nanmean(square, axis=1)
    steps = [failed[run].step if run in failed else None for run in runs]
    reasons = [failed[run].reason if run in failed else None for run in runs]
    position = np.sqrt(mean[:, 0] + mean[:, 1])
    columns = (runs, run_means(found), position, np.sqrt(mean[:, 2]), pd.array(steps, "Int64"), reasons)
    return pd.DataFrame(dict(zip(RUN_COLUMNS, columns, strict=True)))


# --- what a step costs ------------------------------------------------------------------------------


def cost_of(filter_name: str, reference: str, scenario: Scenario, seed: int) -> tuple[float, float]:
    """CPU time of a step against that of the reference, and in microseconds.

    Both take the same trial by turns, in one thread with one BLAS thread, and each counts with its fastest: other work
    on the machine then matters little. CPU time is that of the thread. The trial is the first of three that neither
    fails; NaN where there is none.
    """
    filters = [get_filter(name) for name in dict.fromkeys((filter_name, reference))]
    spent = (_fastest(filters, simulate(scenario, run, seed), scenario) for run in range(TIMED))
    best = next((times for times in spent if np.isfinite(times).all()), [np.nan])
    return best[0] / best[-1], 1e6 * best[0] / scenario.truth.steps


def _fastest(filters: list[Filter], trial: Trial, scenario: Scenario) -> list[float]:
    """Seconds that each filter takes at best; infinite where it fails, which is tried where it can do no harm."""
    if apart := [filter_ for filter_ in filters if not isinstance(filter_, Compiled)]:
        with Isolation(apart, scenario.belief, PATIENCE) as isolation:
            if any(estimates.failure for estimates in isolation.run(trial)):
                return [np.inf] * len(filters)
    for filter_ in filters:
        if isinstance(filter_, WholeTrial) and not filter_.is_ready(trial, scenario.belief):
            filter_.compile(trial, scenario.belief)
    best = [np.inf] * len(filters)
    with one_blas_thread():
        for _ in range(TIMED):
            best = [min(b, _cpu_time(f, trial, scenario)) for b, f in zip(best, filters, strict=True)]
            if sum(best) > SLOW:
                break
    return best


def _cpu_time(filter_: Filter, trial: Trial, scenario: Scenario) -> float:
    """Seconds that a trial takes; infinite where the run fails."""
    # from the main thread a kernel runs in a thread of its own, whose time that of the main one does not hold
    in_main = threading.current_thread() is threading.main_thread()
    clock = time.process_time if in_main else time.thread_time
    started = clock()
    estimates = run_filter(filter_, trial, scenario.belief)
    spent = clock() - started
    return np.inf if estimates.failure is not None else spent


def plain_numbers(result: CellResult) -> dict[str, Any]:
    """Fields by name, for JSON: five digits of every number, text for an infinite one and null for NaN."""
    data = asdict(result)
    for name in NUMBERS:
        value = data[name]
        data[name] = None if np.isnan(value) else float(f"{value:.5g}") if np.isfinite(value) else str(float(value))
    return data


def result_from(numbers: Mapping[str, Any]) -> CellResult:
    """The result that :func:`plain_numbers` gave; raises TypeError where a field is missing or unknown."""
    given: dict[str, Any] = {
        name: np.nan if value is None else float(value) if name in NUMBERS else value for name, value in numbers.items()
    }
    return CellResult(**given)
