"""Which processor computes, and by which code of BLAS: the last bits of results depend on both."""

from __future__ import annotations

import functools
import platform
from collections.abc import Iterable, Mapping
from pathlib import Path

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
    """``cpu``: model of the processor; ``blas``: for which architecture the loaded BLAS has chosen its code."""
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
