"""Standard streams of the process of a filter: what it prints, and whether it has left them alone."""

from __future__ import annotations

import contextlib
import os
from multiprocessing.connection import Connection

SHOWN = 2**14  # bytes of what a filter prints in a study that each supervisor passes on: some 200 lines
LAST = 2**11  # bytes of the end of the rest, shown where the process dies
AT_ONCE = 2**16  # bytes that a pipe holds


class Printed:
    """What the processes of a filter print in a study: passed on to standard error up to ``SHOWN`` bytes.

    Of the rest the end is shown once, when a process dies.
    """

    def __init__(self, name: str) -> None:
        self.name, self.left, self.last = name, SHOWN, b""
        self.is_cut = self.is_ended = False

    def add(self, text: bytes) -> None:
        """Pass on what there is room for; of the rest the end is kept."""
        head, rest = text[: self.left], text[self.left :]
        self.left -= len(head)
        self.last = (self.last + rest)[-LAST:]
        _tell(head)
        if rest and not self.is_cut:
            self.is_cut = True
            _tell(
                f"\nconsistency: filter '{self.name}' prints more than {SHOWN} bytes; the rest is not shown\n".encode()
            )

    def end(self, died: bool) -> None:
        """Show the last words of the first process that died."""
        if died and self.last and not self.is_ended:
            self.is_ended = True
            _tell(f"\nconsistency: the last that filter '{self.name}' printed:\n".encode() + self.last)
        self.last = b""


def _tell(text: bytes) -> None:
    with contextlib.suppress(OSError):
        while text:
            text = text[os.write(2, text) :]


def redirect(mouth: Connection) -> None:
    """Let standard output and standard error be ``mouth``, where the system can do that."""
    with contextlib.suppress(OSError, AttributeError):
        for number in (1, 2):
            os.dup2(mouth.fileno(), number)
        mouth.close()


def open_files(link: Connection) -> list[tuple[int, int] | None]:
    """What standard input, output and error and the pipe are, None of one that is closed."""
    found: list[tuple[int, int] | None] = []
    for number in (0, 1, 2, link.fileno()):
        try:
            about = os.fstat(number)
            found.append((about.st_dev, about.st_ino))
        except OSError:
            found.append(None)
    return found
