"""What ``bench.py`` measures of the whole program: workers, time outside the kernels, memory, start.

``bench_whole.py RUNS STEPS`` is the child whose peak memory is measured: runs of two filters, streamed and judged.
"""

from __future__ import annotations

import contextlib
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from bench_trials import Work, interleaved

import consistency as cs
from consistency.bench.filters.compiled import Compiled
from consistency.bench.simulation import World

WORLD, FILTERS = "herath2007-stereo", ["ekf-uvd", "ukf-uvd"]
MIB = 2.0**20


@contextlib.contextmanager
def _silent() -> Iterator[None]:
    with open(os.devnull, "w") as nowhere, contextlib.redirect_stderr(nowhere):
        yield


def workers(runs: int, repeats: int, steps: int = 500) -> dict[str, float]:
    """Median seconds with 1 and with 2 workers, and of bare dgemm in one and two threads: what the machine gives."""
    world = cs.load_scenario(WORLD).variant("bench", truth__steps=steps)
    works: dict[str, Work] = {str(jobs): partial(cs.run_trials, world, FILTERS, runs, jobs=jobs) for jobs in (1, 2)}
    works |= {"one thread": partial(_multiply, [100]), "two threads": partial(_multiply, [50, 50])}
    with _silent():
        return interleaved(works, repeats)


def _multiply(counts: list[int]) -> None:
    """Products of matrices, so many in each thread; NumPy lets other threads run meanwhile."""
    A = np.ones((500, 500))

    def some(count: int) -> None:
        for _ in range(count):
            A @ A

    with ThreadPoolExecutor(len(counts)) as pool:
        list(pool.map(some, counts))


class Clock:
    """Seconds spent in functions that are replaced while the clock is open."""

    def __init__(self) -> None:
        self.seconds = 0.0

    @contextlib.contextmanager
    def on(self, owner: Any, name: str) -> Iterator[None]:
        original = getattr(owner, name)

        def timed(*args: Any, **kwargs: Any) -> Any:
            started = time.perf_counter()
            try:
                return original(*args, **kwargs)
            finally:
                self.seconds += time.perf_counter() - started

        setattr(owner, name, timed)
        try:
            yield
        finally:
            setattr(owner, name, original)


def share_outside(runs: int, steps: int, filters: list[str], repeats: int) -> float:
    """Median share of the wall time of ``run_trials`` that is spent neither simulating nor in a filter's ``run``."""
    world = cs.load_scenario(WORLD).variant("bench", truth__steps=steps)
    shares = []
    for _ in range(repeats + 1):  # the first warms up
        clock = Clock()
        with _silent(), clock.on(World, "__init__"), clock.on(World, "trial"), clock.on(Compiled, "run"):
            started = time.perf_counter()
            cs.run_trials(world, filters, runs, jobs=1)
            wall = time.perf_counter() - started
        shares.append(1.0 - clock.seconds / wall)
    return float(np.median(shares[1:]))


# --- processes ---------------------------------------------------------------------------------------


def child(runs: int, steps: int) -> dict[str, float]:
    """Peak memory in MiB and bytes a row of estimates on disk, of this process after ``runs`` runs and verdicts."""
    world = cs.load_scenario(WORLD).variant("bench", truth__steps=steps)
    with tempfile.TemporaryDirectory() as scratch:
        out = Path(scratch) / "out"
        results = cs.run_trials(world, FILTERS, runs, out=out)
        cs.analyse(results)
        rows = sum(len(batch["step"]) for batch in results.batches("estimates", ["step"]))
        size = (out / "estimates.parquet").stat().st_size
    return {"runs": runs, "peak_mib": peak_mib(), "rows": rows, "bytes": size}


def peak_mib() -> float:
    """Peak resident memory of this process.

    Linux starts ``ru_maxrss`` at what the parent had when it forked, and the bench has more than its children.
    """
    status = Path("/proc/self/status")
    if status.exists():
        kib = next(line.split()[1] for line in status.read_text().splitlines() if line.startswith("VmHWM"))
        return float(kib) / 1024.0
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (MIB if sys.platform == "darwin" else 1024.0)


def memory(runs: tuple[int, ...], steps: int = 500) -> list[dict[str, float]]:
    """:func:`child` of each number of runs, in processes of their own."""
    return [json.loads(_process([__file__, str(count), str(steps)])) for count in runs]


def extrapolated(points: list[dict[str, float]], runs: int) -> float | None:
    """Peak in MiB at ``runs`` runs, on the line through the first and the last point; None if it does not rise."""
    a, b = points[0], points[-1]
    if b["runs"] == runs:
        return b["peak_mib"]
    if b["peak_mib"] <= a["peak_mib"]:
        return None
    return a["peak_mib"] + (b["peak_mib"] - a["peak_mib"]) / (b["runs"] - a["runs"]) * (runs - a["runs"])


def help_seconds(repeats: int = 5) -> float:
    """Median wall time of ``consistency --help``."""
    return float(np.median([_seconds(["-m", "consistency", "--help"]) for _ in range(repeats)]))


def first_and_second_run(runs: int, again: int = 3) -> tuple[float, float]:
    """Wall time of ``consistency run`` with no compiled kernel on disk, and the median of those after it."""
    with tempfile.TemporaryDirectory() as scratch:
        fresh = {"NUMBA_CACHE_DIR": f"{scratch}/numba", "XDG_CACHE_HOME": f"{scratch}/cache"}
        command = ["-m", "consistency", "run", WORLD, "--filter", "ekf-uvd", "--runs", str(runs), "--out"]
        first, *later = (_seconds([*command, f"{scratch}/{k}"], fresh) for k in range(again + 1))
    return first, float(np.median(later))


def _seconds(arguments: list[str], environment: dict[str, str] | None = None) -> float:
    started = time.perf_counter()
    _process(arguments, environment)
    return time.perf_counter() - started


def _process(arguments: list[str], environment: dict[str, str] | None = None) -> str:
    done = subprocess.run(
        [sys.executable, *arguments], env=os.environ | (environment or {}), capture_output=True, text=True, check=False
    )
    if done.returncode:
        raise RuntimeError(f"{' '.join(arguments)}: exit status {done.returncode}\n{done.stderr}")
    return done.stdout


if __name__ == "__main__":
    with _silent():
        measured = child(*(int(value) for value in sys.argv[1:3]))
    print(json.dumps(measured))
