"""Results of filters over runs: tables from arrays, kept in a folder and read back."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from pydantic import ValidationError

from consistency.diagnostics import nees
from consistency.errors import InputError
from consistency.filters.linalg import definiteness
from consistency.geometry import pose_error
from consistency.scenario import Scenario, explain
from consistency.storage import COLUMNS, COVARIANCE, read_manifest, read_parquet, write_folder
from consistency.types import Array, Estimates, Failure, Trial

POSE = ["x", "y", "heading"]


@dataclass(frozen=True)
class Results:
    """What filters said in a number of runs; tables as in the files."""

    estimates: pd.DataFrame
    failures: pd.DataFrame
    truth: pd.DataFrame | None
    landmarks: pd.DataFrame | None
    manifest: dict[str, Any]

    @property
    def filters(self) -> list[str]:
        return list(self.manifest["filters"])

    @property
    def scenario(self) -> Scenario | None:
        """The scenario, or None for a recorded log."""
        data = self.manifest.get("scenario")
        try:
            return Scenario.model_validate(data) if data else None
        except ValidationError as error:
            raise InputError(f"manifest.json: key 'scenario': {explain(error, Scenario)}") from None

    def finished_runs(self, filters: Sequence[str]) -> set[int]:
        """Runs that every one of ``filters`` has finished, well or not."""
        per_filter = [
            set(self.estimates.loc[self.estimates["filter"] == name, "run"])
            | set(self.failures.loc[self.failures["filter"] == name, "run"])
            for name in filters
        ]
        return {int(run) for run in set.intersection(*per_filter)} if per_filter else set()

    def write(self, folder: Path, overwrite: bool = False, keep_others: bool = False) -> None:
        """Write the folder at once, as :func:`write_folder`: it appears complete or not at all."""
        tables = {"estimates": self.estimates, "failures": self.failures}
        tables |= {n: t for n, t in (("truth", self.truth), ("landmarks", self.landmarks)) if t is not None}
        write_folder(folder, tables, self.manifest, overwrite=overwrite, keep_others=keep_others)


def joined(parts: Sequence[Results]) -> Results:
    """Results of several filters on the same trials as one."""
    manifest = parts[0].manifest | {
        "filters": [name for part in parts for name in part.filters],
        "failures": sum(len(part.failures) for part in parts),
        "wall_time_s": round(sum(part.manifest["wall_time_s"] for part in parts), 3),
    }
    estimates = pd.concat([part.estimates for part in parts], ignore_index=True)
    failures = pd.concat([p.failures for p in parts if len(p.failures)] or [parts[0].failures], ignore_index=True)
    return replace(parts[0], estimates=estimates, failures=failures, manifest=manifest)


def estimates_table(outcomes: Sequence[tuple[Trial, list[Estimates]]]) -> pd.DataFrame:
    """``estimates.parquet`` of all outcomes, by filter, then as they come.

    A failed run has no rows from the failed step on.
    """
    by_filter = zip(*(said for _, said in outcomes), strict=True)
    pairs = [pair for said in by_filter for pair in zip((trial for trial, _ in outcomes), said, strict=True)]
    if not pairs:
        return _empty("estimates")
    parts = [_columns(trial, said) for trial, said in pairs]
    names = np.array([said.filter for _, said in pairs], dtype=object)
    rows = [len(part["step"]) for part in parts]
    return _table({"filter": pd.Series(np.repeat(names, rows), dtype="str")} | _stacked(parts))


def _columns(trial: Trial, estimates: Estimates) -> dict[str, Array]:
    last = estimates.failure.step - 1 if estimates.failure else trial.steps
    pose, P = estimates.pose[:last], estimates.covariance[:last]
    value = np.full(last, np.nan)
    if trial.truth is not None:
        first = next((k for k in range(last) if definiteness(P[k]) == 1), last)
        value[first:] = nees(pose_error(trial.truth[1 + first : last + 1], pose[first:]), P[first:])
    return {
        "run": np.full(last, estimates.run),
        "step": np.arange(1, last + 1),
        "t": trial.t[1 : last + 1],
        **dict(zip(POSE, pose.T, strict=True)),
        **{name: P[:, i, j] for name, (i, j) in COVARIANCE.items()},
        "nees": value,
        "nis": estimates.nis[:last],
        "nis_dof": estimates.nis_dof[:last],
    }


def _stacked(parts: Sequence[dict[str, Array]]) -> dict[str, Array]:
    """The same columns of all parts, one below the other."""
    return {column: np.concatenate([part[column] for part in parts]) for column in parts[0]}


def _table(columns: dict[str, Any]) -> pd.DataFrame:
    """A table around columns that nobody else has: pandas would copy them, at millions of rows half the memory."""
    return pd.DataFrame(columns, copy=False)


def truth_table(trials: Sequence[Trial]) -> pd.DataFrame:
    """``truth.parquet`` of the trials that have truth."""
    parts = [
        {
            "run": np.full(t.steps + 1, t.run),
            "step": np.arange(t.steps + 1),
            "t": t.t,
            **dict(zip(POSE, t.truth.T, strict=True)),
        }
        for t in trials
        if t.truth is not None
    ]
    return _table(_stacked(parts)) if parts else _empty("truth")


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
    """``observations.parquet``."""
    return pd.concat(
        [
            pd.DataFrame(
                {
                    "run": np.full(len(t.landmark), t.run),
                    "step": np.repeat(np.arange(1, t.steps + 1), np.diff(t.first)),
                    "landmark": t.landmark,
                    **dict(zip(["z0", "z1", "z2"], t.z.T, strict=True)),
                }
            )
            for t in trials
        ],
        ignore_index=True,
    )


def failures_table(failures: Sequence[Failure]) -> pd.DataFrame:
    """``failures.parquet``."""
    rows = [(f.filter, f.run, f.step, f.reason) for f in failures]
    return pd.DataFrame(rows, columns=list(COLUMNS["failures"])).astype(COLUMNS["failures"])


def _empty(name: str) -> pd.DataFrame:
    return pd.DataFrame({column: pd.Series(dtype=kind) for column, kind in COLUMNS[name].items()})


def covariances(table: pd.DataFrame) -> Array:
    """Pose covariances (N, 3, 3) from the columns P_xx ... P_hh."""
    P = np.empty((len(table), 3, 3))
    for name, (i, j) in COVARIANCE.items():
        P[:, i, j] = P[:, j, i] = table[name]
    return P


def read_results(folder: str | Path) -> Results:
    """Read a folder written by ``consistency run``.

    Raises
    ------
    InputError
        A file is missing, cut short, or lacks a column.
    """
    folder = Path(folder)
    manifest = read_manifest(folder)
    if "filters" not in manifest:
        raise InputError(f"{folder}: holds no estimates; it was not written by 'consistency run'")
    wanted = manifest.get("tables", [])
    tables = {name: read_parquet(folder, name) if name in wanted else None for name in ("truth", "landmarks")}
    return Results(
        read_parquet(folder, "estimates"),
        read_parquet(folder, "failures"),
        tables["truth"],
        tables["landmarks"],
        manifest,
    )
