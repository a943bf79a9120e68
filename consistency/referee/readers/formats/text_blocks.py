"""Text files in blocks of whole lines: memory holds the numbers of a large file, and not its lines."""

from __future__ import annotations

import gzip
import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import BinaryIO, cast

import numpy as np

from consistency.referee.errors import InputError
from consistency.referee.parsing import reading, require_room
from consistency.referee.types import Array, Indices

BLOCK = 2**22  # bytes: some thousand lines, whose fields take about 16 times as much
REFUSAL = "not a text file; known are .csv, .parquet, .npz, and .txt or .tum"
BOM = b"\xef\xbb\xbf"
WIDE = re.compile(rb"\xff\xfe[^\0]\0|\xfe\xff\0[^\0]")  # the mark of UTF-16 and a character of ASCII
SPECIAL = b'"#\x0b\x0c\x1c\x1d\x1e'  # quotes, comments, and what str.splitlines takes for the end of a line
IS_SPACE = np.isin(np.arange(256), np.frombuffer(b" \t\r\n", np.uint8))
NEWLINE = ord("\n")


@dataclass(frozen=True)
class Block:
    """Whole lines of a text file."""

    path: Path
    data: bytes
    first: int  # number of its first line in the file, from 1
    ends: bool = True  # its last line has an end; otherwise it is the last line of the file alone

    @cached_property
    def plain(self) -> bool:
        """Whether it is ASCII without quotes and comments, its lines ending in LF or CR LF."""
        data = self.data
        ends = data.count(b"\r") == data.count(b"\r\n")
        return ends and data.isascii() and len(data.translate(None, SPECIAL)) == len(data)

    @cached_property
    def text(self) -> str:
        """The characters; raises :class:`InputError` where it is not UTF-8."""
        with reading(self.path, REFUSAL):
            return self.data.decode("utf-8")

    @cached_property
    def count(self) -> int:
        return len(self._starts) if self.plain else len(self.text.splitlines())

    def lines(self) -> list[tuple[int, str]]:
        """Lines with their numbers, without comments and empty lines."""
        numbered = enumerate(self.text.splitlines(), self.first)
        return [(number, line) for number, line in numbered if line.strip() and not line.lstrip().startswith("#")]

    def count_of(self, character: bytes) -> Indices:
        return self._per_line(np.frombuffer(self.data, np.uint8) == ord(character))

    def numbers(self, separator: bytes = b",") -> tuple[Array, Indices] | None:
        """Rows of numbers (N, columns), separators taken as spaces, and the numbers (N,) of their lines.

        None if the block holds anything else, or lines of unequal length: it must then be read line by line.
        """
        if not self.plain or b"_" in self.data:
            return None
        data = self.data.replace(separator, b" ")
        space = IS_SPACE[np.frombuffer(data, np.uint8)]
        begins = ~space
        begins[1:] &= space[:-1]
        fields = self._per_line(begins)
        full = np.flatnonzero(fields)
        if not len(full) or (fields[full] != fields[full[0]]).any():
            return None
        try:
            values = np.fromiter(map(float, data.split()), float)
        except ValueError:
            return None
        return values.reshape(len(full), -1), self.first + full

    @cached_property
    def _starts(self) -> Indices:
        after = np.flatnonzero(np.frombuffer(self.data, np.uint8) == NEWLINE) + 1
        return np.concatenate([[0], after[after < len(self.data)]])

    def _per_line(self, marks: Array) -> Indices:
        return np.asarray(np.add.reduceat(marks, self._starts, dtype=np.int64))


def blocks(path: Path) -> Iterator[Block]:
    """A text file, UTF-8, in blocks.

    Raises
    ------
    InputError
        The path is missing, or not a file (reading a pipe would block).
    """
    if not path.exists():
        raise InputError(f"{path}: no such file")
    with reading(path, REFUSAL):
        if not path.is_file():
            raise InputError(f"{path}: is {'a folder' if path.is_dir() else 'a device'}, not a file")
        file = opened(path)
    with file:
        first, pieces = 1, [_read(path, file).removeprefix(BOM)]
        if WIDE.match(pieces[0]):
            raise InputError(f"{path}: is text in UTF-16, as PowerShell and Excel write it; save it as UTF-8")
        while pieces[-1]:
            require_room(path, file.tell())
            head, end, tail = pieces[-1].rpartition(b"\n")
            if end:
                block = Block(path, b"".join([*pieces[:-1], head, end]), first)
                yield block
                first, pieces = first + block.count, [tail]
            pieces.append(_read(path, file))
    if last := b"".join(pieces):
        yield Block(path, last, first, ends=False)


def opened(path: Path) -> BinaryIO:
    """A file for reading, unpacked where its name ends in .gz."""
    return cast(BinaryIO, gzip.open(path, "rb")) if path.suffix.lower() == ".gz" else path.open("rb")


def _read(path: Path, file: BinaryIO) -> bytes:
    with reading(path, REFUSAL):
        return file.read(BLOCK)
