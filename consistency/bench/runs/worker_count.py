"""Whether the covariances of a run fit into the memory of this machine, and for how many workers."""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from consistency.bench.types import Trial
from consistency.referee.errors import InputError
from consistency.referee.system.progress import say

CONTAINER_LIMIT = Path("/sys/fs/cgroup/memory.max")  # of a container or a control group, "max" where there is none
COPIES = 4  # covariances of the whole state: the filter's, the joint one it returns, and two to score the map
GIB = 2**30
POSE, LANDMARK = 3, 3  # variables of the state
WORTH_SAYING = 0.1  # share of the memory


def worker_count(jobs: int) -> int:
    """Number of workers that ``jobs`` stands for: itself, or one a core for -1; raises InputError for another."""
    if jobs == 0 or jobs < -1:
        raise InputError(f"jobs must be at least 1, or -1 for one worker a core, got {jobs}")
    if jobs > 0:
        return jobs
    import joblib  # slow to load

    return int(joblib.cpu_count())


def memory_here() -> int:
    """Return the bytes of memory of this machine or its container; 2**60 where neither is known."""
    memory_limits = [2**60]
    if hasattr(os, "sysconf") and "SC_PHYS_PAGES" in os.sysconf_names:
        memory_limits.append(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    with suppress(OSError, ValueError):
        memory_limits.append(int(CONTAINER_LIMIT.read_text(encoding="ascii")))
    return min(memory_limits)


def workers_that_fit(trials: Sequence[Trial], workers: int) -> int:
    """Return how many of ``workers`` have memory for the largest of ``trials``, and say so if they are fewer.

    Raises
    ------
    InputError
        A single covariance of the state exceeds the memory.
    """
    landmarks = max(len(set(trial.landmark.tolist())) for trial in trials)
    covariance_memory, machine_memory = 8 * (POSE + LANDMARK * landmarks) ** 2, memory_here()
    if covariance_memory > machine_memory:
        raise InputError(
            f"a covariance of {landmarks} landmarks takes {covariance_memory / GIB:.1f} GiB, and there are "
            f"{machine_memory / GIB:.1f} GiB; take fewer landmarks, or a machine with more memory"
        )
    run_memory = COPIES * covariance_memory
    fitting = max(1, min(workers, machine_memory // run_memory))
    if run_memory > WORTH_SAYING * machine_memory:
        say(
            f"consistency: a run of {landmarks} landmarks takes about {run_memory / GIB:.1f} of "
            f"{machine_memory / GIB:.1f} GiB; {fitting} of {workers} workers have room"
        )
    return fitting
