"""Ctrl-C, SIGTERM and SIGHUP that cost nothing that is finished, and a command that is gone within two seconds of one.

The command runs in a child of the process that was started, which waits and does nothing else. Python answers a signal
between two bytecodes of the main thread; a compiler or a reader of files in C may keep it from that for minutes, and no
handler can change it. The parent passes signals on, and kills what has not ended by itself. Standard library only.
"""

from __future__ import annotations

import atexit
import ctypes
import gc
import io
import os
import select
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Any, NoReturn

STOPS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
AGAIN = 1.0  # s: a second Ctrl-C so soon is the same wish; a later one gives up waiting, too


def end_soon() -> None:
    """At exit: spare Python the search for cycles, a second where a compiler is loaded; open files are flushed."""
    for each in gc.get_objects():
        if type(each) in (io.TextIOWrapper, io.BufferedWriter, io.BufferedRandom):
            with suppress(Exception):
                each.flush()
    gc.freeze()


class Stop:
    """Handler of signals: raises KeyboardInterrupt, and remembers in ``number`` which signal came first.

    Whoever is called when a signal comes may turn KeyboardInterrupt into another exception, as serialisers of pydantic
    do, or drop it, as callbacks of compilers do; so that ``number`` is to be asked, too.
    """

    def __init__(self) -> None:
        self.number: int | None = None
        self._last = -AGAIN

    def __call__(self, number: int, _: FrameType | None) -> None:
        now = time.monotonic()
        if self.number is not None and now - self._last < AGAIN:
            return
        self.number, self._last = self.number or number, now
        atexit.unregister(end_soon)
        atexit.register(end_soon)
        raise KeyboardInterrupt

    @property
    def status(self) -> int:
        """Exit status of a process that a signal has stopped."""
        return 128 + (self.number or signal.SIGINT)


@contextmanager
def stoppable(also: Sequence[int] = ()) -> Iterator[Stop]:
    """Let a :class:`Stop` take Ctrl-C, and the signals in ``also`` where they would end the process.

    Inside another such context its stop counts. Signals that the program takes or ignores itself stay as they are, and
    so do all of them outside the main thread.
    """
    outer = [handler for handler in map(signal.getsignal, STOPS) if isinstance(handler, Stop)]
    if outer:
        yield outer[0]
        return
    stop, before = Stop(), {number: signal.getsignal(number) for number in STOPS}
    if threading.current_thread() is not threading.main_thread():
        before = {}
    before = {
        number: handler
        for number, handler in before.items()
        if handler is signal.default_int_handler or (number in also and handler == signal.SIG_DFL)
    }
    for number in before:
        signal.signal(number, stop)
    dropped = sys.unraisablehook

    def quiet(unraisable: sys.UnraisableHookArgs) -> None:
        if not (stop.number and issubclass(unraisable.exc_type, KeyboardInterrupt)):
            dropped(unraisable)

    sys.unraisablehook = quiet  # a callback that drops the interrupt would print it; ``stop.number`` remembers it
    try:
        yield stop
    finally:
        if sys.unraisablehook is quiet:
            sys.unraisablehook = dropped
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def undisturbed() -> Iterator[None]:
    """None of these signals before what is being written is whole."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, signal.SIG_IGN) for number in STOPS}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler or signal.SIG_DFL)


GRACE = 1.4  # s to end by itself; what is left of 2 s is for the kernel, which frees memory
LEAVE = 0.3  # s that processes of the command have to go after it
PR_SET_PDEATHSIG, PR_SET_CHILD_SUBREAPER = 1, 36  # linux/prctl.h
IS_LINUX = sys.platform == "linux"
_is_child = False


def supervised(work: Callable[[], Any]) -> Any:
    """Do ``work`` in a child, and end with its exit status; 128 + n after signal n.

    Signals that the caller ignores stay ignored. Where there is no fork, where the program takes one of the signals
    itself, or where it has threads, ``work`` is done here.
    """
    handlers = {number: signal.getsignal(number) for number in STOPS}
    own = [h for h in handlers.values() if h not in (signal.SIG_DFL, signal.SIG_IGN, signal.default_int_handler)]
    if _is_child or own or not hasattr(os, "fork") or threading.active_count() > 1:
        return work()
    numbers = [number for number, handler in handlers.items() if handler != signal.SIG_IGN]
    before = signal.pthread_sigmask(signal.SIG_BLOCK, STOPS)
    alive = os.pipe()  # its end says that the parent is dead
    parent = os.getpid()
    for stream in (sys.stdout, sys.stderr):
        if stream is not None:
            stream.flush()
    child = os.fork()
    if child:
        os.close(alive[0])
        _wait(child, numbers, before)
    os.close(alive[1])
    _settle(parent, alive[0], numbers)
    signal.pthread_sigmask(signal.SIG_SETMASK, before)
    try:
        return work()
    except SystemExit as end:
        if isinstance(end.code, int) and end.code - 128 in numbers:  # threads may compile, which nobody waits for
            _leave(end.code)
        raise


def _settle(parent: int, alive: int, numbers: list[int]) -> None:
    """In the child: die with the parent, and at once by a signal that comes before the command takes it."""
    global _is_child
    _is_child = True
    for number in numbers:
        signal.signal(number, signal.SIG_DFL)
    if IS_LINUX:
        die_with_parent()
        if os.getppid() != parent:
            os._exit(1)
    else:
        threading.Thread(target=_watch, args=(alive,), daemon=True).start()


def _watch(alive: int) -> None:
    os.read(alive, 1)
    os.kill(os.getpid(), signal.SIGKILL)


def die_with_parent() -> None:
    """Let the system kill this process when the thread that started it ends; Linux alone can."""
    _prctl(PR_SET_PDEATHSIG, signal.SIGKILL)


def _prctl(option: int, value: int) -> None:
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(option, value, 0, 0, 0)


def _leave(status: int) -> NoReturn:
    for stream in (sys.stdout, sys.stderr):
        with suppress(Exception):
            stream.flush()
    os._exit(status)


# --- in the parent -------------------------------------------------------------------------------


def _wait(child: int, numbers: list[int], mask: set[int | signal.Signals]) -> NoReturn:
    """Pass signals on until the child has ended, and end as it did, or as the first signal demands."""
    if IS_LINUX:
        _prctl(PR_SET_CHILD_SUBREAPER, 1)
    came, waker = os.pipe()
    os.set_blocking(came, False)
    os.set_blocking(waker, False)
    signal.set_wakeup_fd(waker, warn_on_full_buffer=False)
    for number in [*numbers, signal.SIGCHLD]:
        signal.signal(number, lambda *_: None)
    signal.pthread_sigmask(signal.SIG_SETMASK, mask)
    first, until, is_killed = 0, float("inf"), False
    while (status := _status_of(child)) is None:
        left = until - time.monotonic()
        if left <= 0.0:
            is_killed, until = True, float("inf")
            os.kill(child, signal.SIGKILL)
            continue
        select.select([came], [], [], min(left, 60.0))
        for number in _read(came):
            if number in numbers:
                first, until = first or number, min(until, time.monotonic() + GRACE)
                os.kill(child, number)
    if first:
        _end_descendants()
        if is_killed or status < 0:
            _say_stopped()
        os._exit(128 + first)
    if status < 0:
        _die_by(-status)
    os._exit(status)


def _read(came: int) -> bytes:
    try:
        return os.read(came, 512)
    except BlockingIOError:
        return b""


def _status_of(child: int) -> int | None:
    """Exit status, minus the signal that killed it; None where it lives. Others that have ended are reaped."""
    while True:
        try:
            pid, status = os.waitpid(-1, os.WNOHANG)
        except ChildProcessError:
            return 1
        if pid == child:
            return os.waitstatus_to_exitcode(status)
        if pid == 0:
            return None


def _end_descendants() -> None:
    """Kill what the command has left; orphans become children of this process (Linux)."""
    until = time.monotonic() + LEAVE
    while time.monotonic() < until and (left := list(_children())):
        for pid in left:
            with suppress(ProcessLookupError, PermissionError):
                os.kill(pid, signal.SIGKILL)
        with suppress(ChildProcessError):
            while os.waitpid(-1, os.WNOHANG)[0]:
                pass
        time.sleep(0.002)


def _children() -> Iterator[int]:
    """Processes whose parent is this one, of /proc; none where there is no such thing."""
    own = os.getpid()
    for name in os.listdir("/proc") if IS_LINUX else ():
        if name.isdecimal():
            with suppress(OSError), open(f"/proc/{name}/stat", encoding="utf-8", errors="replace") as file:
                if int(file.read().rpartition(")")[2].split()[1]) == own:
                    yield int(name)


def _say_stopped() -> None:
    keeps = sys.argv[1:2] in (["run"], ["sweep"])
    kept = "; finished runs are kept where there are any: the same command goes on, 'run' with --resume" * keeps
    with suppress(OSError):
        os.write(2, f"consistency: stopped{kept}\n".encode())


def _die_by(number: int) -> NoReturn:
    """Die by signal ``number``, as the child did, without a core dump."""
    with suppress(ImportError, ValueError, OSError):
        import resource

        resource.setrlimit(resource.RLIMIT_CORE, (0, resource.getrlimit(resource.RLIMIT_CORE)[1]))
    with suppress(OSError, ValueError):
        signal.signal(number, signal.SIG_DFL)
    os.kill(os.getpid(), number)
    os._exit(128 + number)
