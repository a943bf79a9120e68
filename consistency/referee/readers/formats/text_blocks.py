"""Text files in blocks of whole lines, so that memory holds the numbers of a large file alone; lines of numbers."""

from __future__ import annotations

import gzip
import itertools
import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple, cast

import numpy as np

from consistency.referee.errors import InputError
from consistency.referee.parsing import HUGE, reading, require_room
from consistency.referee.readers.places import Places, cut_note, exact, refuse
from consistency.referee.types import Array, Indices

BLOCK = 2**22  # bytes: some thousand lines, whose fields take about 16 times as much
REFUSAL = "not a text file; known are .csv, .parquet, .npz, and .txt or .tum"
BOM = b"\xef\xbb\xbf"
PLAIN = b"0123456789+-.eE ,;\t\n"  # characters of numbers, and between them
LARGE = 2**20  # bytes from which loading pyarrow, which reads numbers 8 times as fast, pays
WIDE = re.compile(rb"\xff\xfe[^\0]\0|\xfe\xff\0[^\0]")  # the mark of UTF-16 and a character of ASCII


@dataclass(frozen=True)
class Block:
    """Whole lines of a text file."""

    path: Path
    data: bytes
    first: int  # number of the first one in the file, from 1
    ends: bool  # the last one has an end; otherwise it is the last line of the file alone

    @cached_property
    def rows(self) -> list[str]:
        """The lines, without their ends."""
        with reading(self.path, REFUSAL):
            return self.data.decode("utf-8").splitlines()

    @cached_property
    def plain(self) -> bytes:
        """The same bytes with ends of one character, if they spell finite decimal numbers; none otherwise."""
        data = self.data.replace(b"\r\n", b"\n")
        return b"" if data.translate(None, PLAIN) else data

    @property
    def count(self) -> int:
        """Number of lines."""
        return self.plain.count(b"\n") if self.plain else len(self.rows)

    def numbers(self, width: int, separator: str = "") -> Array | None:
        """The numbers of all lines at once, (lines, width), to the last bit as Python reads each.

        None where a line does not hold ``width`` of them, apart by one ``separator``, or by white space and commas.
        """
        data = self.plain if self.ends else b""
        if separator:
            others = b" \t,;".replace(separator.encode(), b"")
            if data.count(separator.encode()) != (width - 1) * self.count or data.translate(None, others) != data:
                return None
        data = data.replace((separator or ",").encode(), b" ")
        if len(data) > LARGE and (of_lines := _by_arrow(data, width)) is not None:
            return of_lines
        codes = np.frombuffer(data, np.uint8)
        ends = np.flatnonzero(codes == ord("\n"))
        inside = codes > ord(" ")
        begins = np.flatnonzero(inside & ~np.append(False, inside[:-1]))
        if not width or not len(ends) or len(begins) != width * len(ends) or b";" in data:
            return None
        of_lines = begins.reshape(-1, width)
        if (of_lines[:, -1] > ends).any() or (of_lines[1:, 0] < ends[:-1]).any():
            return None
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            try:
                values = np.fromstring(data, sep=" ")
            except (DeprecationWarning, ValueError):  # of what is not a number
                return None
        return values.reshape(-1, width) if values.size == begins.size else None

    def lines(self) -> Iterator[tuple[int, str]]:
        """Lines with their numbers, without comments and empty lines."""
        for number, line in enumerate(self.rows, self.first):
            text = line.lstrip()
            if text and text[0] != "#":
                yield number, line


def _by_arrow(data: bytes, width: int) -> Array | None:
    """The numbers of lines of ``width`` each, one space apart; None of other lines, and where pyarrow is missing."""
    try:
        from pyarrow import ArrowInvalid, BufferReader, csv, float64
    except ImportError:
        return None
    types = dict.fromkeys(map(str, range(width)), float64())
    read = csv.ReadOptions(use_threads=False, block_size=len(data), column_names=list(types))
    parse = csv.ParseOptions(delimiter=" ", quote_char=False, ignore_empty_lines=False)
    convert = csv.ConvertOptions(column_types=types, null_values=[])
    try:
        table = csv.read_csv(BufferReader(data), read, parse, convert)
    except ArrowInvalid:
        return None
    values: Array = np.array([np.from_dlpack(column.chunk(0)) for column in table.columns]).T  # to_numpy loads pandas
    return values


class LineParser:
    """How the lines of a text file become rows; each layout has its own."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def at_once(self, block: Block) -> Any:
        """What a block of plain numbers is kept as; None where its lines are to be taken one by one."""
        return None

    def row(self, number: int, line: str) -> Any:
        """What a line holds; None where it is a header."""
        raise NotImplementedError

    def part(self, rows: list[Any], numbers: list[int]) -> Any:
        """What the rows of a block are kept as; ``numbers`` are those of their lines."""
        return rows

    def is_whole(self, line: str, above: Any) -> bool:
        """Whether a last line without an end is like the part of the file above it; else it is left out."""
        raise NotImplementedError


class Parsed(NamedTuple):
    """What the lines of a file hold."""

    parts: list[Any]  # of each block with rows
    line: Indices  # (N,), number of the line of each row
    open_line: int = 0  # line of the last row if it has no end, and may be cut short; 0 otherwise
    cut: str = ""  # note on a line that is left out, because it is


def parsed(parser: LineParser) -> Parsed:
    """A text file, parsed block by block."""
    parts: list[Any] = []
    line_numbers: list[Indices] = []
    open_line = 0
    cut = ""
    for block in blocks(parser.path):
        part = parser.at_once(block)
        if part is not None:
            parts.append(part)
            line_numbers.append(np.arange(block.first, block.first + block.count))
            open_line = 0
            continue
        rows = []
        numbers = []
        for number, line in block.lines():
            if parts and not block.ends and not parser.is_whole(line, parts[-1]):
                cut = cut_note(parser.path, number)
            elif (row := parser.row(number, line)) is not None:
                rows.append(row)
                numbers.append(number)
        if rows:
            parts.append(parser.part(rows, numbers))
            line_numbers.append(np.array(numbers, int))
            open_line = 0 if block.ends else numbers[-1]
    return Parsed(parts, np.concatenate(line_numbers or [np.zeros(0, int)]), open_line, cut)


def blocks(path: Path) -> Iterator[Block]:
    """A text file, UTF-8, in blocks.

    Raises
    ------
    InputError
        The path is missing, or not a file (reading a pipe would block), or not text.
    """
    if not path.exists():
        raise InputError(f"{path}: no such file")
    with reading(path, REFUSAL):
        if not path.is_file():
            raise InputError(f"{path}: is {'a folder' if path.is_dir() else 'a device'}, not a file")
        file = opened(path)
    with file:
        data = _read(path, file).removeprefix(BOM)
        rest = [b""]
        first = 1
        if WIDE.match(data):
            raise InputError(f"{path}: is text in UTF-16, as PowerShell and Excel write it; save it as UTF-8")
        while data:
            require_room(path, file.tell())
            head, end, tail = data.rpartition(b"\n")
            if end:
                whole = b"".join([*rest, head, end])
                header = _header_end(whole) if first == 1 else 0
                for lines in filter(None, (whole[:header], whole[header:])):
                    block = Block(path, lines, first, ends=True)
                    yield block
                    first += block.count
                rest = []
            rest.append(tail)
            data = _read(path, file)
    if last := b"".join(rest):
        yield Block(path, last, first, ends=False)


def _header_end(lines: bytes) -> int:
    """Where the first line of numbers alone begins, so that those below a header are read at once."""
    begin = 0
    while begin < len(lines):
        end = lines.index(b"\n", begin)
        if not lines[begin:end].translate(None, PLAIN + b"\r"):
            break
        begin = end + 1
    return begin


def line_of(path: Path, wanted: int) -> str:
    """A line by its number."""
    lines = itertools.chain.from_iterable(block.lines() for block in blocks(path))
    return next(line for number, line in lines if number == wanted)


def opened(path: Path) -> BinaryIO:
    """A file for reading, unpacked where its name ends in .gz."""
    if path.suffix.lower() == ".gz":
        return cast(BinaryIO, gzip.open(path, "rb"))
    return path.open("rb")


def _read(path: Path, file: BinaryIO) -> bytes:
    with reading(path, REFUSAL):
        return file.read(BLOCK)


class FileRows:
    """Rows of a file, each with its place."""

    path: Path
    line: Indices  # (N,)
    unit: str  # of these numbers: line, row, message
    open_line: int  # line of the last row if it has no end, and may be cut short; 0 otherwise

    def place(self, row: int) -> str:
        return f"{self.path}, {self.unit} {self.line[row]}"

    @property
    def places(self) -> Places:
        """Places of all rows."""
        return Places(self.place, np.arange(len(self.line)))

    def open_end(self, row: int = -1) -> str:
        """What to note of a row if it is cut short; "" where its line has an end."""
        if not self.open_line or self.line[row] != self.open_line:
            return ""
        return cut_note(self.path, self.open_line)


# --- lines of numbers -----------------------------------------------------------------------------


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
    columns: Mapping[str, Array] = field(default_factory=dict)  # (N,) each, by name: what --by may name

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
        columns = {name: cells[keep] for name, cells in self.columns.items()}
        return replace(self, values=self.values[keep], line=self.line[keep], rest=rest, columns=columns)

    def without_cut(self, bad: Array) -> Lines:
        """The lines without the last one if it alone is ``bad``, (N,) of bool, and has no end."""
        if not self.open_line or len(bad) < 2 or not bad[-1] or bad[:-1].any():
            return self
        note = cut_note(self.path, self.open_line)
        return replace(self.rows(slice(-1)), open_line=0, cut=note)


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

    def at_once(self, block: Block) -> Array | None:
        width = self.width or len(_fields(block.plain.partition(b"\n")[0].decode()))
        if width not in self.widths or block.first <= self.header:
            return None
        values = block.numbers(width)
        if values is None:
            return None
        self.width = width
        return bounded(values)

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
