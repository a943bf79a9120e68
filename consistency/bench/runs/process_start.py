"""The first moments of the process of a filter; light, so that they come before the seconds that its imports take."""

from __future__ import annotations

import contextlib
import os
import signal
from multiprocessing.connection import Connection

from consistency.referee.system import end_with_parent

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]


def begin(output: Connection, parent: int, alive: Connection) -> None:
    """End with the parent, ignore its Ctrl-C, leave no core, print into ``output``."""
    end_with_parent(parent, alive)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)  # Pebble has a handler, which code in C would keep waiting
    if resource is not None:
        resource.setrlimit(resource.RLIMIT_CORE, (0, resource.getrlimit(resource.RLIMIT_CORE)[1]))
    for number in (1, 2):
        with contextlib.suppress(OSError):
            os.dup2(output.fileno(), number)


def nothing() -> None:
    """Let Pebble start its process."""
