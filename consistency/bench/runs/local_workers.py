"""Workers of this machine: how many, as many as have memory, and runs in their threads.

Compiled filters release the GIL, other filters are waited for.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from itertools import islice
from pathlib import Path
from queue import Empty, SimpleQueue

from consistency.bench.filters.compiled import one_blas_thread
from consistency.bench.runs.run_outcome import RunOutcome
from consistency.bench.runs.trial_work import Outcomes, Recorded, TrialWork
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


AHEAD = 2  # runs that wait for each worker, so that none waits for them
GLANCE = 0.1  # s between looks, for a signal that another thread was given


class LocalThreads:
    """Threads of this process; see :class:`consistency.bench.runs.trial_work.Workers`.

    Parameters
    ----------
    jobs : number of workers, -1 for one a core
    """

    def __init__(self, jobs: int = -1) -> None:
        self.jobs, self._workers = jobs, worker_count(jobs)

    def prepare(self, work: TrialWork, run: int, /) -> None:
        """Compile what is missing, and take fewer workers where memory lacks for all that ``jobs`` = -1 means."""
        if not work.isolation.compiled:
            return
        trial = work.trials(run)
        # the trials of a scenario are alike, so that one speaks for all; of a log all are looked at
        trials = list(work.trials.trials.values()) if isinstance(work.trials, Recorded) else [trial]
        fitting = workers_that_fit(trials, self._workers)
        if self.jobs == -1:
            self._workers = fitting
        work.compile(trial, self._workers)

    def outcomes(self, work: TrialWork, runs: Sequence[int], /) -> Outcomes:
        """What each run leaves, in the order in which they end.

        Where this is closed, or KeyboardInterrupt comes, processes of filters are killed, and compiled trials end.
        """
        workers = min(self._workers, len(runs))
        todo, under_way, finished = iter(runs), 0, SimpleQueue[Future[RunOutcome]]()
        pool = ThreadPoolExecutor(workers)
        try:
            with one_blas_thread(), work.isolation:  # left before the pool, so that no thread waits for what hangs
                while True:
                    for run in islice(todo, AHEAD * workers - under_way):
                        pool.submit(work, run).add_done_callback(finished.put)
                        under_way += 1
                    if not under_way:
                        return
                    ready = _ready(finished)
                    under_way -= len(ready)
                    while ready:  # an outcome that was taken is not held
                        yield ready.pop(0).result()
        finally:
            pool.shutdown(cancel_futures=True)


def _ready(finished: SimpleQueue[Future[RunOutcome]]) -> list[Future[RunOutcome]]:
    """Runs that have ended, those without an exception first: what is finished counts, whatever ends the rest."""
    ready: list[Future[RunOutcome]] = []
    with suppress(Empty):
        ready.append(finished.get(timeout=GLANCE))
        while True:
            ready.append(finished.get_nowait())
    return sorted(ready, key=lambda future: future.exception() is not None)
