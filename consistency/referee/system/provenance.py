"""Where a file came from, and which machine computed it."""

from __future__ import annotations

import functools
import platform
import shlex
import subprocess
import sys
from collections.abc import Iterable, Mapping
from datetime import datetime, timezone
from importlib import metadata
from pathlib import Path
from typing import Any

NOT_OURS = ("opencv",)  # brings a BLAS of its own, with which no run is computed


@functools.cache
def _found() -> tuple[tuple[str, str], ...]:
    try:
        from threadpoolctl import threadpool_info
    except ImportError:  # nothing is simulated then
        libraries = []
    else:
        libraries = [library for library in threadpool_info() if library["user_api"] == "blas"]
    ours = [library for library in libraries if not any(name in library["filepath"] for name in NOT_OURS)]
    cores = sorted({str(library.get("architecture")) for library in ours})
    return ("cpu", _cpu()), ("blas", ", ".join(cores) or "unknown")


def this_machine() -> dict[str, str]:
    """``cpu``: model of the processor; ``blas``: for which architecture the loaded BLAS has chosen its code.

    The last bits of results depend on both.
    """
    return dict(_found())


def in_words(machines: Iterable[Mapping[str, str]]) -> str:
    """Machines as :func:`this_machine` has them, for a sentence."""
    return " and ".join(f"{machine.get('cpu')} (BLAS: {machine.get('blas')})" for machine in machines)


def _cpu() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.processor() or platform.machine() or "unknown"


SCHEMA_VERSION = 1
PACKAGES = (
    "filter-consistency", "numpy", "scipy", "numba", "filterpy", "pandas", "pyarrow", "joblib", "matplotlib",
    "typst",
)  # fmt: skip


def manifest_of(kind: str = "results", **fields: Any) -> dict[str, Any]:
    """Provenance that every output folder of a ``kind`` (results, log, findings) carries."""
    wall = fields.pop("wall", None)
    program = Path(sys.argv[0]).name
    return {
        "schema_version": SCHEMA_VERSION,
        "kind": kind,
        "date": datetime.now(timezone.utc).date().isoformat(),
        "versions": dict(_versions()),
        "machines": [this_machine()],
        "command": shlex.join(["consistency" if program == "__main__.py" else program, *sys.argv[1:]]),
        "git_commit": _git_commit(),
        "wall_time_s": None if wall is None else round(wall, 3),
        **fields,
    }


@functools.cache
def _versions() -> tuple[tuple[str, str], ...]:
    """Python and the packages that results depend on; reading them takes milliseconds, so once a process."""
    versions = [("python", platform.python_version())]
    for package in PACKAGES:
        try:
            versions.append((package, metadata.version(package)))
        except metadata.PackageNotFoundError:
            versions.append((package, "not installed"))
    return tuple(versions)


@functools.cache
def _git_commit() -> str | None:
    """Commit of the checkout that the package runs from, with ``-dirty`` where it was changed; None elsewhere.

    Asked once a process, as its modules are read once.
    """
    root = Path(__file__).parents[3]
    if not (root / ".git").exists():  # installed, perhaps inside somebody else's repository
        return None
    command = ["git", "-C", str(root), "status", "--porcelain=v2", "--branch", "--untracked-files=no"]
    try:
        lines = subprocess.run(command, capture_output=True, text=True, timeout=5, check=True).stdout.splitlines()
    except (OSError, subprocess.SubprocessError):
        return None
    commit = next((line.split()[-1] for line in lines if line.startswith("# branch.oid ")), "(initial)")
    dirty = any(not line.startswith("#") for line in lines)
    return None if commit == "(initial)" else commit + ("-dirty" if dirty else "")
