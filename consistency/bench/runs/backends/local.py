"""The workers of this machine."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import islice
from queue import Empty, SimpleQueue

from consistency.bench.filters.compiled import one_blas_thread
from consistency.bench.runs.trial_work import Outcomes, TrialWork
from consistency.bench.store.trial_rows import RunOutcome
from consistency.referee.errors import InputError

AHEAD = 2  # runs that wait for each worker, so that none waits for them
GLANCE = 0.1  # s between looks, for a signal that another thread was given


@dataclass
class LocalThreads:
    """Threads: compiled filters release the GIL, and who waits for the process of another filter does.

    Parameters
    ----------
    jobs : number of workers, -1 for one a core
    """

    jobs: int = -1

    _room: int = field(default=sys.maxsize, init=False, repr=False, compare=False)  # workers that have memory

    def __post_init__(self) -> None:
        worker_count(self.jobs)

    def prepare(self, work: TrialWork, run: int, /) -> None:
        """See :class:`consistency.bench.runs.trial_work.Backend`."""
        workers = worker_count(self.jobs)
        fitting = work.room_for(run, workers)
        self._room = fitting if self.jobs == -1 else workers
        work.compile(run, workers)

    def outcomes(self, work: TrialWork, runs: Sequence[int], /) -> Outcomes:
        """See :class:`consistency.bench.runs.trial_work.Backend`."""
        workers = min(worker_count(self.jobs), len(runs), self._room)
        with one_blas_thread():
            if workers > 1:
                yield from _in_threads(work, runs, workers)
            else:
                with work.isolation:
                    yield from map(work, runs)


def _in_threads(work: TrialWork, runs: Sequence[int], workers: int) -> Outcomes:
    pool, todo, under_way = ThreadPoolExecutor(workers), iter(runs), 0
    finished = SimpleQueue[Future[RunOutcome]]()  # unlike a condition it bears a signal while one waits for it
    try:
        with work.isolation:  # left first, so that no thread waits for a process that hangs
            while True:
                for run in islice(todo, AHEAD * workers - under_way):
                    pool.submit(work, run).add_done_callback(finished.put)
                    under_way += 1
                if not under_way:
                    break
                ready = list[Future[RunOutcome]]()
                with suppress(Empty):
                    ready.append(finished.get(timeout=GLANCE))
                    while True:
                        ready.append(finished.get_nowait())
                under_way -= len(ready)
                # what is finished counts, whatever ends the rest
                ready.sort(key=lambda future: future.exception() is not None, reverse=True)
                while ready:
                    yield ready.pop().result()
    finally:
        pool.shutdown(cancel_futures=True)


def worker_count(jobs: int) -> int:
    """Number of workers that ``jobs`` stands for: itself, or one a core for -1; raises InputError for another."""
    if jobs == 0 or jobs < -1:
        raise InputError(f"jobs must be at least 1, or -1 for one worker a core, got {jobs}")
    if jobs > 0:
        return jobs
    import joblib  # slow to load

    return int(joblib.cpu_count())
