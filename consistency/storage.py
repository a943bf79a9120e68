"""Output folders: tables and a manifest, written whole or not at all, and read back with checks."""

from __future__ import annotations

import functools
import json
import os
import platform
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from consistency.errors import InputError

SCHEMA_VERSION = 1
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
PACKAGES = (
    "filter-consistency", "numpy", "scipy", "numba", "filterpy", "pandas", "pyarrow", "joblib", "bokeh", "matplotlib",
    "typst",
)  # fmt: skip


# --- the manifest --------------------------------------------------------------------------------


def manifest_of(kind: str = "results", **fields: Any) -> dict[str, Any]:
    """Provenance that every output folder of a ``kind`` (results, log, findings) carries."""
    wall = fields.pop("wall", None)
    program = Path(sys.argv[0]).name
    return {
        "schema_version": SCHEMA_VERSION,
        "kind": kind,
        "versions": dict(_versions()),
        "command": shlex.join(["consistency" if program == "__main__.py" else program, *sys.argv[1:]]),
        "git_commit": _git_commit(),
        "wall_time_s": None if wall is None else round(wall, 3),
        **fields,
    }


@functools.cache
def _versions() -> tuple[tuple[str, str], ...]:
    """Python and the packages that results depend on; reading them takes milliseconds, so once a process."""
    found = [("python", platform.python_version())]
    for package in PACKAGES:
        try:
            found.append((package, metadata.version(package)))
        except metadata.PackageNotFoundError:
            found.append((package, "not installed"))
    return tuple(found)


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


def plain(value: Any) -> Any:
    """Arrays as lists, not finite numbers as None: what JSON can hold."""
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, np.generic):
        return plain(value.item())
    return None if isinstance(value, float) and not np.isfinite(value) else value


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
