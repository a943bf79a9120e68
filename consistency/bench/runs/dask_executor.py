"""Workers of dask: a scheduler somewhere with workers on many machines, or processes of this machine."""

from __future__ import annotations

import logging
import os
import re
import time
from collections.abc import Callable
from concurrent.futures import Executor, Future
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeVar

import dask
from distributed import Client, LocalCluster, Security

from consistency.bench.runs.workers import worker_count
from consistency.referee.errors import InputError
from consistency.referee.parsing import one_line

Result = TypeVar("Result")
ADDRESS = re.compile(r"(\w+://)?[^/\s]+:\d+")
PAUSE = 0.5  # s between attempts to connect


@dataclass
class DaskExecutor(Executor):
    """The workers of a scheduler of dask.distributed; without one, processes of this machine.

    The connection is made when work is first submitted.

    Parameters
    ----------
    scheduler : its address, such as ``tcp://host:8786`` or ``tls://host:8786``, or the path of its scheduler file
    jobs : number of processes where there is no scheduler, -1 for one a core
    wait : seconds to wait for a scheduler and its first worker

    Raises
    ------
    InputError
        The number of jobs or the wait makes no sense, or the scheduler is neither an address nor a file. From
        ``submit``: no scheduler, or no worker of it, for as long as is waited.
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

    def submit(self, function: Callable[..., Result], /, *args: Any, **options: Any) -> Future[Result]:
        """See :meth:`concurrent.futures.Executor.submit`."""
        future: Future[Result] = self._executor.submit(function, *args, **options)
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Close the connection, and end the processes of this machine."""
        if "_client" in vars(self):
            _close(self._client)
        if "_cluster" in vars(self):
            self._cluster.close()

    @cached_property
    def _executor(self) -> Any:
        return self._client.get_executor(pure=False)

    @cached_property
    def _client(self) -> Client:
        """A client of a scheduler that has a worker."""
        for name in list(logging.root.manager.loggerDict):
            if name.startswith(("distributed", "tornado")):  # what is gone, workers and connections, is dask's business
                logging.getLogger(name).setLevel(logging.CRITICAL)
        where, end = self._address(), time.monotonic() + self.wait
        while True:
            client: Client | None = None
            try:
                client = Client(**where, timeout=max(end - time.monotonic(), 0.1), set_as_default=False)
                client.wait_for_workers(1, timeout=max(end - time.monotonic(), 0.1))
                return client
            except (OSError, TimeoutError) as error:
                if client is not None:
                    _close(client)
                if time.monotonic() >= end:
                    what = "cannot be reached" if client is None else "has had no worker"
                    sentence = f"the scheduler {self.scheduler} {what} for {self.wait:g} s"
                    raise InputError(sentence) from ConnectionError(str(error))
                time.sleep(min(PAUSE, self.wait))
            except (ValueError, TypeError, RuntimeError) as error:  # of the address, or of certificates
                reason = one_line(f"{type(error).__name__}: {error}", 200)
                raise InputError(f"dask cannot connect to {self.scheduler} ({reason})") from None

    def _address(self) -> dict[str, Any]:
        """How a client finds the scheduler."""
        if self.scheduler is None:
            return {"address": self._cluster}
        if os.path.isfile(self.scheduler):
            return {"scheduler_file": self.scheduler}
        if self.scheduler.startswith("tls://") and Security().get_connection_args("client")["ssl_context"] is None:
            raise InputError(
                f"scheduler {self.scheduler}: tls needs the certificates of this client, which dask takes from "
                "DASK_DISTRIBUTED__COMM__TLS__CA_FILE, ..__CLIENT__CERT and ..__CLIENT__KEY"
            )
        return {"address": self.scheduler}

    @cached_property
    def _cluster(self) -> LocalCluster:
        # dask gives a worker up for good that dies again within this time, and the last one too
        dask.config.set({"distributed.deploy.lost-worker-timeout": "1 day"})
        return LocalCluster(
            n_workers=worker_count(self.jobs), threads_per_worker=1, memory_limit=None, host="127.0.0.1",
            dashboard_address="127.0.0.1:0", silence_logs=logging.CRITICAL,
        )  # fmt: skip


def _close(client: Client) -> None:
    with suppress(OSError, TimeoutError):
        client.close(timeout=2)
