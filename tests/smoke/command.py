"""The command line in a process of its own."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

LIMIT = 120.0  # s, of a command that compiles nothing new, on a busy machine
COMPILING = 300.0  # s, of one that may


def consistency(*arguments: str, cwd: Path, status: int = 0) -> subprocess.CompletedProcess[str]:
    """Run the command line; the exit status must be ``status``."""
    done = subprocess.run(
        [sys.executable, "-m", "consistency", *arguments], cwd=cwd, capture_output=True, text=True, timeout=COMPILING
    )
    assert done.returncode == status, done.stdout + done.stderr
    assert "Traceback" not in done.stderr
    return done


BEGUN: list[subprocess.Popen[str]] = []  # ended after the test, whatever became of it


def begun(*arguments: str, cwd: Path, **popen: Any) -> subprocess.Popen[str]:
    """The command line in a session of its own, with signals as in a terminal (nohup ignores SIGHUP)."""
    code = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
    code += "signal.signal(signal.SIGHUP, signal.SIG_DFL)\n"
    code += "from consistency.cli import main; main()"
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
