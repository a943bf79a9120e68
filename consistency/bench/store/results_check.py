"""The manifest of a results folder: its keys, and the tables that it lists.

What is in the tables is known by their digests (``folder_tables.require_unchanged``).
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import pandas as pd
from pydantic import BaseModel, ConfigDict, Field, field_validator

from consistency.bench.scenario import Scenario
from consistency.referee.column_names import COLUMNS
from consistency.referee.errors import InputError
from consistency.referee.parsing import one_line, reading, require_name

AGAIN = "the folder was changed or damaged; write it again"
Whole = Annotated[int, Field(ge=0, lt=2**53)]


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
    wall_time_s: float | None = None
    command: str | None = None
    git_commit: str | None = None
    log: str | None = None
    log_sha256: dict[str, str] | None = None

    @field_validator("filters", "tables", "optimal_gain")
    @classmethod
    def _each_once(cls, names: list[str]) -> list[str]:
        if len(set(names)) < len(names):
            raise ValueError("a name is there twice")
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
        raise InputError(f"{path}: key 'optimal_gain': '{one_line(unknown[0])}' is no filter of these results; {AGAIN}")
    if not keys.complete and keys.finished_runs is None:
        raise InputError(f"{path}: key 'finished_runs': missing, but 'complete' is false; {AGAIN}")


def require_study(folder: Path, manifest: dict[str, Any], scenario: Scenario | None, failures: pd.DataFrame) -> None:
    """Refuse a manifest that disagrees with its own scenario or with the table of failures.

    Raises
    ------
    InputError
        Names the file.
    """
    if scenario is not None and manifest.get("scenario_hash") != scenario.hash:
        raise InputError(f"{folder / 'manifest.json'}: key 'scenario_hash' is not that of key 'scenario'; {AGAIN}")
    path = folder / "failures.parquet"
    if len(failures) != manifest["failures"]:
        counted = manifest["failures"]
        raise InputError(f"{path}: has {len(failures)} rows, manifest.json counts {counted} failures; {AGAIN}")
    if unknown := sorted(set(failures["filter"]) - set(manifest["filters"])):
        raise InputError(f"{path}: '{one_line(unknown[0])}' is not a filter of these results; {AGAIN}")
