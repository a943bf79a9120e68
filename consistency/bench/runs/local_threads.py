"""Runs in threads of this process: compiled filters release the GIL, other filters are waited for."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from itertools import islice
from queue import Empty, SimpleQueue

from consistency.bench.filters.compiled import one_blas_thread
from consistency.bench.runs.run_outcome import RunOutcome
from consistency.bench.runs.trial_work import Outcomes, TrialWork
from consistency.bench.runs.worker_count import worker_count

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
        fitting = work.room_for(trial, self._workers)
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
