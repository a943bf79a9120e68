"""Ctrl-C, SIGTERM and SIGHUP that cost nothing that is finished; standard library only."""

from __future__ import annotations

import atexit
import gc
import io
import signal
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from types import FrameType

STOPS = [getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name)]
GRACE = 1.0  # s: a second Ctrl-C so soon is the same wish; a later one gives up waiting, too


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
        self._last = -GRACE

    def __call__(self, number: int, _: FrameType | None) -> None:
        now = time.monotonic()
        if self.number is not None and now - self._last < GRACE:
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
