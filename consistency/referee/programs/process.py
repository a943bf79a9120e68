"""One run of a program: a process group of its own in a fresh folder, ended with all that it started there."""

from __future__ import annotations

import errno
import json
import os
import shutil
import signal
import subprocess
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

from consistency.referee.errors import InputError
from consistency.referee.programs.words import Program
from consistency.referee.readers.pipeline.program_runs import LOG, RUN_FILE, RUN_KIND, ProgramRun, filled
from consistency.referee.system.atomic import FULL
from consistency.referee.system.stopping import AT_STOP

Process = subprocess.Popen[bytes]
TAIL = 16384  # bytes of a log that are kept where a program has deleted it
LEAST_FREE = 2**16  # bytes of a disk, below which it counts as full
VARIABLES = ("run", "seed", "out", "here", "worker", "input", "name")


class Processes:
    """Processes of the runs in progress, which are killed together at the end, or by a signal to this process."""

    def __init__(self) -> None:
        AT_STOP.append(self.stop)
        self._lock = threading.Lock()
        self._running: set[Process] = set()
        self._is_stopped = False

    @contextmanager
    def started(self, words: list[str], cwd: Path, log: int, env: Mapping[str, str]) -> Iterator[Process]:
        """A process in a group of its own; at the end the whole group is killed."""
        with self._lock:
            if self._is_stopped:
                raise Stopped
            process = subprocess.Popen(
                words, cwd=cwd, env=dict(env), stdin=subprocess.DEVNULL, stdout=log, stderr=subprocess.STDOUT,
                start_new_session=True,
            )  # fmt: skip
            self._running.add(process)
        try:
            yield process
        finally:
            _kill_group(process)  # what the program has left behind
            process.wait()
            with self._lock:
                self._running.discard(process)

    @property
    def is_stopped(self) -> bool:
        return self._is_stopped

    def close(self) -> None:
        """Kill every run in progress, and start no other."""
        self.stop()
        AT_STOP.remove(self.stop)

    def stop(self) -> None:
        with self._lock:
            self._is_stopped = True
            for process in self._running:
                _kill_group(process)


class Stopped(Exception):
    """The study was stopped while this run was in progress: it is not finished."""


def _kill_group(process: Process) -> None:
    with suppress(ProcessLookupError, PermissionError):  # macOS refuses a group of which all have ended
        os.killpg(process.pid, signal.SIGKILL)


def run_program(
    program: Program,
    folder: Path,
    run: int,
    values: Mapping[str, str],
    timeout: float | None,
    processes: Processes,
) -> ProgramRun:
    """Do one run in a fresh folder, and say in its ``run.json`` how it ended.

    Parameters
    ----------
    values : what stands for each placeholder
    timeout : s, after which the run is killed

    Raises
    ------
    Stopped
        The study stopped meanwhile.
    InputError
        The disk is full: the run is not finished, whatever the program left.
    """
    try:
        done = _done(program, folder, run, values, timeout, processes)
        if shutil.disk_usage(folder).free < LEAST_FREE:  # a file of the program may be cut short
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        finish(done)
    except OSError as error:
        if error.errno not in FULL:
            raise
        what = f"the disk is full ({error.strerror}), and run {run} does not count"
        raise InputError(f"{folder}: {what}; free some space, then the same command with --resume continues") from None
    return done


def _done(
    program: Program,
    folder: Path,
    run: int,
    values: Mapping[str, str],
    timeout: float | None,
    processes: Processes,
) -> ProgramRun:
    """Do one run as :func:`run_program`, without its ``run.json``."""
    folder.mkdir(parents=True)
    words = [filled(word, values) for word in program.words]
    env = {**os.environ, **{f"CONSISTENCY_{name.upper()}": values[name] for name in VARIABLES if name in values}}
    started = time.monotonic()
    with (folder / LOG).open("w+b") as log:
        failure = _outcome(words, program.cwd or folder, log.fileno(), env, timeout, processes)
        log.seek(max(0, log.seek(0, 2) - TAIL))
        tail = log.read()
    if not (folder / LOG).exists():
        folder.mkdir(parents=True, exist_ok=True)
        (folder / LOG).write_bytes(tail)
        failure = failure or "the program deleted its folder"
    return ProgramRun(folder, run, dict(values), failure, round(time.monotonic() - started, 3))


def finish(run: ProgramRun) -> None:
    """Write the ``run.json`` of a run, by which it counts as finished."""
    data = {"kind": RUN_KIND, "run": run.run, "values": run.values, "failure": run.failure, "seconds": run.seconds}
    partial = run.folder / f"{RUN_FILE}.partial"
    partial.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")
    partial.replace(run.folder / RUN_FILE)


def _outcome(
    words: list[str], cwd: Path, log: int, env: Mapping[str, str], timeout: float | None, processes: Processes
) -> str:
    """Run the words, and return why they failed; "" if they ended well."""
    try:
        with processes.started(words, cwd, log, env) as process, _killed_after(timeout, process) as is_late:
            status = process.wait()
    except (OSError, ValueError) as error:
        return f"the program cannot be started ({getattr(error, 'strerror', None) or error})"
    if processes.is_stopped:
        raise Stopped
    if is_late.is_set():
        return f"it was killed after {timeout:g} s (--timeout)"
    if status < 0:
        return f"it was killed by {_signal_name(-status)}"
    return f"it ended with status {status}" if status else ""


@contextmanager
def _killed_after(timeout: float | None, process: Process) -> Iterator[threading.Event]:
    """Kill the process after so many seconds; the event says that it happened."""
    is_late = threading.Event()
    if timeout is None:
        yield is_late
        return

    def end() -> None:
        if process.poll() is None:
            is_late.set()
            _kill_group(process)

    timer = threading.Timer(timeout, end)
    timer.start()
    try:
        yield is_late
    finally:
        timer.cancel()


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"
