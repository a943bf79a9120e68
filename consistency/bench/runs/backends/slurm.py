"""Jobs of Slurm, by submitit: each does its share of the runs and leaves what is finished in a folder that both see.

What is sent and what comes back are files, a part every few seconds, so that a job that dies loses no more.
"""

from __future__ import annotations

import itertools
import logging
import os
import pickle
import shutil
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import submitit

from consistency.bench.filters.stepping import reason_of
from consistency.bench.runs.backends.batches import Batch, Batches, Event, in_batches
from consistency.bench.runs.backends.local import worker_count
from consistency.bench.runs.backends.remote import Part, Worker, pickled_work
from consistency.bench.runs.trial_work import Outcomes, TrialWork
from consistency.referee.errors import InputError
from consistency.referee.system.progress import say

EVERY = 5.0  # s of work between parts
GLANCE = 1.0  # s between looks at the folder
LATE = 15.0  # s that a shared disk may take to show the last file of a job
JOBS = 16  # at a time
WORK = "work.pickle"  # in the folder of the jobs
MINUTES = 60  # of a job, which Slurm ends then; the rest of its runs is done by another


@dataclass(frozen=True)
class Slurm:
    """Jobs of one core each in an array.

    Parameters
    ----------
    folder : for the files of the jobs, on a disk that they see; made at the start and removed at the end
    options : of submitit for Slurm, such as ``partition``, ``time`` (minutes), ``account``, ``mem``, ``constraint``.
        ``cluster`` = ``local`` makes them processes of this machine, to try it out
    jobs : number at a time, -1 for 16

    Raises
    ------
    InputError
        The number of jobs makes no sense.
    """

    folder: Path
    options: Mapping[str, Any] = field(default_factory=dict)
    jobs: int = -1

    def __post_init__(self) -> None:
        worker_count(self.jobs)

    def prepare(self, work: TrialWork, run: int, /) -> None:
        """See :class:`consistency.bench.runs.trial_work.Backend`: the jobs compile."""

    def outcomes(self, work: TrialWork, runs: Sequence[int], /) -> Outcomes:
        """See :class:`consistency.bench.runs.trial_work.Backend`.

        Raises
        ------
        InputError
            There is no Slurm here, or it does not know an option; bad input, see
            :func:`consistency.bench.runs.backends.batches.in_batches`.
        """
        jobs = min(JOBS if self.jobs < 0 else self.jobs, len(runs))
        with closing(_Engine(self.folder, self.options, jobs, work)) as engine:
            yield from in_batches(engine, Batches(runs, retries=1, shares=False), work)


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


@dataclass
class _Job:
    batch: Batch
    submitted: Any  # submitit.Job
    outbox: Path
    parts: int = 0  # read so far
    over_since: float | None = None  # without a result


class _Engine:
    """See :class:`consistency.bench.runs.backends.batches.Engine`."""

    def __init__(self, folder: Path, options: Mapping[str, Any], room: int, work: TrialWork) -> None:
        self.room, self.folder = room, folder.absolute()
        self._jobs: list[_Job] = []
        self._names, self._lost, self._is_local = itertools.count(), 0, options.get("cluster") == "local"
        shutil.rmtree(self.folder, ignore_errors=True)  # jobs of a client that was killed end where they cannot write
        try:
            self._executor = self._made(dict(options))
            (self.folder / WORK).write_bytes(pickled_work(work))
        except BaseException:
            shutil.rmtree(self.folder, ignore_errors=True)
            raise

    def _made(self, options: dict[str, Any]) -> Any:
        cluster, minutes = options.pop("cluster", "slurm"), options.pop("time", MINUTES)
        logging.getLogger("submitit").setLevel(logging.CRITICAL)
        try:
            executor = submitit.AutoExecutor(self.folder, cluster=cluster)
            named = {f"slurm_{key}": value for key, value in ({"job_name": "consistency"} | options).items()}
            is_number = isinstance(minutes, int)
            named |= {"timeout_min": minutes} if is_number else {"slurm_time": minutes}
            executor.update_parameters(cpus_per_task=1, **named)
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"{self.folder}: the files of jobs cannot be written ({error.strerror})") from None
        except (RuntimeError, ValueError, NameError, AssertionError) as error:
            raise InputError(f"--backend slurm: {reason_of(error)}") from None
        return executor

    def submit(self, batches: Sequence[Batch]) -> None:
        """Batches as one job array."""
        if not batches:
            return
        outboxes = [self.folder / f"parts-{next(self._names)}" for _ in batches]
        for outbox in outboxes:
            outbox.mkdir()
        runs = [batch.runs for batch in batches]
        path = itertools.repeat(sys.path)
        try:
            submitted = self._executor.map_array(do_job, path, runs, map(str, outboxes))
        except (submitit.core.utils.FailedJobError, RuntimeError) as error:
            raise InputError(f"Slurm does not take the jobs: {reason_of(error)}") from None
        self._jobs += map(_Job, batches, submitted, outboxes)

    def events(self) -> list[Event]:
        """Parts that have come, and jobs that have ended."""
        events = [event for job in list(self._jobs) for event in self._events_of(job)]
        if not events:
            time.sleep(GLANCE)
        return events

    def _events_of(self, job: _Job) -> list[Event]:
        is_over = job.submitted.done()  # before the parts are read, so that none is missed
        events: list[Event] = []
        while (path := job.outbox / f"{job.parts}.pickle").exists():
            part: Part = pickle.loads(path.read_bytes())
            path.unlink()
            events.append((job.batch, part))
            job.parts += 1
        return events + (self._end_of(job) if is_over else [])

    def _end_of(self, job: _Job) -> list[Event]:
        """How a job ended; nothing where that may still be seen."""
        if job.submitted.paths.result_pickle.exists():
            error = job.submitted.exception()
            if error is not None:
                raise RuntimeError(f"a job of Slurm failed: {_last_line(str(error))}") from error
            self._jobs.remove(job)
            return [(job.batch, None)]
        job.over_since = job.over_since or time.monotonic()
        if time.monotonic() - job.over_since < (GLANCE if self._is_local else LATE):
            return []
        self._jobs.remove(job)
        self._lost += 1
        return [(job.batch, "its job died, and so did those that tried it again")]

    def close(self) -> None:
        """Cancel what is not done; logs stay where a job has died."""
        for job in self._jobs:
            with suppress(Exception):
                job.submitted.cancel(check=False)
        for job in self._jobs if self._is_local else ():
            with suppress(Exception):
                job.submitted._process.wait(10)
        if self._lost:
            say(f"consistency: {self._lost} jobs died; their logs are in {self.folder}")
        else:
            shutil.rmtree(self.folder, ignore_errors=True)


def do_job(path: Sequence[str], runs: Sequence[int], outbox: str) -> None:
    """In a job: leave parts in ``outbox``, each of which appears as a whole; modules are looked for in ``path``."""
    sys.path[:] = path
    worker = Worker(Path(outbox).with_name(WORK).read_bytes())
    try:
        for number, part in enumerate(worker.parts(runs, EVERY)):
            unfinished = Path(outbox) / "unfinished"
            unfinished.write_bytes(pickle.dumps(part))
            os.replace(unfinished, Path(outbox) / f"{number}.pickle")
    finally:
        worker.close()


def _last_line(text: str) -> str:
    """Of the traceback that submitit sets between two rules."""
    lines = [line for line in text.split("-" * 22)[1].splitlines() if line] if "-" * 22 in text else [text]
    return lines[-1]
