"""Signals: calls that none disturbs, and worker processes that end with their parent. Standard library only."""

from __future__ import annotations

import ctypes
import os
import shutil
import signal
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

Result = TypeVar("Result")
IS_LINUX = sys.platform == "linux"
AT_STOP: list[Callable[[], None]] = []  # what is to be ended before a signal ends this process
WRITERS = 3  # times that a folder is removed, as a thread may be writing into it
PR_SET_PDEATHSIG = 1  # linux/prctl.h


def remove_at_stop(folder: Path) -> Callable[[], None]:
    """Have a half-written folder removed where a signal ends this process; return what ``AT_STOP`` has for it."""

    def remove() -> None:
        for _ in range(WRITERS):
            shutil.rmtree(folder, ignore_errors=True)

    AT_STOP.append(remove)
    return remove


def away_from_signals(call: Callable[..., Result], *args: Any) -> Result:
    """Return ``call(*args)``, which a thread does while the main one waits; KeyboardInterrupt comes after its end.

    Python runs handlers of signals in the main thread. One that raises where Numba or pyarrow turn their values into
    Python's meets code that expects no exception, and Python crashes.
    """
    if threading.current_thread() is not threading.main_thread():
        return call(*args)
    from concurrent.futures import ThreadPoolExecutor

    with ThreadPoolExecutor(1) as pool:
        pool.submit(int).result()  # a pool waits at its end for the threads that it knows to have begun
        return pool.submit(call, *args).result()


def link_to_parent(context: Any) -> tuple[int, Any]:
    """Return what a worker gives to :func:`end_with_parent`, which ``context`` of multiprocessing starts.

    These are the number of this process and the end of a pipe into which nobody writes. This process alone has its
    other end, so that the pipe is closed when this process ends.
    """
    return os.getpid(), _pipe(context)[0]


@cache
def _pipe(context: Any) -> tuple[Any, Any]:
    ends: tuple[Any, Any] = context.Pipe(duplex=False)
    return ends


def end_with_parent(parent: int, alive: Any) -> None:
    """Have the system kill this worker when its parent ends; ``alive`` is its end of the pipe.

    On Linux the signal comes when the *thread* ends that started the worker, so start workers in one that lives as
    long as they are to.
    """
    if not IS_LINUX:
        threading.Thread(target=_wait_for_the_end, args=(alive,), daemon=True).start()
        return
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL, 0, 0, 0)
    if os.getppid() != parent:  # it had ended before
        os._exit(1)


def _wait_for_the_end(alive: Any) -> None:
    with suppress(OSError, EOFError):
        alive.recv_bytes()
    os._exit(1)
