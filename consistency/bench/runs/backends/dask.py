"""Workers of dask: a scheduler somewhere with workers on many machines, or a cluster of this machine's own.

The work is registered with the scheduler, which hands it once to each worker, late ones too; batches of runs
name it. Each batch brings back one buffer. Batches that a scheduler took to its grave are sent again.
"""

from __future__ import annotations

import logging
import os
import re
import signal
import threading
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from queue import Empty, SimpleQueue
from typing import Any, NoReturn
from uuid import uuid4

from dask.config import set as set_config
from distributed import Client, Future, KilledWorker, LocalCluster, Security, WorkerPlugin

from consistency.bench.filters.stepping import reason_of
from consistency.bench.runs.backends.batches import Batch, Batches, Event, in_batches
from consistency.bench.runs.backends.local import worker_count
from consistency.bench.runs.backends.remote import Part, Worker, pickled_work
from consistency.bench.runs.isolation.filter_process import ONE_THREAD
from consistency.bench.runs.trial_work import Outcomes, TrialWork
from consistency.referee.errors import InputError

TARGET = 1.5  # s of work in a batch
LIMIT = 5.0  # s after which a batch comes back with what is done of it
AHEAD = 3  # batches with each thread of a worker
GLANCE = 1.0  # s between looks at whether the scheduler is there
COUNT_EVERY = 5.0  # s between counts of the workers
TROUBLE = (OSError, TimeoutError, CancelledError)  # of a connection
OUR_CONFIG = {  # of our own cluster, which is to be as fast as threads
    "distributed.worker.profile.enabled": False,  # it looks at the worker every 10 ms,
    "distributed.admin.tick.interval": "500ms",  # this every 20 ms,
    "distributed.admin.system-monitor.interval": "5s",  # and this every 500 ms
    "distributed.nanny.pre-spawn-environ": ONE_THREAD,  # without the limit at which memory is given back at once
}
OUR_SCHEDULER = {"allowed_failures": 1, "dashboard": False, "dashboard_address": "127.0.0.1:0"}  # of its scheduler
ADDRESS = re.compile(r"(\w+://)?[^/\s]+:\d+")
_workers: dict[str, Worker] = {}  # in a worker, by name of the work


@dataclass(frozen=True)
class Dask:
    """The workers of a scheduler of dask.distributed; without one, processes of this machine.

    Parameters
    ----------
    scheduler : its address, such as ``tcp://host:8786`` or ``tls://host:8786``, or the path of its scheduler file
    jobs : number of processes where there is no scheduler, -1 for one a core
    wait : seconds to wait for a scheduler, and for its first worker, at the start and when they are gone

    Raises
    ------
    InputError
        The number of jobs or the wait makes no sense, or the scheduler is neither an address nor a file.
    """

    scheduler: str | None = None
    jobs: int = -1
    wait: float = 60.0

    def __post_init__(self) -> None:
        worker_count(self.jobs)
        if self.scheduler is not None and self.jobs != -1:
            raise InputError(f"jobs ({self.jobs}) are processes of this machine; a scheduler has workers of its own")
        if not self.wait > 0:
            raise InputError(f"the wait for a scheduler must be positive, got {self.wait}")
        if self.scheduler is not None and not os.path.isfile(self.scheduler) and not ADDRESS.fullmatch(self.scheduler):
            raise InputError(
                f"scheduler '{self.scheduler}' is neither an address, such as tcp://host:8786, nor a scheduler file"
            )

    def prepare(self, work: TrialWork, run: int, /) -> None:
        """See :class:`consistency.bench.runs.trial_work.Backend`."""
        if self.scheduler is None:
            work.compile(run)

    def outcomes(self, work: TrialWork, runs: Sequence[int], /) -> Outcomes:
        """See :class:`consistency.bench.runs.trial_work.Backend`.

        Raises
        ------
        InputError
            No scheduler, or no worker of it, for as long as is waited; bad input, see
            :func:`consistency.bench.runs.backends.batches.in_batches`.
        """
        with _silence(), self._address(len(runs)) as address, closing(_Engine(address, work, self.wait)) as engine:
            yield from in_batches(engine, Batches(runs, TARGET), work)

    @contextmanager
    def _address(self, runs: int) -> Iterator[dict[str, Any]]:
        """How a client finds the scheduler."""
        if self.scheduler is None:
            workers = min(worker_count(self.jobs), runs)
            with set_config(OUR_CONFIG), LocalCluster(
                n_workers=workers, threads_per_worker=1, memory_limit=None, host="127.0.0.1", dashboard_address=None,
                silence_logs=logging.CRITICAL, scheduler_kwargs=OUR_SCHEDULER,
            ) as cluster:  # fmt: skip
                yield {"address": cluster, "direct_to_workers": True}
        elif self.scheduler.startswith("tls://") and Security().get_connection_args("client")["ssl_context"] is None:
            raise InputError(
                f"scheduler {self.scheduler}: tls needs the certificates of this client, which dask takes from "
                "DASK_DISTRIBUTED__COMM__TLS__CA_FILE, ..__CLIENT__CERT and ..__CLIENT__KEY"
            )
        elif os.path.isfile(self.scheduler):
            yield {"scheduler_file": self.scheduler}
        else:
            yield {"address": self.scheduler}


class _Engine:
    """See :class:`consistency.bench.runs.backends.batches.Engine`."""

    def __init__(self, address: dict[str, Any], work: TrialWork, wait: float) -> None:
        self._address, self._pickled, self._wait = address, pickled_work(work), wait
        self._is_ours = isinstance(address.get("address"), LocalCluster)
        self._name = f"consistency-{uuid4().hex}"  # of the work; of nobody else's, as its end takes it from the workers
        self._sent: dict[str, tuple[Batch, Future | None]] = {}  # by key of the task
        self._ended: SimpleQueue[str] = SimpleQueue()
        self._client = self._connected()
        self._threads, self._counted, self._last_seen = 1, 0.0, time.monotonic()

    def close(self) -> None:
        """Drop what is not done, and what the workers were sent."""
        with suppress(*TROUBLE):
            futures = [future for _, future in self._sent.values() if future is not None]
            if self._client.status == "running":
                self._client.cancel(futures, force=True)
                self._client.unregister_worker_plugin(self._name)
        _close(self._client)

    @property
    def room(self) -> int:
        """Some batches for each thread, so that none waits."""
        return AHEAD * self._threads

    def submit(self, batches: Sequence[Batch]) -> None:
        """Send batches; those that cannot be sent are sent again with the next connection."""
        for batch in batches:
            key, future = f"consistency-{uuid4().hex}", None
            with suppress(*TROUBLE):
                future = self._client.submit(_do, self._name, batch.runs, key=key)
                future.add_done_callback(lambda future: self._ended.put(future.key))
            self._sent[key] = batch, future

    def events(self) -> list[Event]:
        """Batches that have come back, or were lost; a new connection where this one has ended."""
        events: list[Event] = []
        try:
            self._count()
            for key in self._ended_keys():
                if key in self._sent:
                    events += self._events_of(key)
        except TROUBLE:
            self._reconnect()
        return events

    def _ended_keys(self) -> list[str]:
        with suppress(Empty):
            keys = [self._ended.get(timeout=GLANCE)]
            while not self._ended.empty():
                keys.append(self._ended.get())
            return keys
        return []

    def _events_of(self, key: str) -> list[Event]:
        """What became of a task; one that the connection has cancelled stays among those that were sent."""
        batch, future = self._sent[key]
        assert future is not None
        error = future.exception() if future.status == "error" else None
        if error is not None and not isinstance(error, KilledWorker):
            raise _told(error) from error
        try:
            part: Part | None = None if error is not None else future.result(self._wait)
        except TimeoutError:  # the worker that had it is dead: who does it again says so, or nobody is left
            self._ended.put(key)
            return []
        del self._sent[key]
        if part is None:
            return [(batch, "its worker died, and so did those that tried it again")]
        return [(batch, part), (batch, None)]

    def _count(self) -> None:
        """Count the threads of the workers now and then; to have none for long is the end."""
        if self._client.status != "running" or any(future is None for _, future in self._sent.values()):
            raise ConnectionError
        now = time.monotonic()
        if now - self._counted < COUNT_EVERY:
            return
        self._counted, self._threads = now, sum(self._client.nthreads(callback_timeout=self._wait).values())
        if self._threads:
            self._last_seen = now
        elif now - self._last_seen > self._wait:
            self._give_up("has had no worker")
        self._threads = max(self._threads, 1)

    def _reconnect(self) -> None:
        """Wait for the scheduler to be there again, and send it what is missing."""
        _close(self._client)
        batches = [batch for batch, _ in self._sent.values()]
        self._sent.clear()
        self._client = self._connected()
        self._counted, self._last_seen = 0.0, time.monotonic()
        self.submit(batches)

    def _connected(self) -> Client:
        """A client of a scheduler that has a worker and knows the work."""
        end = time.monotonic() + self._wait
        while True:
            client: Client | None = None
            try:
                client = Client(**self._address, timeout=max(end - time.monotonic(), 0.1), set_as_default=False)
                client.wait_for_workers(1, timeout=max(end - time.monotonic(), 0.1))
                client.register_plugin(_Keep(self._name, self._pickled, self._is_ours), self._name)
                return client
            except TROUBLE:
                if client is not None:
                    _close(client)
                if time.monotonic() >= end:
                    self._give_up("cannot be reached" if client is None else "has had no worker")
                time.sleep(min(0.5, self._wait))
            except BaseException as error:
                if client is not None:
                    _close(client)
                if isinstance(error, ImportError):
                    raise _told(error) from None
                if isinstance(error, ValueError | TypeError | RuntimeError):  # of the address, or of certificates
                    raise InputError(f"dask cannot connect to {self._where} ({reason_of(error)})") from None
                raise

    def _give_up(self, what: str) -> NoReturn:
        raise InputError(f"the scheduler {self._where} {what} for {self._wait:g} s") from ConnectionError(what)

    @property
    def _where(self) -> str:
        where = next(iter(self._address.values()))
        return "of this machine" if self._is_ours else str(where)


class _Keep(WorkerPlugin):  # type: ignore[misc]
    """Brings the work to each worker."""

    def __init__(self, name: str, pickled: bytes, is_ours: bool) -> None:
        self.name, self.pickled, self.is_ours = name, pickled, is_ours

    def setup(self, worker: Any) -> None:
        if self.is_ours and threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is said to all processes of a terminal
        _workers[self.name] = Worker(self.pickled)

    def teardown(self, worker: Any) -> None:
        if (own := _workers.pop(self.name, None)) is not None:
            own.close()


def _do(name: str, runs: Sequence[int]) -> Part:
    """In a worker: what runs left, the first of them where all would take too long."""
    with closing(_workers[name].parts(runs, LIMIT)) as parts:
        return next(parts)


def _told(error: BaseException) -> Exception:
    """An error of the far side, which is never taken for one of the connection."""
    if isinstance(error, ImportError):
        return InputError(f"a worker of dask cannot load the work ({error}); install there what is installed here")
    return error if isinstance(error, InputError) else RuntimeError(f"a worker of dask failed: {reason_of(error)}")


def _close(client: Client) -> None:
    with suppress(*TROUBLE):
        client.close(timeout=2)


@contextmanager
def _silence() -> Iterator[None]:
    """What dask logs of connections and workers that are gone: the backend says it, or mends it."""
    loggers = [
        logging.getLogger(name) for name in list(logging.root.manager.loggerDict) if name.startswith("distributed")
    ]
    before = [logger.level for logger in loggers]
    try:
        for logger in loggers:
            logger.setLevel(logging.CRITICAL)
        yield
    finally:
        for logger, level in zip(loggers, before, strict=True):
            logger.setLevel(level)
