"""Progress of long work: a bar with rate and time left on a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from typing import Any, TypeVar

T = TypeVar("T")
Advance = Callable[[int], None]


class _Forgiving:
    """Standard error, where what cannot be written is dropped: the terminal or a pipe's reader may be gone."""

    def __init__(self) -> None:
        self._stream: Any = sys.stderr

    def write(self, text: str) -> int:
        with suppress(OSError, ValueError, AttributeError):
            self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        with suppress(OSError, ValueError, AttributeError):
            self._stream.flush()

    def __getattr__(self, name: str) -> Any:
        if name == "rich_proxied_file":  # by which a console would write past this one
            raise AttributeError(name)
        return getattr(self._stream, name)


EVERY = 3.0  # seconds between lines
_quiet = ContextVar("quiet", default=False)


@contextmanager
def quiet() -> Iterator[None]:
    """Inside, only what is announced is said: many short works report for themselves."""
    token = _quiet.set(True)
    try:
        yield
    finally:
        _quiet.reset(token)


def say(text: str) -> None:
    """One line on standard error, unless it is to be quiet, or nobody can read it."""
    if not _quiet.get():
        print(text, file=_Forgiving(), flush=True)


def announce(text: str) -> None:
    """One line on standard error before what takes long, said even where it is to be quiet."""
    print(text, file=_Forgiving(), flush=True)


def each(items: Iterable[T], total: int, label: str, unit: str) -> Iterator[T]:
    """The items, ``total`` in number, with progress over them in place of that of the work on each."""
    with progress(label, total, unit) as advance:
        for item in items:
            with quiet():
                yield item
            advance(1)


def with_progress(items: Sequence[T], label: str, unit: str) -> Iterator[T]:
    """The items, with progress over them if there are several and they take more than some seconds."""
    if len(items) < 2:
        yield from items
        return
    with progress(label, len(items), unit, brief=True) as advance:
        for item in items:
            yield item
            advance(1)


@contextmanager
def progress(label: str, total: int, unit: str = "runs", brief: bool = False) -> Iterator[Advance]:
    """Yields a function to call with the number of units just done; writes to standard error.

    ``brief``: nothing remains on a terminal, and where there is none nothing is said of what is over in a few seconds.
    """
    if _quiet.get():
        yield lambda _: None
    elif sys.stderr is not None and sys.stderr.isatty():
        with _bar(label, total, unit, brief) as advance:
            yield advance
    else:
        yield _lines(label, total, unit, brief)


@contextmanager
def _bar(label: str, total: int, unit: str, brief: bool) -> Iterator[Advance]:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]}"),
        TimeRemainingColumn(),
        TextColumn("left"),
    )
    stream: Any = _Forgiving()
    with Progress(*columns, console=Console(file=stream), transient=brief) as bar:
        task = bar.add_task(label, total=total, rate="")

        def advance(count: int) -> None:
            bar.advance(task, count)
            speed = bar.tasks[0].finished_speed or bar.tasks[0].speed
            if speed:
                bar.update(task, rate=_speed(speed, unit))

        yield advance


def _speed(rate: float, unit: str) -> str:
    if rate >= 1.0:
        return f"{rate:.1f} {unit}/s"
    return f"{1.0 / rate:.1f} s for one"


def _lines(label: str, total: int, unit: str, brief: bool) -> Advance:
    started = last = time.monotonic()
    done = 0

    def advance(count: int) -> None:
        nonlocal done, last
        done += count
        now = time.monotonic()
        if (done == total and not (brief and now - started < EVERY)) or now - last >= EVERY:
            last = now
            rate = done / max(now - started, 1e-9)
            if done == total:
                speed = f", {_speed(rate, unit)}"
            elif done == count:  # the first: it may have waited for kernels to be compiled
                speed = f", {now - started:.0f} s with the start"
            else:
                speed = f", {_speed(rate, unit)}, {(total - done) / rate:.0f} s left"
            print(f"{label}: {done} of {total} {unit}{speed}", file=_Forgiving(), flush=True)

    return advance
