"""Whether a results folder says what a study leaves: every run of every filter, every step, each once and in order."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pandas as pd
from pydantic import BaseModel, ConfigDict, Field, field_validator

from consistency.bench.scenario import Scenario
from consistency.bench.store.parquet import read_batches, require_table
from consistency.referee.column_names import COLUMNS
from consistency.referee.errors import InputError
from consistency.referee.parsing import one_line, reading, require_name

AGAIN = "the folder was changed or damaged; write it again"
Whole = Annotated[int, Field(ge=0, lt=2**53)]
Steps = dict[int, int]  # by run


class _Manifest(BaseModel):
    """Keys of ``manifest.json`` that are relied on."""

    model_config = ConfigDict(strict=True)
    kind: Literal["results"]
    filters: Annotated[list[str], Field(min_length=1)]
    tables: list[str]
    runs: Annotated[int, Field(ge=1, lt=2**53)]
    failures: Whole
    complete: bool
    finished_runs: Whole | None = None
    seed: int | None
    scenario: dict[str, Any] | None = None
    scenario_hash: str | None = None
    optimal_gain: list[str] = []
    until_decided: dict[str, Any] | None = None
    versions: dict[str, str] = {}
    date: str | None = None
    wall_time_s: float | None = None
    command: str | None = None
    git_commit: str | None = None
    log: str | None = None
    log_sha256: dict[str, str] | None = None

    @field_validator("filters", "tables", "optimal_gain")
    @classmethod
    def _each_once(cls, names: list[str]) -> list[str]:
        if len(set(names)) < len(names):
            raise ValueError("a name is duplicated")
        for name in names:
            require_name(name, "its names")
        return names


def require_manifest(folder: Path, manifest: dict[str, Any]) -> None:
    """Refuse a manifest with missing or wrong keys, and tables that are there and not listed, or the other way round.

    Raises
    ------
    InputError
        Names the key.
    """
    path = folder / "manifest.json"
    if "filters" not in manifest:
        raise InputError(f"{folder}: holds no estimates; it was not written by 'consistency run'")
    with reading(path, AGAIN):
        keys = _Manifest.model_validate(manifest)
    tables = {file.stem for file in folder.glob("*.parquet")} & set(COLUMNS)
    if missing := sorted({"estimates", "failures", *keys.tables} - tables):
        raise InputError(f"{folder / missing[0]}.parquet: missing; write the folder again")
    if tables != set(keys.tables):
        raise InputError(f"{path}: key 'tables' lacks '{min(tables - set(keys.tables))}'; {AGAIN}")
    if unknown := sorted(set(keys.optimal_gain) - set(keys.filters)):
        raise InputError(
            f"{path}: key 'optimal_gain': '{one_line(unknown[0])}' is not a filter of these results; {AGAIN}"
        )
    if not keys.complete and keys.finished_runs is None:
        raise InputError(f"{path}: key 'finished_runs': missing, but 'complete' is false; {AGAIN}")


def require_rows(
    folder: Path,
    manifest: dict[str, Any],
    scenario: Scenario | None,
    failures: pd.DataFrame,
    rejections: pd.DataFrame | None,
    landmarks: pd.DataFrame | None,
) -> None:
    """Refuse tables that lack a filter, a run or a step, or hold one twice or out of order.

    Reads the columns ``run`` and ``step`` of ``estimates`` and ``truth``, and ``run`` and ``landmark`` of ``map``.

    Raises
    ------
    InputError
        Names the file, and the run or step.
    """
    filters: list[str] = manifest["filters"]
    if scenario is not None and manifest.get("scenario_hash") != scenario.hash:
        raise InputError(f"{folder / 'manifest.json'}: key 'scenario_hash' is not that of key 'scenario'; {AGAIN}")
    failed_steps = _failed(folder / "failures.parquet", filters, failures, manifest["failures"])
    steps_of_filters = {name: _steps(folder, "estimates", 1, name) for name in filters}
    _require_all_rows(folder, "estimates", sum(sum(steps.values()) for steps in steps_of_filters.values()))
    true_steps = None
    if "truth" in manifest["tables"]:
        true_steps = {run: rows - 1 for run, rows in _steps(folder, "truth", 0).items()}
        _require_all_rows(folder, "truth", sum(true_steps.values()) + len(true_steps))
    run_lengths = _lengths(folder, scenario, true_steps, steps_of_filters)
    _require_runs(folder / "manifest.json", manifest, scenario, run_lengths | dict.fromkeys(_union(failed_steps), 0))
    for name in filters:
        estimated, failed = steps_of_filters[name], failed_steps[name]
        _require_filter(folder / "estimates.parquet", name, estimated, failed, run_lengths, true_steps is not None)
    if "map" in manifest["tables"]:
        _require_maps(folder, steps_of_filters, failed_steps)
    if rejections is not None:
        _require_rejections(folder / "rejections.parquet", rejections, steps_of_filters, failed_steps)
    if landmarks is not None and landmarks["landmark"].duplicated().any():
        raise InputError(f"{folder / 'landmarks.parquet'}: column 'landmark': a landmark is duplicated; {AGAIN}")


def _failed(path: Path, filters: Sequence[str], failures: pd.DataFrame, count: int) -> dict[str, Steps]:
    """Step of the failure of each run, by filter."""
    if len(failures) != count:
        raise InputError(f"{path}: has {len(failures)} rows, manifest.json counts {count} failures; {AGAIN}")
    failed_steps: dict[str, Steps] = {name: {} for name in filters}
    for name, run, step in zip(failures["filter"], failures["run"], failures["step"], strict=True):
        if name not in failed_steps:
            raise InputError(f"{path}: '{one_line(name)}' is not a filter of these results; {AGAIN}")
        if run in failed_steps[name] or run < 0 or step < 1:
            raise InputError(
                f"{path}: run {run} of '{name}', step {step}: a run fails once, in step 1 or later; {AGAIN}"
            )
        failed_steps[name][int(run)] = int(step)
    return failed_steps


def _steps(folder: Path, table: str, begin: int, filter_name: str | None = None) -> Steps:
    """Rows of each run; refused unless they stand in order of run and step, from ``begin`` on, without a gap."""
    counts: Steps = {}
    run, step = -1, 0
    for batch in read_batches(folder, table, ["run", "step"], filter_name):
        runs, steps = batch["run"].astype(np.int64), batch["step"].astype(np.int64)
        runs_before, steps_before = np.append(run, runs[:-1]), np.append(step, steps[:-1])
        is_next = np.where(runs == runs_before, steps == steps_before + 1, (steps == begin) & (runs > runs_before))
        if not is_next.all():
            row = int(np.argmin(is_next))
            of_filter = "" if filter_name is None else f" of '{filter_name}'"
            raise InputError(
                f"{folder / table}.parquet: step {steps[row]} of run {runs[row]}{of_filter} is not what comes "
                f"next; runs and steps stand in order, each once; {AGAIN}"
            )
        for number, rows in zip(*np.unique(runs, return_counts=True), strict=True):
            counts[int(number)] = counts.get(int(number), 0) + int(rows)
        run, step = (int(runs[-1]), int(steps[-1])) if len(runs) else (run, step)
    return counts


def _require_all_rows(folder: Path, table: str, rows: int) -> None:
    rows_there = require_table(folder, table).metadata.num_rows
    if rows_there != rows:
        strays = rows_there - rows
        raise InputError(f"{folder / table}.parquet: {strays} of {rows_there} rows are of no filter; {AGAIN}")


def _lengths(folder: Path, scenario: Scenario | None, truth: Steps | None, there: dict[str, Steps]) -> Steps:
    """Steps of each run: those of its truth, or of the scenario, or else of the filter that went furthest."""
    if truth is None and scenario is not None:
        return dict.fromkeys(_union(there), scenario.truth.steps)
    if truth is None:
        return {run: max(steps.get(run, 0) for steps in there.values()) for run in _union(there)}
    for run, steps in truth.items():
        if scenario is not None and steps != scenario.truth.steps:
            raise InputError(
                f"{folder / 'truth.parquet'}: run {run} has {steps} steps, the scenario {scenario.truth.steps}; {AGAIN}"
            )
    return truth


def _require_runs(path: Path, manifest: dict[str, Any], scenario: Scenario | None, runs: Steps) -> None:
    runs_of_manifest = manifest["runs"] if manifest["complete"] else manifest["finished_runs"]
    if len(runs) != runs_of_manifest:
        raise InputError(f"{path}: counts {runs_of_manifest} runs, the tables hold {len(runs)}; {AGAIN}")
    if scenario is not None and runs and max(runs) >= manifest["runs"]:
        raise InputError(f"{path}: key 'runs' is {manifest['runs']}, the tables hold run {max(runs)}; {AGAIN}")


def _require_filter(path: Path, name: str, there: Steps, failed: Steps, length: Steps, known: bool) -> None:
    """Every run is there: whole, or up to the step before its failure. ``known``: the length of failed ones, too."""
    if missing_runs := sorted(set(length) - set(there) - set(failed)):
        raise InputError(f"{path}: run {missing_runs[0]} of '{name}' is missing; {AGAIN}")
    for run in sorted({*there, *failed}):
        steps, run_length = there.get(run, 0), length.get(run)
        if (known and run_length is None) or (run in failed and known and failed[run] > (run_length or 0)):
            raise InputError(f"{path}: run {run} of '{name}' has steps that truth.parquet lacks; {AGAIN}")
        expected_steps = failed[run] - 1 if run in failed else run_length
        if steps != expected_steps:
            raise InputError(f"{path}: run {run} of '{name}' has {steps} steps, not {expected_steps}; {AGAIN}")


def _require_maps(folder: Path, there: dict[str, Steps], failed: dict[str, Steps]) -> None:
    path, rows_of_filters = folder / "map.parquet", 0
    for name in there:
        parts = [pd.DataFrame(batch) for batch in read_batches(folder, "map", ["run", "landmark"], name)]
        table = pd.concat(parts) if parts else pd.DataFrame({"run": [], "landmark": []})
        rows_of_filters += len(table)
        if table.duplicated().any():
            run, landmark = table[table.duplicated()].iloc[0]
            raise InputError(f"{path}: landmark {landmark:.0f} of run {run:.0f} of '{name}' is duplicated; {AGAIN}")
        if runs_without_map := sorted(set(table["run"]) - (set(there[name]) - set(failed[name]))):
            raise InputError(f"{path}: '{name}' has no finished run {runs_without_map[0]:.0f}; {AGAIN}")
    _require_all_rows(folder, "map", rows_of_filters)


def _require_rejections(path: Path, table: pd.DataFrame, there: dict[str, Steps], failed: dict[str, Steps]) -> None:
    if table.empty:
        raise InputError(f"{path}: has no rows; {AGAIN}")
    for name, rows in table.groupby("filter"):
        runs = {*there.get(str(name), ()), *failed.get(str(name), ())}
        if rows["run"].duplicated().any() or set(rows["run"]) != runs:
            raise InputError(f"{path}: must have each run of '{one_line(name)}' once; {AGAIN}")
    rejected_counts, offered = table[["spurious", "rejected", "rejected_spurious"]], table["offered"]
    rejected_or_spurious = table["spurious"] + table["rejected"] - table["rejected_spurious"]
    if (
        (rejected_counts < 0).any(axis=None)
        or (rejected_or_spurious > offered).any()
        or (rejected_counts.iloc[:, 2] > rejected_counts.iloc[:, :2].min(axis=1)).any()
    ):
        raise InputError(f"{path}: counts of rejected observations do not go together; {AGAIN}")


def _union(steps: dict[str, Steps]) -> Iterator[int]:
    return iter(sorted({run for runs in steps.values() for run in runs}))
