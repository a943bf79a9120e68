"""Places of rows in a file, for messages, and the refusal of rows."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from consistency.referee.errors import InputError
from consistency.referee.types import Indices


class Places:
    """Places of some rows of a file, put into words when asked for."""

    def __init__(self, of: Callable[[int], str], rows: Indices) -> None:
        self._of = of
        self._rows = rows

    def __getitem__(self, which: int) -> str:
        return self._of(int(self._rows[which]))

    def at(self, rows: Indices | slice) -> Places:
        return Places(self._of, self._rows[rows])


def refuse(bad: Any, place: Callable[[int], str], what: str | Callable[[int], str]) -> None:
    """Refuse rows, (N,) of bool, that are ``bad``, by what is wrong with the first of them."""
    if bad.any():
        row = int(np.argmax(bad))
        if not isinstance(what, str):
            what = what(row)
        raise InputError(f"{place(row)}: {what}")


def exact(value: float) -> str:
    """A number with all its digits, as a file has it."""
    return repr(float(value)).removesuffix(".0")


class CutNote(str):
    """A note that the last line of a text is left out, which a reader of finished files may refuse."""


def cut_note(path: Path, line: int) -> CutNote:
    """A note that the last line of a text is left out."""
    return CutNote(f"{path}: the last line, {line}, has no end and is left out; it seems to be cut short")


def one_of_each_kind(notes: Iterable[str]) -> tuple[str, ...]:
    """Notes of files, ``est/0.csv: read as poses``, of which three or more that say the same are one."""
    files: dict[str, list[str]] = {}
    for note in dict.fromkeys(filter(None, notes)):
        file, _, text = note.partition(": ")
        files.setdefault(text, []).append(file)
    out: list[str] = []
    for text, names in files.items():
        if len(names) > 2:
            names = [f"{names[0]} and {len(names) - 1} others"]
        if text:
            names = [f"{name}: {text}" for name in names]
        out += names
    return tuple(out)


def listed(items: Sequence[object], most: int = 5) -> str:
    """The first of some items, separated by commas."""
    words = [str(item) for item in items[:most]]
    if len(items) > most:
        words.append("…")
    return ", ".join(words)
