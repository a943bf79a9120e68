"""Ctrl-C that is not lost."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def remembered() -> Iterator[Callable[[], bool]]:
    """Gives a function that says whether Ctrl-C, or SIGTERM where it is taken as such, has come.

    KeyboardInterrupt is raised as ever. But whoever is called may turn it into another exception, as serialisers of
    pydantic do, or drop it, as callbacks of compilers do; then the one who asks learns of it here.
    """
    came = False

    def stop(_: int, __: FrameType | None) -> None:
        nonlocal came
        came = True
        raise KeyboardInterrupt

    numbers = [n for n in (signal.SIGINT, signal.SIGTERM) if signal.getsignal(n) is signal.default_int_handler]
    if threading.current_thread() is not threading.main_thread():
        numbers = []
    for number in numbers:
        signal.signal(number, stop)
    try:
        yield lambda: came
    finally:
        for number in numbers:
            signal.signal(number, signal.default_int_handler)
