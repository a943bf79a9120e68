"""Lines of numbers from text files, with the place of every one for messages."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from consistency.referee.errors import InputError
from consistency.referee.parsing import HUGE
from consistency.referee.readers.formats.text_blocks import FileRows, LineParser, line_of, parsed
from consistency.referee.readers.places import cut_note, exact, refuse
from consistency.referee.types import Array, Indices


@dataclass(frozen=True)
class Lines(FileRows):
    """The numbers of a text file."""

    path: Path
    values: Array  # (N, columns), the first of which is t
    line: Indices
    note: str = ""  # what they were read as
    unit: str = "line"
    rest: Array | None = None  # (N, 3) velocity in the world, m/s, or (N, 9) biases of gyroscope and accelerometer, too
    open_line: int = 0
    cut: str = ""  # note on a line that is left out, because it is cut short

    @property
    def t(self) -> Array:
        """First column, (N,), s."""
        return self.values[:, 0]

    def of(self, columns: slice) -> Lines:
        """Some of the columns, without holding the others in memory."""
        return replace(self, values=self.values[:, columns].copy())

    def rows(self, keep: Array | slice) -> Lines:
        """Some of the lines."""
        rest = self.rest
        if rest is not None:
            rest = rest[keep]
        return replace(self, values=self.values[keep], line=self.line[keep], rest=rest)

    def without_cut(self, bad: Array) -> Lines:
        """The lines without the last one if it alone is ``bad``, (N,) of bool, and has no end."""
        if not self.open_line or len(bad) < 2 or not bad[-1] or bad[:-1].any():
            return self
        return replace(self.rows(slice(-1)), open_line=0, cut=cut_note(self.path, self.open_line))


def bounded(values: Array) -> Array:
    """Numbers, with infinity for those too large for any measurement, as a filter that broke down writes."""
    return np.where(np.abs(values) > HUGE, np.copysign(np.inf, values), values)


def read_numbers(path: Path, widths: Sequence[int], layout: str) -> Lines:
    """A text file of numbers, every line of the same one of the ``widths``, the first column increasing."""
    return increasing(read_rows(path, widths, layout))


def read_rows(path: Path, widths: Sequence[int], layout: str, header: int = 0) -> Lines:
    """A text file of numbers, every line but ``header``, counted from 1, of the same one of the ``widths``."""
    found = parsed(_NumberLines(path, widths, layout, header))
    if not found.parts:
        raise InputError(f"{path}: is empty; each line should be {layout}")
    return Lines(path, np.concatenate(found.parts), found.line, open_line=found.open_line, cut=found.cut)


class _NumberLines(LineParser):
    """Lines of numbers while they are read."""

    def __init__(self, path: Path, widths: Sequence[int], layout: str, header: int) -> None:
        super().__init__(path)
        self.widths = widths
        self.layout = layout
        self.header = header
        self.width = 0  # of the lines before, 0 without any

    def row(self, number: int, line: str) -> list[str] | None:
        if number == self.header:
            return None
        fields = _fields(line)
        if len(fields) == self.width:
            return fields
        where = f"{self.path}, line {number}: has {len(fields)} columns"
        if len(fields) not in self.widths:
            hint = ""
            if ";" in line:
                hint = "; columns apart by semicolons need names, and numbers decimal points"
            raise InputError(f"{where}; should be {self.layout}{hint}")
        if self.width:
            raise InputError(f"{where}, the lines before {self.width}")
        self.width = len(fields)
        self.part([fields], [number])  # which refuses names of columns
        return fields

    def part(self, rows: list[list[str]], numbers: list[int]) -> Array:
        values = floats(rows)
        if values is not None:
            return bounded(values)
        bad = next(k for k, fields in enumerate(rows) if floats([fields]) is None)
        text = line_of(self.path, numbers[bad]).strip()[:60]
        raise InputError(f"{self.path}, line {numbers[bad]}: not a number in '{text}'; should be {self.layout}")

    def is_whole(self, line: str, above: Array) -> bool:
        fields = _fields(line)
        return len(fields) == self.width and floats([fields]) is not None


def _fields(line: str) -> list[str]:
    return line.replace(",", " ").split()


def floats(rows: list[list[str]]) -> Array | None:
    """Rows of as many fields each as numbers (N, fields); None where one holds something else."""
    try:
        values = np.fromiter(map(float, itertools.chain.from_iterable(rows)), float)
    except ValueError:
        return None
    return values.reshape(len(rows), -1)


def increasing(lines: Lines) -> Lines:
    """Lines whose first column is finite and increases; others are refused."""
    late = np.append(True, np.diff(lines.t) > 0)
    lines = lines.without_cut(~(late & np.isfinite(lines.t)))
    t = lines.t
    refuse(~np.isfinite(t), lines.place, "the timestamp is not finite")

    def what(row: int) -> str:
        of = "is less than the one before"
        if t[row] == t[row - 1]:
            of = "is duplicated"
        return f"timestamp {exact(t[row])} {of}; they must increase, so leave the row out"

    refuse(np.append(False, np.diff(t) <= 0), lines.place, what)
    return lines
