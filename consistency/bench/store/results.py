"""Results of filters over runs, in memory or in a folder, and whether a folder says what a study leaves."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from html import escape
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import pandas as pd
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from consistency.bench.scenario import Scenario, explain
from consistency.bench.store.parquet import (
    OPTIONAL,
    Columns,
    read_batches,
    read_parquet,
    require_table,
    require_unchanged,
    write_tables,
)
from consistency.referee.column_names import COLUMNS
from consistency.referee.errors import InputError
from consistency.referee.geometry import ADDITIVE, PLANAR
from consistency.referee.parsing import one_line, reading, require_name
from consistency.referee.system import read_manifest
from consistency.referee.types import Indices

NUMBERS = [column for column in COLUMNS["estimates"] if column != "filter"]
OWN_NUMBERS = [*NUMBERS, *OPTIONAL["estimates"]]  # of a filter whose error is not the additive one
JOINT = "joint_nees"  # of a landmark, given the pose and the landmarks above it in the map of its run
MAP_NUMBERS = [*(column for column in COLUMNS["map"] if column != "filter"), JOINT]
AGAIN = "the folder was changed or damaged; write it again"
Whole = Annotated[int, Field(ge=0, lt=2**53)]
Steps = dict[int, int]  # by run


class Tables(ABC):
    """Tables of the estimates of filters over a number of runs, in memory or in a folder."""

    manifest: dict[str, Any]
    failures: pd.DataFrame
    landmarks: pd.DataFrame | None
    rejections: pd.DataFrame | None  # of filters with a guard, None where there is none

    @abstractmethod
    def batches(self, table: str, columns: Sequence[str], filter_name: str | None = None) -> Iterator[Columns]:
        """Columns of ``estimates`` or ``map`` (of one filter) or ``truth``, some rows at a time; none without it."""

    @property
    @abstractmethod
    def has_truth(self) -> bool: ...

    @property
    @abstractmethod
    def has_joint(self) -> bool:
        """Whether maps are kept with their joint NEES, which older folders lack."""

    @property
    def map_numbers(self) -> list[str]:
        """Columns of ``map`` that hold numbers."""
        return [column for column in MAP_NUMBERS if column != JOINT or self.has_joint]

    @property
    def filters(self) -> list[str]:
        return list(self.manifest["filters"])

    def error_of(self, filter_name: str) -> str:
        """Convention of a filter's own error, "so2" unless the manifest says otherwise.

        Raises
        ------
        InputError
            The manifest names no such convention.
        """
        errors = self.manifest.get("error", {})
        error = errors.get(filter_name, ADDITIVE) if isinstance(errors, dict) else errors
        if error not in PLANAR:
            allowed = ", ".join(PLANAR)
            raise InputError(f"manifest.json: key 'error': must be one of {allowed} for each filter, got {error!r}")
        return str(error)

    def numbers_of(self, filter_name: str) -> list[str]:
        """Columns of ``estimates`` that hold numbers of a filter."""
        return NUMBERS if self.error_of(filter_name) == ADDITIVE else OWN_NUMBERS

    @property
    def scenario(self) -> Scenario | None:
        """The scenario, or None for a recorded log."""
        data = self.manifest.get("scenario")
        try:
            return Scenario.model_validate(data) if data else None
        except ValidationError as error:
            raise InputError(f"manifest.json: key 'scenario': {explain(error, Scenario)}") from None
        except (OverflowError, RecursionError) as error:
            raise InputError(f"manifest.json: key 'scenario': holds what cannot be used ({error})") from None

    def _repr_html_(self) -> str:
        """Summary of the results for a notebook; ``consistency.analyse`` judges them."""
        scenario_entry = self.manifest.get("scenario") or {}
        title = f"Results of {scenario_entry.get('name') or self.manifest.get('log') or 'runs'}"
        table_rows = "".join(
            f"<tr><th style='text-align:left'>{escape(name)}</th><td>{len(self.runs_of(name))}</td>"
            f"<td>{int((self.failures['filter'] == name).sum())}</td></tr>"
            for name in self.filters
        )
        truth = "with truth" if self.has_truth else "without truth"
        return (
            f"<div><p><strong>{escape(str(title))}</strong>, {truth}, seed {escape(str(self.manifest.get('seed')))}</p>"
            f"<table><tr><th>filter</th><th>runs</th><th>failed</th></tr>{table_rows}</table></div>"
        )

    def finished_runs(self, filters: Sequence[str]) -> set[int]:
        """Runs that every one of ``filters`` has finished, well or not."""
        per_filter = [{int(run) for run in self.runs_of(name)} for name in filters]
        return set.intersection(*per_filter) if per_filter else set()

    def runs_of(self, filter_name: str) -> Indices:
        """Numbers of the runs of one filter, failed ones too, sorted."""
        run_numbers = [np.unique(batch["run"]) for batch in self.batches("estimates", ["run"], filter_name)]
        run_numbers.append(self.failures.loc[self.failures["filter"] == filter_name, "run"].to_numpy())
        return np.unique(np.concatenate(run_numbers)).astype(np.int64)


@dataclass(frozen=True)
class Results(Tables):
    """Estimates of filters over a number of runs, as tables in memory, laid out as in the files."""

    estimates: pd.DataFrame
    failures: pd.DataFrame
    truth: pd.DataFrame | None
    landmarks: pd.DataFrame | None
    manifest: dict[str, Any]
    map: pd.DataFrame | None = None
    rejections: pd.DataFrame | None = None

    @property
    def has_truth(self) -> bool:
        return self.truth is not None

    @property
    def has_joint(self) -> bool:
        return self.map is not None and JOINT in self.map

    def batches(self, table: str, columns: Sequence[str], filter_name: str | None = None) -> Iterator[Columns]:
        rows = {"truth": self.truth, "estimates": self.estimates, "map": self.map}[table]
        if rows is not None:
            selection = slice(None) if filter_name is None else (rows["filter"] == filter_name).to_numpy()
            yield {column: rows[column].to_numpy()[selection] for column in columns}

    def write(self, folder: Path, overwrite: bool = False, keep_others: bool = False) -> None:
        """Write the folder at once, as :func:`write_tables`: it appears complete or not at all."""
        tables = {"estimates": self.estimates, "failures": self.failures}
        optional = {
            "truth": self.truth, "landmarks": self.landmarks, "map": self.map, "rejections": self.rejections,
        }  # fmt: skip
        tables |= {name: table for name, table in optional.items() if table is not None}
        write_tables(folder, tables, self.manifest, overwrite=overwrite, keep_others=keep_others)


@dataclass(frozen=True)
class StoredResults(Tables):
    """Results in a folder: ``estimates``, ``truth`` and ``map`` are read at each access."""

    folder: Path
    failures: pd.DataFrame
    landmarks: pd.DataFrame | None
    manifest: dict[str, Any]
    rejections: pd.DataFrame | None = None

    @property
    def has_truth(self) -> bool:
        return "truth" in self.manifest.get("tables", [])

    @property
    def has_joint(self) -> bool:
        return (
            "map" in self.manifest.get("tables", []) and JOINT in require_table(self.folder, "map").schema_arrow.names
        )

    @property
    def estimates(self) -> pd.DataFrame:
        return read_parquet(self.folder, "estimates")

    @property
    def truth(self) -> pd.DataFrame | None:
        return read_parquet(self.folder, "truth") if self.has_truth else None

    @property
    def map(self) -> pd.DataFrame | None:
        return read_parquet(self.folder, "map") if "map" in self.manifest.get("tables", []) else None

    def batches(self, table: str, columns: Sequence[str], filter_name: str | None = None) -> Iterator[Columns]:
        if table == "estimates" or table in self.manifest.get("tables", []):
            yield from read_batches(self.folder, table, columns, filter_name)


def joined(parts: Sequence[Results]) -> Results:
    """Results of several filters on the same trials as one."""
    manifest = parts[0].manifest | {
        "filters": [name for part in parts for name in part.filters],
        "optimal_gain": [name for part in parts for name in part.manifest.get("optimal_gain", [])],
        "failures": sum(len(part.failures) for part in parts),
        "wall_time_s": round(sum(part.manifest["wall_time_s"] for part in parts), 3),
    }
    errors = {name: error for part in parts for name, error in part.manifest.get("error", {}).items()}
    manifest |= {"error": errors} if errors else {}
    tables: dict[str, Any] = {}
    for name in ("estimates", "failures", "map", "rejections"):
        tables_of_parts = (getattr(part, name) for part in parts)
        tables_there = [table for table in tables_of_parts if table is not None and (name != "failures" or len(table))]
        tables[name] = pd.concat(tables_there, ignore_index=True) if tables_there else getattr(parts[0], name)
    return replace(parts[0], manifest=manifest, **tables)


def open_results(folder: str | Path) -> StoredResults:
    """A folder written by ``consistency run``, whose large tables stay on disk.

    Raises
    ------
    InputError
        A file is missing, cut short, not as it was written, or lacks a column, a filter, a run or a step; the numbers
        in its rows are checked when they are read.
    """
    folder = Path(folder)
    manifest = read_manifest(folder)
    require_manifest(folder, manifest)
    tables_written = manifest["tables"]
    for name in ("estimates", *(name for name in ("truth", "map") if name in tables_written)):
        require_table(folder, name)
    require_unchanged(folder, manifest)
    landmarks = read_parquet(folder, "landmarks") if "landmarks" in tables_written else None
    rejections = read_parquet(folder, "rejections") if "rejections" in tables_written else None
    results = StoredResults(folder, read_parquet(folder, "failures"), landmarks, manifest, rejections)
    if OWN_NUMBERS in map(results.numbers_of, results.filters):
        require_table(folder, "estimates", OWN_NUMBERS)
    require_rows(folder, manifest, results.scenario, results.failures, rejections, landmarks)
    return results


def read_results(folder: str | Path) -> Results:
    """Read a folder written by ``consistency run`` into memory.

    Raises
    ------
    InputError
        A file is missing, cut short, or lacks a column.
    """
    stored = open_results(folder)
    return Results(
        stored.estimates, stored.failures, stored.truth, stored.landmarks, stored.manifest, stored.map,
        stored.rejections,
    )  # fmt: skip


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
