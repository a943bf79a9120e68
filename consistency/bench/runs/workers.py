"""Workers: threads of this machine, or batches of runs sent to any executor of :mod:`concurrent.futures`.

Compiled filters release the GIL, other filters are waited for.
"""

from __future__ import annotations

import os
import pickle
import platform
import socket
import time
from collections import deque
from collections.abc import Sequence
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache
from importlib.metadata import version
from itertools import count, islice
from multiprocessing import current_process
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import NoReturn

import joblib
from joblib.externals.loky.backend.reduction import dumps

from consistency.bench.filters.compiled import one_blas_thread
from consistency.bench.filters.run_filter import RunRecord, reason_of
from consistency.bench.protocols import error_of, name_of, rejects
from consistency.bench.runs.run_outcome import Outcomes, Recorded, RunOutcome, TrialWork, outcome_of
from consistency.bench.types import Trial
from consistency.referee.errors import InputError
from consistency.referee.system import digest_of_sources, in_words, say, this_machine

CONTAINER_LIMIT = Path("/sys/fs/cgroup/memory.max")  # of a container or a control group, "max" where there is none
COPIES = 4  # covariances of the whole state: the filter's, the joint one it returns, and two to score the map
GIB = 2**30
POSE, LANDMARK = 3, 3  # variables of the state
WORTH_SAYING = 0.1  # share of the memory
AHEAD = 2  # runs that wait for each worker, so that none waits for them
GLANCE = 0.1  # s between looks, for a signal that another thread was given
AT_A_TIME = 1000  # batches of an executor that does not say how many it should have
SECONDS = 1.5  # after which a batch comes back with what is done of it, where the executor does not say
DECIDING = ("numpy", "scipy", "numba")  # packages whose versions the bits depend on
# and our own sources
ROOMS = ("referee/geometry.py", "bench/scenario", "bench/simulation.py", "bench/filters")


def worker_count(jobs: int) -> int:
    """Number of workers that ``jobs`` stands for: itself, or one a core for -1; raises InputError for another."""
    if jobs == 0 or jobs < -1:
        raise InputError(f"jobs must be at least 1, or -1 for one worker a core, got {jobs}")
    if jobs > 0:
        return jobs
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


class LocalThreads:
    """Threads of this process; see :class:`consistency.bench.runs.run_outcome.Workers`.

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


@dataclass(frozen=True)
class Batch:
    """Runs that are sent together; ``is_alone`` says that nothing else is at work with them."""

    runs: tuple[int, ...]
    is_alone: bool = False


class Batches:
    """Runs that are to be done, in batches of equal shares.

    A batch that fails is sent again in halves, down to single runs. A single run that fails may have died by another
    one on the same worker, so it is sent once more when all else is done, alone. Failing then, it has failed.

    Parameters
    ----------
    at_a_time : batches that are with the executor, at most
    """

    def __init__(self, runs: Sequence[int], at_a_time: int) -> None:
        self._todo, self._halves, self._doubtful = deque(runs), deque[Batch](), deque[int]()
        self._at_a_time, self._in_flight = at_a_time, 0

    def next(self) -> Batch | None:
        """Take a batch to send now; None where nothing is left, or something has to come back first."""
        if self._in_flight >= self._at_a_time:
            return None
        if self._halves:
            batch = self._halves.popleft()
        elif self._todo:
            share = -(-len(self._todo) // (self._at_a_time - self._in_flight))
            batch = Batch(tuple(self._todo.popleft() for _ in range(share)))
        elif self._doubtful and not self._in_flight:
            batch = Batch((self._doubtful.popleft(),), is_alone=True)
        else:
            return None
        self._in_flight += 1
        return batch

    def came_back(self, left: Sequence[int]) -> None:
        """Take a batch back of whose runs some are ``left`` to do."""
        self._in_flight -= 1
        self._todo.extendleft(reversed(left))

    def has_failed(self, batch: Batch) -> bool:
        """Take a batch back whose worker died; return whether its run counts as failed."""
        self._in_flight -= 1
        middle = len(batch.runs) // 2
        if middle:
            self._halves += [Batch(batch.runs[:middle]), Batch(batch.runs[middle:])]
        elif not batch.is_alone:
            self._doubtful += batch.runs
        return batch.is_alone


class ExecutorWorkers:
    """The workers of any executor; see :class:`consistency.bench.runs.run_outcome.Workers`.

    An executor may say by ``at_a_time`` how many batches it should have, and by ``batch_seconds`` how long one takes.
    """

    def __init__(self, executor: Executor) -> None:
        self.executor = executor
        self._numbers = count()

    def prepare(self, work: TrialWork, run: int, /) -> None:
        """Do nothing: workers compile what they need."""

    def outcomes(self, work: TrialWork, runs: Sequence[int], /) -> Outcomes:
        """What each run leaves, in the order in which batches come back; what is not done is cancelled at the end.

        Raises
        ------
        InputError
            A filter needs what a trial does not have; a worker has other versions than this process; the executor has
            ended.
        """
        batches = Batches(runs, getattr(self.executor, "at_a_time", AT_A_TIME))
        sent: dict[Future[BatchResult], Batch] = {}
        finished = SimpleQueue[Future[BatchResult]]()
        machines: list[dict[str, str]] = []
        pickled_work = _pickled(work)
        try:
            while True:
                while (batch := batches.next()) is not None:
                    work_of_batch = work.only(batch.runs)
                    future = self._submit(pickled_work if work_of_batch is work else _pickled(work_of_batch), batch)
                    sent[future] = batch
                    future.add_done_callback(finished.put)
                if not sent:
                    return
                try:
                    future = finished.get(timeout=GLANCE)
                except Empty:
                    continue
                batch = sent.pop(future)
                result = _result_of(future)
                if isinstance(result, str):
                    if batches.has_failed(batch):
                        yield failed(work, batch.runs[0], result)
                    continue
                require_same_versions(result)
                _say_new(result.machine, machines)
                outcomes = result.outcomes()
                batches.came_back(batch.runs[len(outcomes) :])
                yield from outcomes
                if result.refusal:
                    raise InputError(result.refusal)
                if result.fault:
                    raise RuntimeError(f"a worker failed: {result.fault}")
        finally:
            for future in sent:
                future.cancel()

    def _submit(self, pickled: bytes, batch: Batch) -> Future[BatchResult]:
        seconds = getattr(self.executor, "batch_seconds", SECONDS)
        try:
            return self.executor.submit(do_batch, pickled, batch.runs, seconds, next(self._numbers))
        except BrokenExecutor as error:
            _refuse(error)


def _pickled(work: TrialWork) -> bytes:
    """Work as it is sent; classes from ``__main__`` go with it."""
    return bytes(dumps(work))


def _result_of(future: Future[BatchResult]) -> BatchResult | str:
    """What a batch left, or why who did it is dead."""
    try:
        return future.result()
    except InputError:
        raise
    except (BrokenExecutor, CancelledError) as error:
        _refuse(error)
    except ImportError as error:
        raise InputError(f"a worker lacks this package ({error}); install there what is installed here") from None
    except Exception as error:
        return f"its worker died ({type(error).__name__})"


def _refuse(error: Exception) -> NoReturn:
    """Say that the executor has ended; like a full disk it is not a fault of the runs, which a resume does."""
    raise InputError(f"the executor has ended ({reason_of(error)})") from ConnectionError(str(error))


def failed(work: TrialWork, run: int, reason: str) -> RunOutcome:
    """What a run leaves that could not be done: all filters have failed in step 1."""
    trial = work.trials(run)
    record = RunRecord.empty(trial.steps, len(trial.landmark))
    return outcome_of(
        trial,
        [record.estimates(name_of(f), trial.run, error_of(f), reason=reason, guarded=rejects(f)) for f in work.filters],
    )


def _say_new(machine: dict[str, str], machines: list[dict[str, str]]) -> None:
    """Say that the workers are not all alike, once for each that is not."""
    if machine in machines:
        return
    machines.append(machine)
    if len(machines) > 1:
        say(
            f"consistency: the workers differ, {in_words(machines)}: the last digits of the results may differ from "
            "those of one machine"
        )


# --- the far side: a batch, wherever it is done, and what it sends back --------------------------


PACKAGE = Path(__file__).parents[2]


@dataclass(frozen=True)
class BatchResult:
    """What the first runs of a batch left, and who did them; it can be read wherever the versions differ.

    Attributes
    ----------
    pickled : outcomes in one buffer, as an executor would send each array by itself
    refusal : bad input that ended the batch
    fault : any other exception that did
    """

    pickled: bytes
    host: str
    machine: dict[str, str]
    versions: dict[str, str]
    refusal: str = ""
    fault: str = ""

    def outcomes(self) -> list[RunOutcome]:
        outcomes: list[RunOutcome] = pickle.loads(self.pickled)
        return [replace(outcome, machine=self.machine) for outcome in outcomes]


def do_batch(pickled: bytes, runs: Sequence[int], seconds: float, number: int) -> BatchResult:
    """Do runs of pickled work one after the other, until ``seconds`` have passed.

    The ``number`` of the batch makes its arguments unlike those of all others: some executors remember results.
    """
    current_process().daemon = False  # so that it may start processes: they end with it, whatever ends it
    outcomes: list[RunOutcome] = []
    refusal = fault = ""
    try:
        work: TrialWork = pickle.loads(pickled)
        with one_blas_thread(), work.isolation:
            started = time.monotonic()
            for run in runs:
                outcomes.append(work(run))
                if time.monotonic() - started >= seconds:
                    break
    except InputError as error:
        refusal = str(error)
    except ImportError as error:
        refusal = f"a worker cannot load the work ({error}); install there what is installed here"
    except Exception as error:
        fault = reason_of(error)
    pickled_outcomes = pickle.dumps(outcomes, pickle.HIGHEST_PROTOCOL)
    return BatchResult(pickled_outcomes, socket.gethostname(), this_machine(), versions_here(), refusal, fault)


@cache
def versions_here() -> dict[str, str]:
    """What a worker must have in common with the process that it works for."""
    package_version = f"{version('filter-consistency')} (sources {digest_of_sources(PACKAGE, ROOMS)[:12]})"
    python = ".".join(platform.python_version_tuple()[:2])  # classes from __main__ are sent as its bytecode
    return {"filter-consistency": package_version, "Python": python} | {name: version(name) for name in DECIDING}


def require_same_versions(result: BatchResult) -> None:
    """Refuse what was done with other versions.

    Raises
    ------
    InputError
        Versions differ; names the host and the first of them.
    """
    for name, version_here in versions_here().items():
        if (version_there := result.versions.get(name)) != version_here:
            raise InputError(
                f"the worker on {result.host} has {name} {version_there}, here it is {version_here}; install the same "
                "version there"
            )
