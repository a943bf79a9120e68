"""Frames of the tables: rows of runs, and trials, below each other."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from consistency.bench.store.parquet import OPTIONAL, Columns
from consistency.bench.store.results import JOINT
from consistency.bench.store.trial_rows import Rejected, truth_columns
from consistency.bench.types import Trial
from consistency.referee.column_names import COLUMNS
from consistency.referee.types import Array, Failure


def estimates_table(parts: Sequence[tuple[str, Columns]], own: bool = False) -> pd.DataFrame:
    """``estimates.parquet`` of (filter, columns), one below the other; ``own``: with the columns of own errors."""
    table = _by_filter("estimates", parts)
    missing = [column for column in OPTIONAL["estimates"] if own and column not in table]
    return table.assign(**dict.fromkeys(missing, np.nan)) if missing else table


def map_table(parts: Sequence[tuple[str, Columns]]) -> pd.DataFrame | None:
    """``map.parquet`` of (filter, columns), one below the other; None without a row."""
    table = _by_filter("map", parts)
    return (table if JOINT in table else table.assign(**{JOINT: np.nan})) if len(table) else None


def _by_filter(name: str, parts: Sequence[tuple[str, Columns]]) -> pd.DataFrame:
    if not parts:
        return _empty(name)
    rows = [len(columns["run"]) for _, columns in parts]
    names = pd.Series([each for each, _ in parts], dtype="str").repeat(rows).reset_index(drop=True)
    return _table({"filter": names} | _stacked([columns for _, columns in parts]))


def _stacked(parts: Sequence[Columns]) -> Columns:
    """Columns of all parts, one below the other; NaN where a part lacks one."""
    names = dict.fromkeys(column for part in parts for column in part)
    return {
        column: np.concatenate([part[column] if column in part else _nothing(part) for part in parts])
        for column in names
    }


def _nothing(part: Columns) -> Array:
    return np.full(len(part["run"]), np.nan)


def _table(columns: dict[str, Any]) -> pd.DataFrame:
    """A table around columns that nobody else has: pandas would copy them, at millions of rows half the memory."""
    return pd.DataFrame(columns, copy=False)


def truth_table(parts: Sequence[Columns]) -> pd.DataFrame:
    """``truth.parquet`` of the columns of several runs."""
    return _table(_stacked(parts)) if parts else _empty("truth")


def truth_of(trials: Sequence[Trial]) -> pd.DataFrame:
    """``truth.parquet`` of the trials that have truth."""
    return truth_table([truth_columns(trial, trial.truth) for trial in trials if trial.truth is not None])


def controls_table(trials: Sequence[Trial]) -> pd.DataFrame:
    """``controls.parquet``."""
    return pd.concat(
        [
            pd.DataFrame(
                {
                    "run": np.full(t.steps, t.run),
                    "step": np.arange(1, t.steps + 1),
                    **dict(zip(["dt", "v", "omega"], t.controls.T, strict=True)),
                }
            )
            for t in trials
        ],
        ignore_index=True,
    )


def observations_table(trials: Sequence[Trial]) -> pd.DataFrame:
    """``observations.parquet``; with a column ``source`` if a row is not of the landmark that it says."""
    labelled = any(t.source is not None for t in trials)
    return pd.concat(
        [
            pd.DataFrame(
                {
                    "run": np.full(len(t.landmark), t.run),
                    "step": t.step,
                    "landmark": t.landmark,
                    **dict(zip(["z0", "z1", "z2"], t.z.T, strict=False)),
                    **({"source": t.landmark if t.source is None else t.source} if labelled else {}),
                }
            )
            for t in trials
        ],
        ignore_index=True,
    )


def failures_table(failures: Sequence[Failure]) -> pd.DataFrame:
    """``failures.parquet``."""
    if not failures:
        return _empty("failures")
    rows = [(f.filter, f.run, f.step, f.reason) for f in failures]
    return pd.DataFrame(rows, columns=list(COLUMNS["failures"])).astype(COLUMNS["failures"])


def rejections_table(rows: Sequence[Rejected]) -> pd.DataFrame | None:
    """``rejections.parquet``; None without a row."""
    if not rows:
        return None
    return pd.DataFrame(rows, columns=list(COLUMNS["rejections"])).astype(COLUMNS["rejections"])


def _empty(name: str) -> pd.DataFrame:
    return pd.DataFrame({column: pd.Series(dtype=kind) for column, kind in COLUMNS[name].items()})
