"""Compiled code in a thread that takes no signals; standard library only.

Python's handlers run in the main thread. One that raises where Numba turns arguments into machine values, or results
back, finds code that expects no exception, and Python crashes. It also aborts where compiled code ends while Python
shuts down, so what was given up is waited for at exit. What then still compiles goes on until the process is gone, and
crashes where the destructors of LLVM go first: they are left out, and the system takes all back.
"""

from __future__ import annotations

import _thread
import atexit
import ctypes
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any, TypeVar

Result = TypeVar("Result")
GLANCE = 0.1  # s between looks, for a signal that another thread was given
PATIENCE = 0.5  # s for what was told to stop
AT_EXIT = 1.0  # s for all that was given up: two seconds after a signal nothing is left
_given_up: list[_thread.LockType] = []


def apart(call: Callable[..., Result], *args: Any, stop: Callable[[], None] | None = None) -> Result:
    """``call(*args)``, from the main thread in a thread of its own, for which it waits.

    Where a handler of a signal raises meanwhile, ``stop`` is called, if it is given, and the exception goes on; the
    thread ends when it can.
    """
    if threading.current_thread() is not threading.main_thread():
        return call(*args)
    left: list[Result] = []
    errors: list[BaseException] = []
    working = threading.Lock()
    working.acquire()

    def work() -> None:
        try:
            left.append(call(*args))
        except BaseException as error:
            errors.append(error)
        finally:
            working.release()

    try:
        _thread.start_new_thread(work, ())  # a third of the time of a Thread, which shows in short trials
        while not working.acquire(timeout=GLANCE):
            pass
    except BaseException:
        if not (left or errors):  # else the lock may be held here already
            if stop is not None:
                stop()
            if not working.acquire(timeout=0.0 if stop is None else PATIENCE):
                _given_up.append(working)
        raise
    if errors:
        raise errors[0]
    return left[0]


@atexit.register
def _wait_for_given_up() -> None:
    until = time.monotonic() + AT_EXIT
    if not all(working.acquire(timeout=max(0.0, until - time.monotonic())) for working in _given_up):
        with suppress(AttributeError, OSError):  # glibc alone; what is registered last is called first, with the status
            libc = ctypes.CDLL(None)
            libc.on_exit(libc._exit, None)
