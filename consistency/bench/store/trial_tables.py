"""Rows of the tables for one trial, from the arrays that filters give, and tables of the rows of many."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from consistency.bench.store.parquet import BY_FILTER, Columns
from consistency.bench.types import Trial
from consistency.referee.column_names import COLUMNS, POSE
from consistency.referee.types import Array, Failure


class Rejected(NamedTuple):
    """How many observations a guard was offered in a run, and what it rejected; a row of ``rejections``."""

    filter: str
    run: int
    offered: int
    spurious: int
    rejected: int
    rejected_spurious: int


def truth_columns(trial: Trial, path: Array) -> Columns:
    return {
        "run": np.full(len(path), trial.run),
        "step": np.arange(len(path)),
        "t": trial.t,
        **dict(zip(POSE, path.T, strict=True)),
    }


def stacked_table(name: str, parts: Sequence[tuple[str, Columns]], also: Sequence[str] = ()) -> pd.DataFrame:
    """Table ``name`` of (filter, columns), one below the other; NaN where a column is lacking, one of ``also`` too.

    The columns are nobody else's: pandas would copy them, at millions of rows half the memory.
    """
    table = pd.DataFrame(columns=list(COLUMNS[name])).astype(COLUMNS[name])
    if parts:
        rows, stacked = [len(columns["run"]) for _, columns in parts], dict[str, Any]()
        if name in BY_FILTER:
            filter_names = pd.Series([filter_name for filter_name, _ in parts], dtype="str")
            stacked["filter"] = filter_names.repeat(rows).reset_index(drop=True)
        for column in dict.fromkeys(column for _, part in parts for column in part):
            pairs = zip(parts, rows, strict=True)
            column_pieces = [part[column] if column in part else np.full(n, np.nan) for (_, part), n in pairs]
            stacked[column] = np.concatenate(column_pieces)
        table = pd.DataFrame(stacked, copy=False)
    missing_columns = [column for column in also if column not in table]
    return table.assign(**dict.fromkeys(missing_columns, np.nan)) if missing_columns else table


def noted_table(name: str, rows: Sequence[Failure | Rejected]) -> pd.DataFrame:
    """``failures.parquet`` or ``rejections.parquet``."""
    return pd.DataFrame(rows, columns=list(COLUMNS[name])).astype(COLUMNS[name])


def controls_table(trials: Sequence[Trial]) -> pd.DataFrame:
    tables = []
    for trial in trials:
        columns: Columns = {"run": np.full(trial.steps, trial.run), "step": np.arange(1, trial.steps + 1)}
        columns |= dict(zip(["dt", "v", "omega"], trial.controls.T, strict=True))
        tables.append(pd.DataFrame(columns))
    return pd.concat(tables, ignore_index=True)


def observations_table(trials: Sequence[Trial]) -> pd.DataFrame:
    """``observations.parquet``; with a column ``source`` if a row is not of the landmark that it says."""
    has_sources = any(trial.source is not None for trial in trials)
    tables = []
    for trial in trials:
        columns: Columns = {"run": np.full(len(trial.landmark), trial.run), "step": trial.step}
        columns["landmark"] = trial.landmark
        columns |= dict(zip(["z0", "z1", "z2"], trial.z.T, strict=False))
        if has_sources:
            columns["source"] = trial.landmark if trial.source is None else trial.source
        tables.append(pd.DataFrame(columns))
    return pd.concat(tables, ignore_index=True)
