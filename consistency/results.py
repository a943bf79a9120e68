"""Tables and a manifest on disk: written whole or not at all, and read back with clear complaints."""

from __future__ import annotations

import json
import os
import platform
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from pydantic import ValidationError

from consistency.diagnostics import nees
from consistency.errors import InputError
from consistency.filters.linalg import definiteness
from consistency.geometry import pose_error
from consistency.scenario import Scenario, explain
from consistency.types import Array, Estimates, Failure, Trial

SCHEMA_VERSION = 1
POSE = ["x", "y", "heading"]
COVARIANCE = {"P_xx": (0, 0), "P_xy": (0, 1), "P_xh": (0, 2), "P_yy": (1, 1), "P_yh": (1, 2), "P_hh": (2, 2)}
COLUMNS: dict[str, dict[str, str]] = {
    "landmarks": {"landmark": "int64", "x": "float64", "y": "float64", "z": "float64"},
    "truth": {"run": "int64", "step": "int64", "t": "float64", "x": "float64", "y": "float64", "heading": "float64"},
    "controls": {"run": "int64", "step": "int64", "dt": "float64", "v": "float64", "omega": "float64"},
    "observations": {
        "run": "int64", "step": "int64", "landmark": "int64", "z0": "float64", "z1": "float64", "z2": "float64",
    },
    "estimates": {
        "filter": "str", "run": "int64", "step": "int64", "t": "float64", "x": "float64", "y": "float64",
        "heading": "float64", **dict.fromkeys(COVARIANCE, "float64"), "nees": "float64", "nis": "float64",
        "nis_dof": "int64",
    },
    "failures": {"filter": "str", "run": "int64", "step": "int64", "reason": "str"},
}  # fmt: skip
NULLABLE = {"nees", "nis"}


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


# --- tables from arrays ------------------------------------------------------------------------


def estimates_table(outcomes: Sequence[tuple[Trial, list[Estimates]]]) -> pd.DataFrame:
    """``estimates.parquet`` of all outcomes; a failed run has no rows from the failed step on."""
    parts = [_estimates(trial, estimates) for trial, each in outcomes for estimates in each]
    return pd.concat(parts, ignore_index=True) if parts else _empty("estimates")


def _estimates(trial: Trial, estimates: Estimates) -> pd.DataFrame:
    last = estimates.failure.step - 1 if estimates.failure else trial.steps
    pose, P = estimates.pose[:last], estimates.covariance[:last]
    value = np.full(last, np.nan)
    if trial.truth is not None:
        first = next((k for k in range(last) if definiteness(P[k]) == 1), last)
        value[first:] = nees(pose_error(trial.truth[1 + first : last + 1], pose[first:]), P[first:])
    return pd.DataFrame(
        {
            "filter": pd.Series([estimates.filter] * last, dtype="str"),
            "run": np.full(last, estimates.run),
            "step": np.arange(1, last + 1),
            "t": trial.t[1 : last + 1],
            **dict(zip(POSE, pose.T, strict=True)),
            **{name: P[:, i, j] for name, (i, j) in COVARIANCE.items()},
            "nees": value,
            "nis": estimates.nis[:last],
            "nis_dof": estimates.nis_dof[:last],
        }
    )


def truth_table(trials: Sequence[Trial]) -> pd.DataFrame:
    """``truth.parquet`` of the trials that have truth."""
    parts = [
        pd.DataFrame(
            {
                "run": np.full(t.steps + 1, t.run),
                "step": np.arange(t.steps + 1),
                "t": t.t,
                **dict(zip(POSE, t.truth.T, strict=True)),
            }
        )
        for t in trials
        if t.truth is not None
    ]
    return pd.concat(parts, ignore_index=True) if parts else _empty("truth")


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


# --- the manifest --------------------------------------------------------------------------------


def manifest_of(kind: str = "results", **fields: Any) -> dict[str, Any]:
    """Provenance that every output folder of a ``kind`` (results, log, findings) carries."""
    packages = (
        "filter-consistency",
        "numpy",
        "scipy",
        "numba",
        "filterpy",
        "pandas",
        "pyarrow",
        "joblib",
        "bokeh",
        "matplotlib",
        "typst",
    )
    versions = {"python": platform.python_version()}
    for package in packages:
        try:
            versions[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            versions[package] = "not installed"
    wall = fields.pop("wall", None)
    program = Path(sys.argv[0]).name
    return {
        "schema_version": SCHEMA_VERSION,
        "kind": kind,
        "versions": versions,
        "command": shlex.join(["consistency" if program == "__main__.py" else program, *sys.argv[1:]]),
        "git_commit": _git_commit(),
        "wall_time_s": None if wall is None else round(wall, 3),
        **fields,
    }


def _git_commit() -> str | None:
    """Commit of the checkout that the package runs from, with ``-dirty`` where it was changed; None elsewhere."""
    root = Path(__file__).parents[1]

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(root), *arguments]
        return subprocess.run(command, capture_output=True, text=True, timeout=5, check=True).stdout.strip()

    try:
        if Path(git("rev-parse", "--show-toplevel")) != root:  # installed inside somebody else's repository
            return None
        dirty = git("status", "--porcelain", "--untracked-files=no")
        return git("rev-parse", "HEAD") + ("-dirty" if dirty else "")
    except (OSError, subprocess.SubprocessError):
        return None


# --- writing -------------------------------------------------------------------------------------


def require_free(folder: Path, overwrite: bool, kind: str = "results") -> None:
    """Refuse, before any work, a folder that exists or cannot be made.

    With ``overwrite`` only a folder that this bench wrote may be replaced, and only by one of its own
    ``kind`` (results, log, findings).
    """
    if folder.exists() or folder.is_symlink():
        if not overwrite:
            raise InputError(f"--out {folder}: exists already; choose another folder or add --overwrite")
        try:
            before = read_manifest(folder).get("kind")
            if before != kind:
                raise InputError(f"it holds {before}, not {kind}")
        except InputError as error:
            raise InputError(
                f"--out {folder}: is not an output folder of this bench; not overwritten ({error})"
            ) from None
    there = next(parent for parent in folder.absolute().parents if parent.exists())
    try:
        with tempfile.TemporaryDirectory(dir=there, prefix=f".{folder.name}."):
            pass
    except OSError as error:
        raise InputError(f"--out {folder}: cannot be written ({error.strerror})") from None


def write_folder(
    folder: Path,
    tables: dict[str, pd.DataFrame],
    manifest: dict[str, Any],
    extra: Callable[[Path], None] | None = None,
    overwrite: bool = False,
    keep_others: bool = False,
) -> None:
    """Tables as Parquet, the manifest, and whatever ``extra`` writes, moved into place as a whole.

    The manifest says what ``kind`` of folder it is, and gets the names of the tables. With ``overwrite``
    an output folder of this bench is replaced; with ``keep_others`` the files in it that are not written
    again stay.
    """
    require_free(folder, overwrite, manifest["kind"])
    manifest = manifest | {"tables": sorted(tables)}
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        partial = Path(tempfile.mkdtemp(dir=folder.parent, prefix=f".{folder.name}."))
        try:
            for name, table in tables.items():
                frame = table[list(COLUMNS[name])].astype(COLUMNS[name])
                frame.to_parquet(partial / f"{name}.parquet", compression="zstd", index=False)
            if extra is not None:
                extra(partial)
            (partial / "manifest.json").write_text(json.dumps(manifest, indent=2) + "\n", encoding="utf-8")
            partial.chmod(0o755)
            _put_in_place(partial, folder, keep_others)
        finally:
            shutil.rmtree(partial, ignore_errors=True)
    except OSError as error:
        raise InputError(f"--out {folder}: cannot be written ({error.strerror or error})") from error


def _put_in_place(partial: Path, folder: Path, keep_others: bool) -> None:
    if not folder.exists():
        os.replace(partial, folder)
        return
    if keep_others:
        for path in folder.iterdir():
            if not (partial / path.name).exists():
                copy = shutil.copytree if path.is_dir() else shutil.copy2
                copy(path, partial / path.name)
    aside = Path(tempfile.mkdtemp(dir=folder.parent, prefix=f".{folder.name}."))
    os.replace(folder, aside / "old")
    os.replace(partial, folder)
    shutil.rmtree(aside)


# --- reading -------------------------------------------------------------------------------------


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


def read_manifest(folder: Path) -> dict[str, Any]:
    """``manifest.json`` of an output folder."""
    path = folder / "manifest.json"
    if not folder.is_dir():
        raise InputError(f"{folder}: {'a file, not a folder' if folder.exists() else 'no such folder'}")
    try:
        manifest = json.loads(path.read_text(encoding="utf-8"))
    except OSError:
        raise InputError(f"{path}: missing; give a folder that 'consistency' wrote") from None
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: not valid JSON ({error})") from None
    if not isinstance(manifest, dict) or manifest.get("schema_version") != SCHEMA_VERSION:
        raise InputError(f"{path}: key 'schema_version' must be {SCHEMA_VERSION}; write the folder again")
    return manifest


def read_parquet(folder: Path, name: str) -> pd.DataFrame:
    """One table of a folder, checked: columns, types, no NaN where none is allowed."""
    path = folder / f"{name}.parquet"
    try:
        table = pq.read_table(path).to_pandas()
    except FileNotFoundError:
        raise InputError(f"{path}: missing; write the folder again") from None
    except (OSError, pa.ArrowException) as error:
        first = str(error).splitlines()[0]
        raise InputError(f"{path}: cannot be read, damaged or cut short ({first})") from None
    wanted = COLUMNS[name]
    if missing := [column for column in wanted if column not in table.columns]:
        raise InputError(f"{path}: column '{missing[0]}' is missing; needed: {', '.join(wanted)}")
    for column, kind in wanted.items():
        _check_column(path, table, column, kind)
    checked: pd.DataFrame = table[list(wanted)].astype(wanted)
    return checked


def _check_column(path: Path, table: pd.DataFrame, column: str, kind: str) -> None:
    if kind == "str":
        return
    values = pd.to_numeric(table[column], errors="coerce").to_numpy(float)
    if column in NULLABLE:
        values = np.where(table[column].isna(), 0.0, values)
    if not np.isfinite(values).all():
        row = int(np.flatnonzero(~np.isfinite(values))[0])
        raise InputError(f"{path}: column '{column}', row {row}: not a finite number ({table[column].iloc[row]})")
    if kind == "int64" and (values != np.round(values)).any():
        row = int(np.flatnonzero(values != np.round(values))[0])
        raise InputError(f"{path}: column '{column}', row {row}: not a whole number ({values[row]})")
