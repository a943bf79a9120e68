"""The command of a program with its placeholders and seeds, and one run of it.

A run is a process group of its own in a fresh folder.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import re
import shutil
import signal
import subprocess
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from consistency.referee.errors import InputError
from consistency.referee.parsing import is_file, require_name
from consistency.referee.readers.pipeline.program_runs import LOG, RUN_FILE, RUN_KIND, ProgramRun, filled
from consistency.referee.system import AT_STOP, FULL, digest_of_file, say

LARGEST_SEED = 2**31 - 1  # fits an int and std::stoi
HALF = 2**16
ROUNDS = 4  # of the Feistel network
SCRIPTS = (".py", ".jl", ".m", ".r", ".sh", ".js", ".rb", ".lua", ".pl")  # files that an interpreter runs
OF_A_RUN = ("{run}", "{seed}", "{out}", "{worker}", "{input}", "{name}")
Process = subprocess.Popen[bytes]
TAIL = 16384  # bytes of a log that are kept where a program has deleted it
LEAST_FREE = 2**16  # bytes of a disk, below which it counts as full
VARIABLES = ("run", "seed", "out", "here", "worker", "input", "name")


def seed_of(seed: int, run: int) -> int:
    """Seed of a run, from 1 to 2^31 - 1, different for every run of a study.

    A Feistel network with a keyed hash permutes the numbers of 32 bits, and is repeated until its result is in the
    range (cycle walking, Black & Rogaway 2002).
    """
    value = run + 1
    while True:
        left, right = divmod(value, HALF)
        for number in range(ROUNDS):
            key = hashlib.blake2b(f"{seed} {number} {right}".encode(), digest_size=2).digest()
            left, right = right, left ^ int.from_bytes(key, "big")
        value = left * HALF + right
        if 1 <= value <= LARGEST_SEED:
            return value


@dataclass(frozen=True)
class Program:
    """A command with placeholders, called from ``here``; ``cwd`` None is the folder of each run."""

    words: tuple[str, ...]
    here: Path
    cwd: Path | None = None
    name: str = ""  # what a verdict calls it

    @property
    def uses_run(self) -> bool:
        """Whether a word differs from run to run in what the program computes."""
        return any(part in word for word in self.words for part in ("{seed}", "{run}", "{input}", "{name}"))

    def files(self) -> dict[str, str]:
        """Digest of every file that a word names."""
        found = {}
        for word in self.words:
            for name in {word, word.rpartition("=")[2]}:  # by itself or behind an equals sign
                path = (self.cwd or self.here) / filled(name, {"here": str(self.here)})
                if path.is_file():
                    found[str(path)] = digest_of_file(path).hex()
        return found

    def warn_of_relative_paths(self) -> None:
        """Say which words name a file that the program will not see from its folder."""
        for word in self.words[1:] if self.cwd is None else ():
            name = word.rpartition("=")[2]
            if not Path(name).is_absolute() and (Path(name).suffix or os.sep in name) and _is_there(self.here / name):
                say(f"consistency: {name} is not seen from the run's folder; write {{here}}/{name}")


def program_of(words: Sequence[str], here: Path, cwd: Path | None = None, hint: str = "") -> Program:
    """The command with its first word found, from where the user stands or on the PATH.

    Parameters
    ----------
    hint : advice for a command that does not exist

    Raises
    ------
    InputError
        There is no such program, or it cannot be executed.
    """
    if isinstance(words, str) or not words or not all(isinstance(word, str) for word in words):
        raise InputError("the command must be a list of words, the program first: -- ./build/ekf {seed}")
    if any("\0" in word for word in words):
        raise InputError("the command: a word holds a character NUL, which no program can be given")
    first = filled(words[0], {"here": str(here)})
    if not any(part in first for part in OF_A_RUN):
        first = _found(first, here, hint)
    if cwd is not None:
        cwd = here / cwd
        if not cwd.is_dir():
            raise InputError(f"--cwd {cwd}: no such folder")
    return Program((first, *words[1:]), here, cwd, _name(words, here, cwd))


def _name(words: Sequence[str], here: Path, cwd: Path | None) -> str:
    """What the user calls a program: its file, or the script that an interpreter on the PATH runs."""
    name = words[0]
    if os.sep not in name:
        for word in words[1:]:
            file = (cwd or here) / filled(word, {"here": str(here)})
            if file.suffix.lower() in SCRIPTS and is_file(file):
                name = word
                break
    name = name.replace("{here}/", "")
    if Path(name).is_absolute():
        name = Path(name).name
    return require_name(name, "the command")


def _found(first: str, here: Path, hint: str) -> str:
    """Absolute path of the program that the first word names."""
    if os.sep not in first:
        found = shutil.which(first)
        if found is not None:
            return os.path.abspath(found)
        beside = f"; write ./{first} for the file that is here" if _is_there(here / first) else hint
        raise InputError(f"{first}: no such command{beside}")
    path = here / first
    if not _is_there(path):
        raise InputError(f"{first}: no such program{hint}")
    if path.is_dir():
        raise InputError(f"{first}: is a folder, not a program")
    if not os.access(path, os.X_OK):
        raise InputError(
            f"{first}: cannot be executed; make it so with chmod +x, or put its interpreter before it{hint}"
        )
    return os.path.abspath(path)


def _is_there(path: Path) -> bool:
    try:
        return path.exists()
    except (OSError, ValueError):  # a word that no file can be called
        return False


def inputs_of(pattern: str, here: Path) -> list[Path]:
    """Recorded files or folders of ``--each``, absolute, by name.

    Raises
    ------
    InputError
        There are none.
    """
    base, relative = here, pattern
    if Path(pattern).is_absolute():
        base = Path(Path(pattern).anchor)
        relative = str(Path(pattern).relative_to(base))
    try:
        found = sorted(path for path in base.glob(relative) if not path.name.startswith("."))
    except (ValueError, NotImplementedError, re.error) as error:
        raise InputError(f"--each {pattern}: is not a pattern of files ({error})") from None
    if not found:
        raise InputError(f"--each {pattern}: no file or folder is called so; quote the pattern: --each 'logs/*'")
    return [Path(os.path.abspath(path)) for path in found]


class Processes:
    """Processes of the runs in progress, which are killed together at the end, or by a signal to this process."""

    def __init__(self) -> None:
        AT_STOP.append(self.stop)
        self._lock = threading.Lock()
        self._running: set[Process] = set()
        self.is_stopped = False

    @contextmanager
    def started(self, words: list[str], cwd: Path, log: int, env: Mapping[str, str]) -> Iterator[Process]:
        """A process in a group of its own; at the end the whole group is killed."""
        with self._lock:
            if self.is_stopped:
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

    def close(self) -> None:
        """Kill every run in progress, and start no other."""
        self.stop()
        AT_STOP.remove(self.stop)

    def stop(self) -> None:
        with self._lock:
            self.is_stopped = True
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
        name = f"signal {-status}"
        with suppress(ValueError):  # a number without a name
            name = signal.Signals(-status).name
        return f"it was killed by {name}"
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
