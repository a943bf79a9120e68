"""Doing a sweep: every filter in every cell until decided, in a folder that continues where it was stopped."""

from __future__ import annotations

import functools
import hashlib
import json
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from consistency.bench.filters import get_filter
from consistency.bench.filters.compiled import Compiled, one_blas_thread
from consistency.bench.filters.run_filter import run_filter
from consistency.bench.protocols import Filter
from consistency.bench.runs.isolation import Isolation
from consistency.bench.runs.montecarlo import run_until_decided
from consistency.bench.runs.results_to_records import mean_nees_of_runs, record_of
from consistency.bench.runs.run_outcome import compile_all
from consistency.bench.runs.workers import worker_count
from consistency.bench.scenario import Belief, Scenario
from consistency.bench.simulation import simulate
from consistency.bench.store.journal import Busy, Journal, Unfinished
from consistency.bench.store.parquet import write_tables
from consistency.bench.sweeps.sweep_file import Cell, Sweep, SweepFile, sweep_of
from consistency.bench.types import Trial
from consistency.referee.diagnostics.record import Record
from consistency.referee.diagnostics.verdict import Verdict
from consistency.referee.errors import InputError
from consistency.referee.parsing import reading
from consistency.referee.system import (
    digest_of_sources,
    manifest_of,
    quiet,
    read_manifest,
    say,
    unfinished_of,
    write_whole,
)

PAUSE = 1.0  # s, between looks at whether another process has done what is left
KIND, CELL_KIND = "sweep", "cell"
CELLS = "cells"  # folder of the cells in that of the sweep
# rooms whose code the numbers of a cell depend on
CODE = (
    "referee/diagnostics", "referee/geometry.py", "referee/verdicts", "bench/filters",
    "bench/runs/run_outcome.py", "bench/runs/montecarlo.py", "bench/scenario", "bench/simulation.py", "bench/store",
)  # fmt: skip
TIMED = 3  # times that a trial is timed, of which the least counts, and trials that are tried
SLOW = 1.0  # s, a trial that takes longer is timed once
PATIENCE = 60.0  # s, a trial of a filter that is not compiled is not timed if it takes longer
RUN_COLUMNS = ("run", "nees", "rmse_position", "rmse_heading", "failed_at", "reason")


def run_sweep(
    sweep: Sweep, out: Path, overwrite: bool = False, jobs: int = -1, executor: Executor | None = None
) -> SweepFolder:
    """Do what is not done yet, each filter in each cell by itself.

    Finished runs of a cell are kept in a journal until the cell is done, so that the same call continues within it.
    Several processes may write into one folder; no cell is done twice.

    Parameters
    ----------
    out : folder, which may hold a part of the same sweep
    overwrite : run cells again that were made with other inputs
    jobs, executor : as for :func:`consistency.bench.runs.montecarlo.run_trials`

    Raises
    ------
    InputError
        The folder is something else's, or holds cells that were made with other inputs; a number out of range.
    """
    worker_count(jobs)
    folder = SweepFolder(sweep, Path(out))
    folder.require_usable(overwrite)
    folder.begin()
    work = folder.all_work()
    # unfinished work is of a process at work, or of one that was killed as it ended
    todo = [
        cell_work
        for cell_work in work
        if folder.result(cell_work) is None or unfinished_of(folder.place(cell_work)).exists()
    ]
    if len(todo) < len(work):
        say(f"{len(work) - len(todo)} of {len(work)} are there already")
    run = functools.partial(run_cell, jobs=jobs, executor=executor)
    started = time.monotonic()
    for count, done in enumerate(_in_turn(folder, todo, run), 1):
        seconds_left = (time.monotonic() - started) / count * (len(todo) - count)
        say(f"{count} of {len(todo)}: {done.text}: {_outcome_text(folder.result(done))}{_time_left(seconds_left)}")
    return folder


def _in_turn(
    folder: SweepFolder, todo: list[CellWork], run: Callable[[Sweep, Cell, str, Journal], CellOutcome]
) -> Iterator[CellWork]:
    """Run each, and yield it when it is there; what another process is at work on is tried again after the others."""
    is_told = False
    while todo:
        busy_cells = []
        for work in todo:
            try:
                with folder.at_work(work) as journal:
                    if folder.result(work) is None:  # nobody has done it meanwhile
                        begun = time.monotonic()
                        outcome = run(folder.sweep, work.cell, work.filter, journal)
                        folder.write(work, outcome, time.monotonic() - begun)
            except Busy:
                busy_cells.append(work)
            except OSError as error:
                raise InputError(
                    f"--out {folder.path}: {error.strerror or error}; what is finished is there, and the same command "
                    "continues"
                ) from error
            else:
                yield work
        if len(busy_cells) == len(todo):
            if not is_told:
                say(f"waiting for another process, which is at work on the last {len(busy_cells)}")
            is_told = True
            time.sleep(PAUSE)
        todo = busy_cells


def _outcome_text(result: CellResult | None) -> str:
    if result is None:
        return "removed meanwhile"
    return f"{result.status} after {result.runs} runs" if result.runs else result.diagnosis


def _time_left(seconds: float) -> str:
    if seconds >= 90.0:
        return f"; {seconds / 60.0:.0f} min left"
    return f"; {seconds:.0f} s left" if seconds >= 1.0 else ""


@functools.cache
def code_digest() -> str:
    """Hash of the sources that the numbers of a cell depend on."""
    return digest_of_sources(Path(__file__).parents[2], CODE)[:16]


@dataclass(frozen=True)
class CellWork:
    """One filter in one cell."""

    cell: Cell
    filter: str

    @property
    def text(self) -> str:
        return f"{self.filter}, {self.cell.text}"


class SweepFolder:
    """A sweep with the folder of its cells.

    Parameters
    ----------
    sweep : what is to be done
    path : folder; it need not be there
    """

    def __init__(self, sweep: Sweep, path: Path) -> None:
        self.sweep, self.path = sweep, path

    def place(self, work: CellWork) -> Path:
        """Folder of one filter in one cell."""
        return self.path / CELLS / work.cell.name / work.filter

    def inputs(self, work: CellWork) -> dict[str, Any]:
        """What the numbers of a cell depend on."""
        sweep = self.sweep
        return {
            "scenario": work.cell.scenario.hash, "filter": work.filter, "seed": sweep.seed_of(work.cell),
            **sweep.rule.model_dump(), "code": code_digest(),
        }  # fmt: skip

    def result(self, work: CellWork) -> CellResult | None:
        """The result that was made with these inputs; None where there is none.

        Raises
        ------
        InputError
            What is there is damaged.
        """
        path = self.place(work)
        if not path.exists() or self.changed_input(work):
            return None
        with reading(path / "manifest.json", "key 'result' is damaged; remove that folder"):
            return result_from(read_manifest(path)["result"])

    def changed_input(self, work: CellWork) -> str:
        """What the result that is there was made with and what differs now, in words; empty where all is the same."""
        cell_folder = self.place(work)
        inputs_before = read_manifest(cell_folder).get("inputs")
        if not isinstance(inputs_before, dict):
            raise InputError(f"{cell_folder}/manifest.json: key 'inputs' is missing; remove that folder")
        for key, value in self.inputs(work).items():
            if inputs_before.get(key) != value:
                input_name = "source code of the bench" if key == "code" else key
                return f"{cell_folder}: made with another {input_name} ({inputs_before.get(key)}, now {value})"
        return ""

    def require_usable(self, overwrite: bool) -> None:
        """Refuse before any work a folder of something else, and unless ``overwrite`` cells made with other inputs."""
        if not (self.path.exists() or self.path.is_symlink()):
            return
        try:
            kind = read_manifest(self.path).get("kind")
        except InputError as error:
            raise InputError(f"--out {self.path}: is not a folder of 'consistency sweep' ({error})") from None
        if kind != KIND:
            raise InputError(f"--out {self.path}: holds {kind}, not a sweep; choose another folder")
        if overwrite:
            return
        finished_cells = [work for work in self.all_work() if self.place(work).exists()]
        changed_cells = [text for work in finished_cells if (text := self.changed_input(work))]
        if changed_cells:
            more = f" (and {len(changed_cells) - 1} more)" if len(changed_cells) > 1 else ""
            raise InputError(
                f"{changed_cells[0]}{more}; add --overwrite to run such cells again, or give another --out to keep them"
            )

    def all_work(self) -> list[CellWork]:
        """Every filter in every cell, in an order that mixes the grid.

        Slow cells lie together in the grid; mixed, the time left is foreseen.
        """
        cells_in_mixed_order = sorted(self.sweep.cells, key=lambda cell: hashlib.sha256(cell.name.encode()).digest())
        return [CellWork(cell, name) for cell in cells_in_mixed_order for name in self.sweep.filters]

    def begin(self) -> None:
        """Make the folder, or take over the one that is there; other processes may do so at the same time."""
        manifest = manifest_of(kind=KIND, sweep=describe(self.sweep))
        if not self.path.exists():
            try:
                write_tables(self.path, {}, manifest)
                return
            except InputError:
                if not self.path.exists():
                    raise
        manifest_before = read_manifest(self.path)
        try:
            sweep_before = sweep_from(manifest_before, self.path)
        except InputError:
            sweep_before = self.sweep
        if replace(sweep_before, filters=()) == replace(self.sweep, filters=()):
            self.sweep = replace(self.sweep, filters=tuple(dict.fromkeys((*sweep_before.filters, *self.sweep.filters))))
        text = json.dumps(manifest | {"sweep": describe(self.sweep), "tables": []}, indent=2)
        write_whole(self.path / "manifest.json", f"{text}\n".encode())

    @contextmanager
    def at_work(self, work: CellWork) -> Iterator[Journal]:
        """The journal of what is finished of a cell; nobody else has it meanwhile, and it is gone with the cell's end.

        Raises
        ------
        Busy
            Another process is at work on the cell.
        """
        inputs = self.inputs(work)
        with Unfinished(self.place(work), resume=True, kind=CELL_KIND) as unfinished:
            journal = unfinished.journal
            if journal.study.get("inputs") != inputs:
                journal.clear()
                journal.begin({"inputs": inputs})
            yield journal
            unfinished.is_over = True

    def write(self, work: CellWork, outcome: CellOutcome, wall: float) -> None:
        """Put a result in its place as a whole; one that another process has put there meanwhile is replaced."""
        manifest = manifest_of(
            kind=CELL_KIND, wall=wall, inputs=self.inputs(work), cell=work.cell.text,
            seed=self.sweep.seed_of(work.cell), result=plain_numbers(outcome.result),
            scenario=work.cell.scenario.model_dump(mode="json"),
        )  # fmt: skip
        write_tables(
            self.place(work), {}, manifest,
            lambda at: outcome.runs.to_csv(at / "runs.csv", index=False, float_format="%.6g"), overwrite=True,
        )  # fmt: skip

    def results(self) -> dict[tuple[int, str], CellResult]:
        """What is there, by number of the cell and filter; results with other inputs are left out."""
        cell_results: dict[tuple[int, str], CellResult] = {}
        for cell in self.sweep.cells:
            for name in self.sweep.filters:
                result = self.result(CellWork(cell, name))
                if result is not None:
                    cell_results[cell.number, name] = result
        return cell_results


def describe(sweep: Sweep) -> dict[str, Any]:
    """A sweep as JSON, from which it can be made again."""
    values_alone = {axis.key: list(axis.values) for axis in sweep.alone}
    return {
        "name": sweep.name,
        "summary": sweep.summary,
        "base": sweep.base.model_dump(mode="json"),
        "grid": {axis.key: list(axis.values) for axis in sweep.grid},
        **({"alone": values_alone} if values_alone else {}),
        "filters": list(sweep.filters),
        "seed": sweep.seed,
        "rule": sweep.rule.model_dump(),
    }


def sweep_from(manifest: dict[str, Any], path: Path) -> Sweep:
    """The sweep that :func:`describe` described, under the key ``sweep`` of what ``path`` holds.

    Raises
    ------
    InputError
        It is damaged.
    """
    with reading(path, "key 'sweep' is damaged; write it again"):
        content = dict(manifest["sweep"])
        name, base = str(content.pop("name")), Scenario.model_validate(content.pop("base"))
        file = SweepFile.model_validate(content | {"base": base.name})
        try:
            sweep = sweep_of(name, file, base)
        except InputError as error:
            raise ValueError(str(error)) from None
        _ = sweep.cells  # each is checked when it is made
        return sweep


def open_sweep(path: Path) -> SweepFolder:
    """A folder of ``consistency sweep``; raises InputError where it is none."""
    manifest = read_manifest(path)
    if manifest.get("kind") != KIND:
        raise InputError(f"{path}: holds {manifest.get('kind')}, not a sweep; give a folder of 'consistency sweep'")
    return SweepFolder(sweep_from(manifest, path / "manifest.json"), path)


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


def run_cell(
    sweep: Sweep,
    cell: Cell,
    filter_name: str,
    journal: Journal | None = None,
    jobs: int = -1,
    executor: Executor | None = None,
) -> CellOutcome:
    """Run one filter in one cell until it is decided.

    The trials depend on the sweep's seed and the cell's scenario alone. An exception is a result, too: the filter has
    failed there; but not what the system refuses.

    Parameters
    ----------
    journal, jobs, executor : as for :func:`run_until_decided`

    Raises
    ------
    OSError, InputError with an OSError as its cause
        No space left, no process can be started, a connection is lost.
    """
    rule, seed = sweep.rule.model_dump(), sweep.seed_of(cell)
    try:
        with quiet():
            results, verdicts = run_until_decided(
                cell.scenario, [filter_name], **rule, seed=seed, jobs=jobs, executor=executor, journal=journal
            )
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
    error, runs = record.in_world.errors.error, record.run_numbers
    assert error is not None
    assert record.errors.nees is not None
    squared_errors = np.where(np.isfinite(record.errors.nees)[..., None], error**2, np.nan)
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
        seconds = _fastest(filters, simulate(scenario, run, seed), scenario.belief)
        if np.isfinite(seconds).all():
            return seconds[0] / seconds[-1], 1e6 * seconds[0] / scenario.truth.steps
    return np.nan, np.nan


def _fastest(filters: list[Filter], trial: Trial, belief: Belief) -> list[float]:
    """Seconds that each filter takes at best; infinite where it fails, which is tried where it can do no harm."""
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
                seconds = thread.submit(_cpu_time, filter_, trial, belief).result()
                fastest_seconds[i] = min(fastest_seconds[i], seconds)
            if sum(fastest_seconds) > SLOW:
                break
    return fastest_seconds


def _cpu_time(filter_: Filter, trial: Trial, belief: Belief) -> float:
    """Seconds of this thread that a trial takes; infinite where the run fails."""
    started = time.thread_time()
    estimates = run_filter(filter_, trial, belief)
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
