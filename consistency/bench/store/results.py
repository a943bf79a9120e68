"""Results of filters over runs: tables in memory or in a folder, and read back."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from pydantic import ValidationError

from consistency.bench.scenario import Scenario, explain
from consistency.bench.store.folder_tables import require_unchanged, write_tables
from consistency.bench.store.parquet import OPTIONAL, Columns, read_batches, read_parquet, require_table
from consistency.bench.store.results_folder_faults import require_manifest, require_rows
from consistency.referee.column_names import COLUMNS
from consistency.referee.errors import InputError
from consistency.referee.geometry.conventions import ADDITIVE, PLANAR
from consistency.referee.system.folders import read_manifest
from consistency.referee.types import Indices

NUMBERS = [column for column in COLUMNS["estimates"] if column != "filter"]
OWN_NUMBERS = [*NUMBERS, *OPTIONAL["estimates"]]  # of a filter whose error is not the additive one
JOINT = "joint_nees"  # of a landmark, given the pose and the landmarks above it in the map of its run
MAP_NUMBERS = [*(column for column in COLUMNS["map"] if column != "filter"), JOINT]


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
