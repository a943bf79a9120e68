"""The far side of isolation: a supervisor, and the processes under it in which filters run and may die.

A supervisor does nothing that can hang or crash. For each filter of a study it keeps a process, which works off trials
until it dies or must be killed; then there is a new one. What the filter says lies in memory that both see, so that the
steps before the end are not lost. On Linux such a process is forked, which takes milliseconds: the supervisor has one
thread and BLAS another none.
"""

from __future__ import annotations

import contextlib
import importlib
import multiprocessing
import os
import pickle
import signal
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection, wait
from typing import Any

import numpy as np

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]

from consistency.bench.filters.recorder import RunRecord
from consistency.bench.filters.stepping import reason_of, run_filter
from consistency.bench.runs.isolation.standard_streams import AT_ONCE, Printed, open_files, redirect
from consistency.bench.scenario import Belief
from consistency.bench.types import Estimates, Trial
from consistency.referee.errors import InputError
from consistency.referee.system.stopping import die_with_parent
from consistency.referee.types import Array

IDLE = 300.0  # s without a study, after which a supervisor ends
GLANCE = 0.5  # s between looks at whether a process still lives, whose pipe a child of its own may hold open
STOPPED = (signal.SIGTERM, getattr(signal, "SIGKILL", signal.SIGTERM))  # from outside, as no filter ends by itself
GIB = 2**30
PER_STEP = 24  # numbers of a record in a step: pose, two covariances, NIS, its degrees of freedom, log det S
LOADING = 60.0  # s that loading a filter may take where there is a time-out
READY = b"ready"
_context: Any = multiprocessing.get_context("fork" if sys.platform == "linux" else "spawn")


@dataclass(frozen=True)
class Guest:
    """A filter of the study, and what its supervisor needs to know of it."""

    name: str
    error: str
    guarded: bool  # whether it says which observations it left out
    pickled: bytes


@dataclass(frozen=True)
class SupervisorSetup:
    """What a supervisor is told before the first trial."""

    guests: dict[str, Guest]  # by name
    timeout: float | None  # s a trial
    memory: float | None  # GiB beyond what the process has before the trial
    path: tuple[str, ...]  # where modules are looked for
    folder: str


@dataclass(frozen=True)
class Task:
    guest: str
    trial: Trial
    belief: Belief


@dataclass(frozen=True)
class Reply:
    """Estimates of a trial; or a run that was stopped from outside, as ``estimates`` say; or bad input.

    ``is_spent`` says that the process is no longer as the bench has made it.
    """

    estimates: Estimates | None
    was_stopped: bool = False
    refusal: str = ""
    is_spent: bool = False


def supervise(link: Connection) -> None:
    """Take studies and trials from ``link`` and reply to each trial, until the other end is closed."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    hosts: dict[str, _Host] = {}
    printed: dict[str, Printed] = {}
    study: SupervisorSetup | None = None
    try:
        while study is not None or link.poll(IDLE):
            message = link.recv_bytes()
            told: SupervisorSetup | Task | None = pickle.loads(message)
            if isinstance(told, Task):
                assert study is not None
                host = _host_for(told, study, hosts, printed.setdefault(told.guest, Printed(told.guest)))
                link.send_bytes(pickle.dumps(host.run(told.trial, message, link)))
            else:
                study = told
                _end(hosts)
                printed.clear()
    except (EOFError, OSError):
        pass
    finally:
        _end(hosts)


def _host_for(task: Task, study: SupervisorSetup, hosts: dict[str, _Host], printed: Printed) -> _Host:
    """The process that has the filter, a new one where there is none that can take the trial."""
    host = hosts.get(task.guest)
    if host is None or not host.can_take(task.trial):
        if host is not None:
            host.end()
        host = hosts[task.guest] = _Host(study, study.guests[task.guest], task.trial, printed)
    return host


def _end(hosts: dict[str, _Host]) -> None:
    for host in hosts.values():
        host.end()
    hosts.clear()


class _Host:
    """A process with one filter in it, seen from its supervisor."""

    def __init__(self, study: SupervisorSetup, guest: Guest, trial: Trial, printed: Printed) -> None:
        self.guest, self.timeout, self.printed, self.is_spent = guest, study.timeout, printed, False
        self.room = _Room(trial.steps, 2 * len(trial.landmark))
        self.link, end = _context.Pipe()
        self.ear, mouth = _context.Pipe(duplex=False)
        self.process = _context.Process(target=_host, args=(study, guest, self.room, end, mouth))
        self.process.start()
        end.close()
        mouth.close()

    def can_take(self, trial: Trial) -> bool:
        fits = self.room.steps >= trial.steps and self.room.observations >= len(trial.landmark)
        return fits and not self.is_spent and self.process.exitcode is None

    def run(self, trial: Trial, message: bytes, parent: Connection) -> Reply:
        """Estimates of a trial, cut off where the process died or was killed at the time-out."""
        guest, timeout, record = self.guest, self.timeout, self.room.record(trial).begun()
        try:
            reason = "time-out while it was loaded"
            if self._says(parent, None if timeout is None else max(timeout, LOADING)) is not None:
                self.link.send_bytes(message)
                reason = "" if timeout is None else f"time-out after {timeout:g} s"
                if (reply := self._says(parent, timeout)) is not None:
                    self._listen()
                    whole: Reply = pickle.loads(reply)
                    self.is_spent = whole.is_spent
                    return whole
            was_stopped = False
        except (EOFError, OSError):
            code = self._exit_code()
            reason, was_stopped = _reason(code), code is not None and -code in STOPPED
        self._listen()
        self.printed.end(died=True)
        self.end()
        estimates = record.estimates(guest.name, trial.run, guest.error, reason=reason, guarded=guest.guarded)
        return Reply(estimates, was_stopped)

    def _says(self, parent: Connection, seconds: float | None) -> bytes | None:
        """What the process says, None if nothing in time; EOFError where it is dead, SystemExit where ``parent`` is."""
        until = np.inf if seconds is None else time.monotonic() + seconds
        while (left := until - time.monotonic()) > 0:
            ears = [] if self.ear.closed else [self.ear]
            ready = wait([self.link, parent, *ears], min(left, GLANCE))
            if parent in ready:
                raise SystemExit  # it writes nothing while it waits for a reply
            if self.ear in ready:
                self._listen()
            if self.link in ready:
                said: bytes = self.link.recv_bytes()
                return said
            if not ready and self.process.exitcode is not None:
                raise EOFError
        return None

    def _listen(self) -> None:
        """Take in what it has printed."""
        if not self.ear.closed and self.ear.poll():
            if text := os.read(self.ear.fileno(), AT_ONCE):
                self.printed.add(text)
            else:
                self.ear.close()

    def _exit_code(self) -> int | None:
        """Of a process that is about to end; None where it goes on."""
        until = time.monotonic() + GLANCE
        while self.process.exitcode is None and time.monotonic() < until:
            time.sleep(0.002)
        code: int | None = self.process.exitcode
        return code

    def end(self) -> None:
        """Kill it, with all processes that it has started."""
        self.printed.end(died=False)
        self.link.close()
        self.ear.close()
        with contextlib.suppress(ProcessLookupError, PermissionError, AttributeError):
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.kill()
        self.process.join()


class _Room:
    """Memory for a :class:`RunRecord` that two processes see."""

    def __init__(self, steps: int, observations: int) -> None:
        self.steps, self.observations = steps, observations
        self._numbers = _context.RawArray("d", PER_STEP * steps)
        self._at, self._rejected = _context.RawArray("q", 1), _context.RawArray("b", max(observations, 1))

    def record(self, trial: Trial) -> RunRecord:
        """The part of it that a trial needs."""
        T, numbers = trial.steps, np.frombuffer(self._numbers)
        parts = np.split(numbers[: PER_STEP * T], np.cumsum([3 * T, 9 * T, 9 * T, T, T]))
        pose, covariance, own, nis, dof, log_det = parts
        rejected: Array = np.frombuffer(self._rejected, bool)[: len(trial.landmark)]
        at = np.frombuffer(self._at, np.int64)
        pose, covariance, own = pose.reshape(T, 3), covariance.reshape(T, 3, 3), own.reshape(T, 3, 3)
        return RunRecord(at, pose, covariance, own, nis, dof, log_det, rejected)


def _reason(code: int | None) -> str:
    """How a process ended that was to go on."""
    if code is None:
        return "its process closed its pipe to the bench"
    if code >= 0:
        return f"its process ended with exit status {code}"
    outside = ", from outside or for want of memory" if -code in STOPPED else ""
    name = signal.Signals(-code).name if -code in set(signal.Signals) else f"signal {-code}"
    return f"its process was killed by {name}{outside}"


# --- in the process of a filter -----------------------------------------------------------------


def _host(study: SupervisorSetup, guest: Guest, room: _Room, link: Connection, mouth: Connection) -> None:
    """Work off trials with one filter until the supervisor closes the pipe; what is printed goes to ``mouth``."""
    _settle(study)
    redirect(mouth)
    own_pid, files = os.getpid(), open_files(link)
    with contextlib.suppress(Exception):
        pickle.loads(guest.pickled)  # what it imports takes no time of the first trial
    while True:
        link.send_bytes(READY)
        try:
            task: Task = pickle.loads(link.recv_bytes())
        except EOFError:
            return
        try:
            with _limited(study.memory):
                reply = Reply(_run(guest, task, room.record(task.trial)))
        except InputError as error:
            reply = Reply(None, refusal=str(error))
        if os.getpid() != own_pid:
            os._exit(1)  # a copy that the filter has made of its process
        for stream in (sys.stdout, sys.stderr):  # the process will be killed, not ended
            with contextlib.suppress(Exception):
                stream.flush()
        if (now := open_files(link))[-1] != files[-1]:
            time.sleep(LOADING)  # to be killed: what has the number of the pipe may be a file of the filter
            os._exit(1)
        link.send_bytes(pickle.dumps(replace(reply, is_spent=now != files)))


def _run(guest: Guest, task: Task, record: RunRecord) -> Estimates:
    """Estimates of a trial; whatever the filter throws ends it as a failed run.

    The filter is as it was sent, so that no run depends on those that this process did before.
    """
    try:
        return run_filter(pickle.loads(guest.pickled), task.trial, task.belief, record)
    except InputError:
        raise
    except BaseException as error:
        _lift_limit()
        reason = reason_of(error) if record.at[0] else f"cannot be loaded in a process of its own: {reason_of(error)}"
        return record.estimates(guest.name, task.trial.run, guest.error, reason=reason, guarded=guest.guarded)


def _settle(study: SupervisorSetup) -> None:
    """Die with the supervisor, leave no core, and find the modules that the user finds."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with contextlib.suppress(OSError, AttributeError):
        os.setpgid(0, 0)
    if sys.platform == "linux":
        die_with_parent()
    if resource is not None:
        resource.setrlimit(resource.RLIMIT_CORE, (0, resource.getrlimit(resource.RLIMIT_CORE)[1]))
    sys.path[:] = study.path
    importlib.invalidate_caches()
    with contextlib.suppress(OSError):
        os.chdir(study.folder)


@contextlib.contextmanager
def _limited(memory: float | None) -> Iterator[None]:
    """Inside, ``memory`` GiB can be allocated beyond what the process has; more is a MemoryError."""
    if memory is not None and resource is not None:
        most = _private_bytes() + int(memory * GIB)
        resource.setrlimit(resource.RLIMIT_DATA, (most, resource.getrlimit(resource.RLIMIT_DATA)[1]))
    try:
        yield
    finally:
        _lift_limit()


def _lift_limit() -> None:
    if resource is not None:
        hard = resource.getrlimit(resource.RLIMIT_DATA)[1]
        resource.setrlimit(resource.RLIMIT_DATA, (hard, hard))


def _private_bytes() -> int:
    """Private writable memory of this process, mapped or used: what RLIMIT_DATA limits (Linux 4.7 and later)."""
    with open("/proc/self/status", encoding="ascii") as lines:
        return 1024 * next(int(line.split()[1]) for line in lines if line.startswith("VmData"))
