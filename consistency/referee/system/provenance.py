"""Where a file came from, and which machine computed it."""

from __future__ import annotations

import functools
import platform
import shlex
import subprocess
import sys
from collections.abc import Iterable, Mapping
from contextlib import suppress
from datetime import datetime, timezone
from importlib import metadata
from pathlib import Path
from typing import Any

NOT_OURS = "opencv"  # brings a BLAS of its own, with which no run is computed


@functools.cache
def _found() -> tuple[tuple[str, str], ...]:
    cores = set()
    with suppress(ImportError):  # nothing is simulated then
        from threadpoolctl import threadpool_info

        for library in threadpool_info():
            if library["user_api"] == "blas" and NOT_OURS not in library["filepath"]:
                cores.add(str(library.get("architecture")))
    return ("cpu", _cpu()), ("blas", ", ".join(sorted(cores)) or "unknown")


def this_machine() -> dict[str, str]:
    """``cpu``: model of the processor; ``blas``: for which architecture the loaded BLAS has chosen its code.

    The last bits of results depend on both.
    """
    return dict(_found())


def in_words(machines: Iterable[Mapping[str, str]]) -> str:
    """Machines as :func:`this_machine` has them, for a sentence."""
    return " and ".join(f"{machine.get('cpu')} (BLAS: {machine.get('blas')})" for machine in machines)


def _cpu() -> str:
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor() or platform.machine() or "unknown"


SCHEMA_VERSION = 1
PACKAGES = (
    "filter-consistency", "numpy", "scipy", "numba", "filterpy", "pandas", "pyarrow", "joblib", "matplotlib",
    "typst",
)  # fmt: skip


def manifest_of(kind: str = "results", **fields: Any) -> dict[str, Any]:
    """Provenance that every output folder of a ``kind`` (results, log, findings) carries."""
    wall = fields.pop("wall", None)
    if wall is not None:
        wall = round(wall, 3)
    program = Path(sys.argv[0]).name
    if program == "__main__.py":
        program = "consistency"
    return {
        "schema_version": SCHEMA_VERSION,
        "kind": kind,
        "date": datetime.now(timezone.utc).date().isoformat(),
        "versions": dict(_versions()),
        "machines": [this_machine()],
        "command": shlex.join([program, *sys.argv[1:]]),
        "git_commit": _git_commit(),
        "wall_time_s": wall,
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
    commit, changed = None, ""
    for line in lines:
        if line.startswith("# branch.oid "):
            commit = line.split()[-1]
        elif not line.startswith("#"):
            changed = "-dirty"
    if commit in (None, "(initial)"):
        return None
    return f"{commit}{changed}"
