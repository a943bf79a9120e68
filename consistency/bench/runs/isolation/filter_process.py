"""Filters that are not compiled, each in a process of its own that can be killed: at its time-out, for its memory."""

from __future__ import annotations

import atexit
import contextlib
import os
import pickle
import signal
import sys
import threading
from collections.abc import Iterator, Sequence
from multiprocessing import current_process
from typing import Any

import numpy as np

from consistency.bench.filters.compiled import Compiled
from consistency.bench.filters.recorder import RunRecord
from consistency.bench.filters.stepping import error_of, name_of, reason_of, rejects
from consistency.bench.protocols import Filter
from consistency.bench.runs.isolation.supervisor import Guest, Reply, SupervisorSetup, Task, supervise
from consistency.bench.scenario import Belief
from consistency.bench.types import Estimates, Trial
from consistency.referee.errors import InputError

ONE_THREAD = dict.fromkeys(  # of BLAS in a process of a filter: the last bits depend on it
    ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS", "BLIS_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"), "1"
)
KILL = getattr(signal, "SIGKILL", signal.SIGTERM)
GLANCE = 1.0  # s between looks at whether a supervisor still lives
_lock = threading.Lock()
_idle: list[_Supervisor] = []  # started by earlier studies, as starting one takes seconds


class Isolation:
    """Filters through trials: compiled ones where it is called, each other one in processes of its own.

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
        self.compiled = [filter_ for filter_ in filters if isinstance(filter_, Compiled)]
        alone = [filter_ for filter_ in filters if not isinstance(filter_, Compiled)]
        self._guests = {name_of(filter_): _guest(filter_) for filter_ in alone}
        self._study = SupervisorSetup(self._guests, timeout, memory, tuple(sys.path), _folder())
        self._free: list[_Supervisor] = []
        self._busy: set[_Supervisor] = set()
        self._is_open, self._halt = False, np.zeros(1, np.int64)

    def __reduce__(self) -> tuple[Any, ...]:
        return Isolation, (self.filters, self.belief, self._study.timeout, self._study.memory)

    def __enter__(self) -> Isolation:
        self._is_open, self._halt = True, np.zeros(1, np.int64)
        return self

    def __exit__(self, *_: object) -> None:
        """End compiled trials before their next step and kill processes that work; idle supervisors are kept."""
        self._halt[0] = 1
        with _lock:
            self._is_open = False
            for supervisor in self._busy:  # whose thread waits for a reply
                supervisor.stop()
            _idle.extend(supervisor for supervisor in self._free if supervisor.tell(None))
            self._free.clear()

    def run(self, trial: Trial, belief: Belief | None = None) -> list[Estimates]:
        """A trial through all filters, one after the other; may be called from several threads at once.

        A process that is killed from outside, or whose supervisor is, is replaced once; then the run has failed.

        Parameters
        ----------
        belief : for this trial, in place of the study's

        Raises
        ------
        InputError
            A filter needs what the trial does not have.
        """
        belief = self.belief if belief is None else belief
        return [
            filter_.run(trial, belief, self._halt)
            if isinstance(filter_, Compiled)
            else self._apart(filter_, trial, belief)
            for filter_ in self.filters
        ]

    def _apart(self, filter_: Filter, trial: Trial, belief: Belief) -> Estimates:
        guest = self._guests[name_of(filter_)]
        message, reply = pickle.dumps(Task(guest.name, trial, belief)), None
        for _ in range(2):
            with self._supervisor() as supervisor:
                reply = supervisor.ask(message)
            if reply is not None and not reply.was_stopped:
                break
        if reply is None:
            record = RunRecord.empty(trial.steps, len(trial.landmark))
            reason = "the supervisor of its process was killed twice"
            return record.estimates(guest.name, trial.run, guest.error, reason=reason, guarded=guest.guarded)
        if reply.estimates is None:
            raise InputError(reply.refusal)
        return reply.estimates

    @contextlib.contextmanager
    def _supervisor(self) -> Iterator[_Supervisor]:
        """One that knows the study and works for nobody else; of a dead one nothing is kept."""
        with _lock:
            if not self._is_open:
                raise RuntimeError("the study has ended")
            supervisor = self._free.pop() if self._free else None
            while supervisor is None:
                candidate = _idle.pop() if _idle else _Supervisor()
                supervisor = candidate if candidate.tell(self._study) else None
            self._busy.add(supervisor)
        try:
            yield supervisor
        except BaseException:  # Ctrl-C: it is still at work
            supervisor.kill()
            raise
        finally:
            with _lock:
                self._busy.discard(supervisor)
                if supervisor.is_alive:
                    self._free.append(supervisor)


class _Supervisor:
    """The near end of :func:`.supervisor.supervise`, which runs in a process without ``__main__``."""

    def __init__(self) -> None:
        if current_process().daemon:
            raise InputError(
                "filters that are not compiled run in processes of their own, which a worker of multiprocessing.Pool "
                "cannot start; use concurrent.futures or joblib"
            )
        from joblib.externals.loky.backend import get_context  # slow to load

        context = get_context("loky")
        self.link, end = context.Pipe()
        self.process = context.Process(target=supervise, args=(end,), env=ONE_THREAD)
        self.process.start()
        end.close()

    @property
    def is_alive(self) -> bool:
        return not self.link.closed and self.process.exitcode is None

    def tell(self, study: SupervisorSetup | None) -> bool:
        """Send what the next trials are about; False where it is dead."""
        try:
            self.link.send_bytes(pickle.dumps(study))
        except OSError:
            self.link.close()
            return False
        return True

    def ask(self, message: bytes) -> Reply | None:
        """Its reply, None where it is dead."""
        try:
            self.link.send_bytes(message)
            while not self.link.poll(GLANCE):
                if self.process.exitcode is not None:
                    raise EOFError
            reply: Reply = pickle.loads(self.link.recv_bytes())
        except (EOFError, OSError):
            self.kill()
            return None
        return reply

    def kill(self) -> None:
        """End it at once; what runs under it ends with it."""
        self.link.close()
        self.stop()
        self.process.join()

    def stop(self) -> None:
        """Send the signal that ends it, and leave the rest to who waits for its reply."""
        with contextlib.suppress(ProcessLookupError):
            os.kill(self.process.pid, KILL)


def _guest(filter_: Filter) -> Guest:
    from joblib.externals.loky.backend.reduction import dumps

    name = name_of(filter_)
    try:
        pickled = bytes(dumps(filter_))
    except Exception as error:
        raise InputError(
            f"filter '{name}' runs in a process of its own and cannot be pickled: {reason_of(error)}; "
            "make in init(problem) what cannot be"
        ) from None
    return Guest(name, error_of(filter_), rejects(filter_), pickled)


def _folder() -> str:
    try:
        return os.getcwd()
    except FileNotFoundError:
        return os.sep


@atexit.register  # before multiprocessing waits for its children
def dismiss() -> None:
    while _idle:
        _idle.pop().link.close()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_idle.clear)
