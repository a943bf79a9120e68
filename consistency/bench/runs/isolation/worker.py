"""The far side of isolation: what is called in the process of a filter."""

from __future__ import annotations

import contextlib
import importlib
import os
import pickle
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from threadpoolctl import threadpool_limits

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]

from consistency.bench.filters.run_filter import RunRecord, reason_of, run_filter
from consistency.bench.scenario import Belief
from consistency.bench.types import Estimates, Trial
from consistency.referee.errors import InputError

GIB = 2**30
BY_VALUE = "<dynamic-code>"  # cloudpickle's name for the file of a class that travels by value, as those of a script


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
    _, hard_limit = resource.getrlimit(resource.RLIMIT_DATA)
    resource.setrlimit(resource.RLIMIT_DATA, (_private_bytes() + int(memory * GIB), hard_limit))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, (hard_limit, hard_limit))


def _private_bytes() -> int:
    """Private writable memory of this process, mapped or used: what RLIMIT_DATA limits (Linux 4.7 and later)."""
    with open("/proc/self/status", encoding="ascii") as lines:
        return 1024 * next(int(line.split()[1]) for line in lines if line.startswith("VmData"))
