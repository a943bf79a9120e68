"""Filters that are not compiled, in processes that can be killed: at their time-out, for their memory, at the end.

A filter may do anything to its process: crash, hang, exit, eat memory, print without bound. Its run has then failed
with a reason, and the study continues. Processes are those of Pebble, one worker a pool, started by joblib's loky so
that a script needs no guard on ``__main__``.
"""

from __future__ import annotations

import contextlib
import importlib
import os
import pickle
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor, TimeoutError, wait
from dataclasses import dataclass, replace
from functools import cache
from multiprocessing import current_process
from multiprocessing.connection import Connection
from multiprocessing.util import Finalize
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from consistency.bench.filters.compiled import Compiled
from consistency.bench.filters.run_filter import RunRecord, reason_of, run_filter
from consistency.bench.protocols import Filter, error_of, name_of, rejects
from consistency.bench.runs.process_start import begin, nothing
from consistency.bench.scenario import Belief
from consistency.bench.types import Estimates, Trial
from consistency.referee.errors import InputError
from consistency.referee.system import link_to_parent

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]

KILLED = (-signal.SIGTERM, -getattr(signal, "SIGKILL", signal.SIGTERM))  # exit codes; no filter ends itself so
GLANCE = 0.5  # s between looks at whether a process still lives
LOADING = 60.0  # s that loading a filter may take where there is a time-out
SHOWN = 2**14  # bytes of what the filters in a process print that are shown
_lock = threading.Lock()
_idle: list[_Worker] = []  # of earlier studies, as starting one takes seconds
GIB = 2**30
BY_VALUE = "<dynamic-code>"  # cloudpickle's name for the file of a class that travels by value, as those of a script


@cache
def _starter() -> ThreadPoolExecutor:
    """Return a thread that never ends and starts all workers: on Linux they end with the thread that started them."""
    Finalize(None, dismiss, exitpriority=10)  # before a worker of multiprocessing, which has no atexit, waits for them
    return ThreadPoolExecutor(1)


class Isolation:
    """Filters through trials: compiled ones where it is called, each other one in a process that can be killed.

    To be used in a ``with``, whose end kills the processes that still work.

    Parameters
    ----------
    filters : all filters of a study
    belief : of the filters, unless a trial is run with one of its own
    timeout : seconds that a filter that is not compiled has for a trial
    memory : GiB that it may allocate in a trial, beyond what its process has before

    Raises
    ------
    InputError
        A filter cannot be pickled, a number is not positive, or memory cannot be limited on this system.
    """

    def __init__(
        self, filters: Sequence[Filter], belief: Belief, timeout: float | None = None, memory: float | None = None
    ) -> None:
        for name, value in (("timeout", timeout), ("memory", memory)):
            if value is not None and not value > 0:
                raise InputError(f"{name} must be positive, got {value}")
        if memory is not None and sys.platform != "linux":
            raise InputError("memory can be limited on Linux alone; leave it out")
        self.filters, self.belief = list(filters), belief
        self.timeout, self.memory = timeout, memory
        self.compiled = [filter_ for filter_ in filters if isinstance(filter_, Compiled)]
        self._isolated = {name_of(each): _isolated(each) for each in filters if not isinstance(each, Compiled)}
        self._free: list[_Worker] = []
        self._busy: set[_Worker] = set()
        self._is_open = False

    def __reduce__(self) -> tuple[Any, ...]:
        return Isolation, (self.filters, self.belief, self.timeout, self.memory)

    def __enter__(self) -> Isolation:
        self._is_open = True
        return self

    def __exit__(self, *_: object) -> None:
        """Kill the processes that still work and keep the idle ones."""
        with _lock:
            self._is_open = False
            for worker in self._busy:  # whose thread waits for its result
                worker.stop()
            _idle.extend(self._free)
            self._free.clear()

    def run(self, trial: Trial, belief: Belief | None = None) -> list[Estimates]:
        """A trial through all filters, one after the other; may be called from several threads at once.

        A process that is killed from outside is replaced once; then the run has failed.

        Parameters
        ----------
        belief : for this trial, in place of the study's

        Raises
        ------
        InputError
            A filter needs what the trial does not have.
        """
        belief = self.belief if belief is None else belief
        estimates = []
        for filter_ in self.filters:
            if isinstance(filter_, Compiled):
                estimates.append(filter_.run(trial, belief))
            else:
                estimates.append(self._run_apart(self._isolated[name_of(filter_)], trial, belief))
        return estimates

    def _run_apart(self, filter_: Isolated, trial: Trial, belief: Belief) -> Estimates:
        from pebble import ProcessExpired

        code: int | None = None
        for _ in range(2):
            with self._worker() as worker:
                try:
                    return worker.run(filter_, trial, belief, self.timeout, self.memory)
                except TimeoutError as error:
                    return filter_.failed(trial, str(error))
                except ProcessExpired as error:
                    code = error.exitcode
            if code not in KILLED or not self._is_open:
                break
        reason = f"its process ended with exit status {code}"
        if code is not None and code < 0:
            from_outside = ", from outside or because memory ran out" if code in KILLED else ""
            signal_name = signal.Signals(-code).name if -code in set(signal.Signals) else f"signal {-code}"
            reason = f"its process was killed by {signal_name}{from_outside}"
        return filter_.failed(trial, reason)

    @contextlib.contextmanager
    def _worker(self) -> Iterator[_Worker]:
        """One that works for nobody else."""
        with _lock:
            if not self._is_open:
                raise RuntimeError("the study has ended")
            waiting = self._free or _idle
            worker = waiting.pop() if waiting else _Worker()
            self._busy.add(worker)
        try:
            yield worker
        except BaseException:  # Ctrl-C: it is still at work
            worker.stop()
            raise
        finally:
            with _lock:
                self._busy.discard(worker)
                if worker.is_alive:
                    self._free.append(worker)


class _Worker:
    """A pool of one process, which Pebble replaces when it dies or is killed."""

    def __init__(self) -> None:
        if current_process().daemon:
            raise InputError(
                "filters that are not compiled run in processes of their own, which a worker of multiprocessing.Pool "
                "cannot start; use concurrent.futures or joblib"
            )
        from joblib.externals.loky.backend import get_context  # slow to load
        from pebble import ProcessPool

        context = get_context("loky")
        _start_tracker()
        printed, output = context.Pipe(duplex=False)
        self._output = output  # open, so that it can be given to the next process
        threading.Thread(target=_show, args=(printed,), daemon=True).start()
        self._loaded: set[bytes] = set()
        self._pid, self._stopping = 0, threading.Lock()
        initargs = (output, *link_to_parent(context))
        self._pool: Any = ProcessPool(1, initializer=begin, initargs=initargs, context=context)
        _starter().submit(self._pool.schedule, nothing).result()

    @property
    def is_alive(self) -> bool:
        return bool(self._pool.active)

    def run(
        self, filter_: Isolated, trial: Trial, belief: Belief, timeout: float | None, memory: float | None
    ) -> Estimates:
        """Return the estimates of a trial.

        Raises
        ------
        TimeoutError
            Loading the filter or the trial took too long; the message says which.
        ProcessExpired
            The process ended.
        InputError
            The filter needs what the trial does not have.
        """
        try:
            folder = os.getcwd()
        except FileNotFoundError:
            folder = os.sep
        try:
            if filter_.pickled not in self._loaded:
                loading = None if timeout is None else max(timeout, LOADING)
                reason = "time-out while it was loaded"
                self._pid = 0
                task = self._pool.schedule(load, args=(filter_.pickled, tuple(sys.path), folder), timeout=loading)
                self._pid = self._result(task)
                self._loaded.add(filter_.pickled)
            reason = f"time-out after {timeout:g} s" if timeout is not None else ""
            task = self._pool.schedule(run, args=(filter_, trial, belief, memory), timeout=timeout)
            estimates: Estimates = self._result(task)
        except TimeoutError:
            self._loaded.clear()
            raise TimeoutError(reason) from None
        except CancelledError:
            raise RuntimeError("the study has ended") from None
        except InputError:
            raise
        except Exception:
            self._loaded.clear()
            raise
        return estimates

    def _result(self, task: Future[Any]) -> Any:
        """Wait for a task; Pebble forgets some when it is stopped, and does not report exit status 0."""
        from pebble import ProcessExpired

        ended: Any = ProcessExpired
        while not wait([task], GLANCE).done:
            if not self.is_alive:
                raise CancelledError
            if self._pid and not _lives(self._pid) and not wait([task], GLANCE).done:
                task.cancel()
                raise ended("ended", 0, self._pid)
        return task.result()

    def stop(self) -> None:
        """Kill the process at once; the end of a study and the thread that waits for a result may both do so."""
        with self._stopping:
            self._pool.stop()
            self._pool.join()
            self._output.close()


def _lives(pid: int) -> bool:
    if sys.platform == "win32":  # where signal 0 would end the process
        return True
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


def _isolated(filter_: Filter) -> Isolated:
    from joblib.externals.loky.backend.reduction import dumps

    name = name_of(filter_)
    try:
        pickled = bytes(dumps(filter_))
    except Exception as error:
        raise InputError(
            f"filter '{name}' runs in a process of its own and cannot be pickled: {reason_of(error)}; "
            "make in init(problem) what cannot be"
        ) from None
    file = getattr(sys.modules[type(filter_).__module__], "__file__", None) or ""
    return Isolated(name, error_of(filter_), rejects(filter_), pickled, Path(file).name)


def _show(printed: Connection) -> None:
    """Pass what the filters in a process print on to standard error, up to ``SHOWN`` bytes, and drop the rest."""
    bytes_left = SHOWN
    with contextlib.suppress(OSError, EOFError):
        while printed_text := os.read(printed.fileno(), 2**16):
            if bytes_left > 0:
                os.write(2, printed_text[:bytes_left])
                if len(printed_text) > bytes_left:
                    os.write(
                        2, f"\nconsistency: filters print more than {SHOWN} bytes; the rest is not shown\n".encode()
                    )
                bytes_left -= len(printed_text)


def _start_tracker() -> None:
    """Start loky's tracker of semaphores, which removes those of a process that is killed, without its warning."""
    from joblib.externals.loky.backend import resource_tracker

    warnings_before = os.environ.get("PYTHONWARNINGS")
    os.environ["PYTHONWARNINGS"] = "ignore:resource_tracker"
    try:
        resource_tracker.ensure_running()
    finally:
        del os.environ["PYTHONWARNINGS"]
        if warnings_before is not None:
            os.environ["PYTHONWARNINGS"] = warnings_before


def dismiss() -> None:
    """End the processes that wait for a study."""
    while _idle:
        _idle.pop().stop()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_idle.clear)
    os.register_at_fork(after_in_child=_starter.cache_clear)  # no thread is there after a fork


@dataclass(frozen=True)
class Isolated:
    """A filter in a process of its own, and what is needed to name its failures."""

    name: str
    error: str
    guarded: bool  # whether it says which observations it left out
    pickled: bytes
    file: str  # name of the file of its class; empty where it has none, as in a notebook

    def failed(self, trial: Trial, reason: str) -> Estimates:
        """Return estimates without a step: the run has failed in its first."""
        record = RunRecord.empty(trial.steps, len(trial.landmark))
        return record.estimates(self.name, trial.run, self.error, reason=reason, guarded=self.guarded)


def load(pickled: bytes, path: Sequence[str], folder: str) -> int:
    """Import what a filter needs, which takes no time of its first trial; return the number of the process."""
    sys.path[:] = path
    importlib.invalidate_caches()
    with contextlib.suppress(OSError):
        os.chdir(folder)
    with contextlib.suppress(Exception):
        pickle.loads(pickled)
    threadpool_limits(1)  # of the libraries of BLAS that are loaded now
    np.linalg.cholesky(np.eye(2))  # OpenBLAS takes its buffer, tens of MiB, in its first call: none of the filter's
    return os.getpid()


def run(filter_: Isolated, trial: Trial, belief: Belief, memory: float | None) -> Estimates:
    """Estimates of a trial; whatever the filter throws ends it as a failed run.

    The filter is unpickled for each trial, so that no run depends on those that this process did before.
    """
    own_pid, record = os.getpid(), RunRecord.empty(trial.steps, len(trial.landmark))
    try:
        with _limited(memory):
            estimates = run_filter(pickle.loads(filter_.pickled), trial, belief, record)
    except InputError:
        raise
    except BaseException as error:
        reason = reason_of(error)
        if not record.at[0]:
            reason = f"cannot be loaded in a process of its own: {reason}"
        estimates = record.estimates(filter_.name, trial.run, filter_.error, reason=reason, guarded=filter_.guarded)
    if estimates.failure is not None and filter_.file:
        reason = estimates.failure.reason.replace(BY_VALUE, filter_.file)
        estimates = replace(estimates, failure=replace(estimates.failure, reason=reason))
    if os.getpid() != own_pid:
        os._exit(1)  # a copy that the filter has made of its process
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(Exception):
            stream.flush()
    return estimates


@contextlib.contextmanager
def _limited(memory: float | None) -> Iterator[None]:
    """Inside, ``memory`` GiB can be allocated beyond what the process has; more is a MemoryError."""
    if memory is None or resource is None:
        yield
        return
    with open("/proc/self/status", encoding="ascii") as lines:  # what RLIMIT_DATA limits (Linux 4.7 and later)
        private_bytes = 1024 * next(int(line.split()[1]) for line in lines if line.startswith("VmData"))
    _, hard_limit = resource.getrlimit(resource.RLIMIT_DATA)
    resource.setrlimit(resource.RLIMIT_DATA, (private_bytes + int(memory * GIB), hard_limit))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, (hard_limit, hard_limit))
