"""The command line in a process of its own."""

from __future__ import annotations

import atexit
import json
import os
import select
import shlex
import signal
import subprocess
import sys
import tempfile
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any

LIMIT = 120.0  # s, of a command that compiles nothing new, on a busy machine
COMPILING = 300.0  # s, of one that may


def consistency(*arguments: str, cwd: Path, status: int = 0) -> subprocess.CompletedProcess[str]:
    """Run the command line; the exit status must be ``status``."""
    if arguments[0] == "compile" or not hasattr(os, "fork"):  # it may choose a processor before Numba is loaded
        command = [sys.executable, "-m", "consistency", *arguments]
        done = subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=COMPILING)
    else:
        environment = {name: value for name, value in os.environ.items() if name != "PYTEST_CURRENT_TEST"}
        done = _starter(tuple(environment.items()))(list(arguments), cwd)
    assert done.returncode == status, done.stdout + done.stderr
    assert "Traceback" not in done.stderr
    return done


STARTER = """
import gc, json, os, sys
import consistency.referee.cli, consistency.referee.show.html, consistency.referee.show.with_matplotlib
import consistency.referee.show.pdf, consistency.referee.verdicts.comparison, consistency.bench.runs.montecarlo
from consistency.__main__ import main

consistency.get_filter("ekf-uvd")
gc.freeze()  # a fork that looks through all of it, to collect or to end, has a copy of it first

for line in sys.stdin:
    arguments, folder, streams = json.loads(line)
    if child := os.fork():
        print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
        continue
    os.chdir(folder)
    for number, path in enumerate(streams):
        os.dup2(os.open(path, os.O_RDWR), number)
    sys.argv = ["consistency", *arguments]
    sys.exit(main())
"""


class _Starter:
    """A process that has imported what commands need, and forks for each: most of a short command is its imports.

    Commands start from nothing where they are begun (:func:`begun`) and in tests/smoke/test_documents_run.py.
    """

    def __init__(self, environment: tuple[tuple[str, str], ...]) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-c", STARTER], text=True, start_new_session=True, env=dict(environment),
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        atexit.register(self._end)

    def __call__(self, arguments: list[str], cwd: Path) -> subprocess.CompletedProcess[str]:
        requests, replies = self._process.stdin, self._process.stdout
        assert requests is not None
        assert replies is not None
        with tempfile.NamedTemporaryFile() as out, tempfile.NamedTemporaryFile() as err:
            streams = [os.devnull, out.name, err.name]
            print(json.dumps([arguments, str(cwd), streams]), file=requests, flush=True)
            if not select.select([replies], [], [], COMPILING)[0]:
                _starter.cache_clear()
                self._end()
                raise TimeoutError(f"consistency {shlex.join(arguments)}: no end after {COMPILING:.0f} s")
            code = int(replies.readline())
            said = [Path(path).read_text(encoding="utf-8") for path in streams[1:]]
        return subprocess.CompletedProcess(["consistency", *arguments], code, *said)

    def _end(self) -> None:
        with suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.communicate()


_starter = cache(_Starter)


BEGUN: list[subprocess.Popen[str]] = []  # ended after the test, whatever became of it


def begun(*arguments: str, cwd: Path, **popen: Any) -> subprocess.Popen[str]:
    """The command line in a session of its own, with signals as in a terminal (nohup ignores SIGHUP)."""
    code = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
    code += "signal.signal(signal.SIGHUP, signal.SIG_DFL)\n"
    code += "from consistency.referee.cli import main; main()"
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE} | popen
    process = subprocess.Popen(
        [sys.executable, "-c", code, *arguments], cwd=cwd, text=True, start_new_session=True, **pipes
    )
    BEGUN.append(process)
    return process


def size_of(path: Path) -> int:
    """Bytes of a file that may go at any moment; 0 if it is not there."""
    try:
        return path.stat().st_size
    except FileNotFoundError:
        return 0
