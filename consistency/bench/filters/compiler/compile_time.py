"""Seconds that compiling a kernel will take, by what kernels of known size took on this machine."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from statistics import median

from consistency.bench.filters.compiler import disk_cache

FILE = "seconds.txt"  # beside the compiled code: a line for each kernel, its size and seconds
RECENT = 15  # kernels whose median counts, so that neither a busy hour nor an old processor does for long
LONGEST = 1 << 16  # bytes of the file, after which it begins anew
FIRST = 4e-4  # s a byte where nothing was compiled yet: two idle cores take 3.5e-4
AGAIN = 0.5  # share of a function's time where the process has compiled it before, for types that may differ


def seconds_for(size: float) -> float:
    """Seconds for a kernel of this size, in bytes of bytecode."""
    return size * _per_byte()


@contextmanager
def measured(size: float) -> Iterator[None]:
    """Keep how long the compiling inside took; where the folder does not take it, nothing is kept."""
    started = time.monotonic()
    yield
    line = f"{size:.0f} {time.monotonic() - started:.3f}\n".encode()
    path = disk_cache.folder() / FILE
    with suppress(OSError):
        if disk_cache.is_ours(path.parent):
            is_long = path.exists() and path.stat().st_size > LONGEST
            flags = os.O_WRONLY | os.O_CREAT | (os.O_TRUNC if is_long else os.O_APPEND)
            file = os.open(path, flags, 0o600)
            try:
                os.write(file, line)  # at once, so that lines of several processes do not mix
            finally:
                os.close(file)


def _per_byte() -> float:
    try:
        lines = (disk_cache.folder() / FILE).read_text(encoding="ascii", errors="replace").splitlines()[-RECENT:]
    except OSError:
        lines = []
    rates = [rate for rate in map(_rate, lines) if rate is not None]
    return median(rates) if rates else FIRST


def _rate(line: str) -> float | None:
    """Seconds a byte; None for a line that nobody wrote so."""
    try:
        size, seconds = map(float, line.split())
    except ValueError:
        return None
    return seconds / size if 0.0 < size < 1e9 and 0.0 < seconds < 1e5 else None
