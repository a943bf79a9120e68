"""Jobs of Slurm as an executor, by submitit, which knows when a job has ended only if it is asked."""

from __future__ import annotations

import logging
import shutil
import sys
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor, Future
from contextlib import suppress
from functools import cached_property, partial
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any, TypeVar

import submitit

from consistency.bench.runs.workers import worker_count
from consistency.referee.errors import InputError
from consistency.referee.parsing import one_line
from consistency.referee.system import say

Result = TypeVar("Result")
Call = tuple[Future[Any], Callable[[], Any]]
GLANCE = 1.0  # s between looks at the jobs
JOBS = 16  # at a time
MINUTES = 60  # of a job, which Slurm ends then


class SlurmExecutor(Executor):
    """Jobs of one core each. What is submitted between two looks is sent as an array.

    Parameters
    ----------
    folder : for the files of the jobs, on a disk that they see; made at the first look and removed at the end
    options : of submitit for Slurm, such as ``partition``, ``time`` (minutes), ``account``, ``mem``, ``constraint``.
        ``cluster`` = ``local`` makes them processes of this machine, to try it out
    jobs : number at a time, -1 for 16

    Raises
    ------
    InputError
        The number of jobs makes no sense. From ``submit``: there is no Slurm here, or it does not know an option.
    """

    batch_seconds = 600.0

    def __init__(self, folder: Path, options: Mapping[str, Any] | None = None, jobs: int = -1) -> None:
        self.at_a_time = worker_count(jobs) if jobs != -1 else JOBS
        self.folder, self.options = folder.absolute(), dict(options or {})
        self._waiting, self._jobs = SimpleQueue[Call](), dict[Any, Future[Any]]()
        self._is_over, self._died = threading.Event(), 0

    def submit(self, function: Callable[..., Result], /, *args: Any, **options: Any) -> Future[Result]:
        """See :meth:`concurrent.futures.Executor.submit`."""
        _ = self._looks
        future: Future[Result] = Future()
        self._waiting.put((future, partial(_with_path, tuple(sys.path), partial(function, *args, **options))))
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Cancel what is not done; logs stay where a job has died."""
        if "_looks" not in vars(self):
            return
        self._is_over.set()
        self._looks.join()
        for job in self._jobs:
            with suppress(Exception):
                job.cancel(check=False)
        if self.options.get("cluster") == "local":
            for job in self._jobs:
                with suppress(Exception):
                    job._process.wait(10)
        if self._died:
            say(f"consistency: {self._died} jobs died; their logs are in {self.folder}")
        else:
            shutil.rmtree(self.folder, ignore_errors=True)

    @cached_property
    def _looks(self) -> threading.Thread:
        """A thread that sends what waits, and looks at the jobs, until the end."""
        options = {"job_name": "consistency"} | self.options
        cluster, minutes = options.pop("cluster", "slurm"), options.pop("time", MINUTES)
        logging.getLogger("submitit").setLevel(logging.CRITICAL)
        shutil.rmtree(self.folder, ignore_errors=True)  # jobs of a command that was killed end where they cannot write
        try:
            executor = submitit.AutoExecutor(self.folder, cluster=cluster)
            limit = {"timeout_min": minutes} if isinstance(minutes, int) else {"slurm_time": minutes}
            named = {f"slurm_{key}": value for key, value in options.items()}
            executor.update_parameters(cpus_per_task=1, **named, **limit)
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"{self.folder}: the files of jobs cannot be written ({error.strerror})") from None
        except (RuntimeError, ValueError, NameError, AssertionError) as error:
            shutil.rmtree(self.folder, ignore_errors=True)
            raise InputError(f"--backend slurm: {one_line(f'{type(error).__name__}: {error}', 400)}") from None
        thread = threading.Thread(target=self._look, args=(executor,), daemon=True)
        thread.start()
        return thread

    def _look(self, executor: Any) -> None:
        while not self._is_over.wait(GLANCE):
            self._send(executor)
            for job, future in list(self._jobs.items()):
                if future.cancelled():
                    job.cancel(check=False)
                    del self._jobs[job]
                elif job.done() and future.set_running_or_notify_cancel():
                    del self._jobs[job]
                    try:
                        future.set_result(job.result())
                    except Exception as error:
                        self._died += 1
                        future.set_exception(error)

    def _send(self, executor: Any) -> None:
        calls: list[Call] = []
        with suppress(Empty):
            while True:
                calls.append(self._waiting.get_nowait())
        if not calls:
            return
        try:
            jobs = executor.submit_array([call for _, call in calls])
        except (submitit.core.utils.FailedJobError, OSError, RuntimeError) as error:
            refusal = InputError(f"Slurm does not take the jobs: {one_line(f'{error}', 400)}")
            for future, _ in calls:
                future.set_exception(refusal)
        else:
            self._jobs |= dict(zip(jobs, (future for future, _ in calls), strict=True))


def options_of(texts: Sequence[str]) -> dict[str, Any]:
    """Options from ``key=value``, numbers as such.

    Raises
    ------
    InputError
        A text of another form.
    """
    options: dict[str, Any] = {}
    for text in texts:
        key, equals, value = text.partition("=")
        if not (key.isidentifier() and equals and value):
            raise InputError(f"--slurm takes KEY=VALUE, such as partition=short or time=60, got '{text}'")
        options[key] = int(value) if value.isdecimal() else value
    return options


def _with_path(path: Sequence[str], call: Callable[[], Result]) -> Result:
    """In a job: look for modules in ``path``, too."""
    sys.path[:] = path
    return call()
