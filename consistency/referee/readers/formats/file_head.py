"""The first lines of a text file: names of columns, and the first row of numbers."""

from __future__ import annotations

import csv
import re
import zlib
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from consistency.referee.parsing import is_file
from consistency.referee.readers.formats.spellings import Columns, renamed
from consistency.referee.readers.formats.text_blocks import opened

PEEKED = 2**16  # bytes of a file that hold its header and its first row


class Head(NamedTuple):
    """Names of the columns of a text file, as they stand in it."""

    names: list[str]
    line: int  # of the names, from 1
    comment: bool  # it begins with #
    spaced: bool  # by white space
    places: Sequence[int]  # of these columns in the file


def head_of(path: Path, columns: Columns | None = None) -> Head | None:
    """The names of columns above the first row of numbers, those of ``columns`` in place of the file's own.

    None where the file has none.
    """
    lines, row = _beginning(path)
    if row is None or not lines:
        return None
    number, line = lines[-1]
    comment = _is_comment(line)
    if not comment and sum(not _is_comment(text) for _, text in lines) > 1:
        return None
    names = fields_of(line)
    width = len(fields_of(row))
    if comment:
        text = line.strip().lstrip("#")
        names = fields_of(text)
        if len(names) != width:
            names = re.split(r"\s{2,}", text.strip())
    if len(names) != width:
        return None
    is_spaced = not any(mark in line for mark in ",;\t")
    known, places = zip(*renamed(names, columns, path), strict=True)
    return Head(list(known), number, comment, is_spaced, places)


def begins_with_numbers(path: Path) -> bool:
    """Whether the first line that is not a comment is of numbers alone."""
    lines, row = _beginning(path)
    if row is None or not all(_is_comment(text) for _, text in lines):
        return False
    return all(map(_is_number, fields_of(row)))


def beginning(path: Path) -> bytes:
    """The first bytes of a file; none of what is not a file or cannot be read."""
    if not is_file(path):  # a pipe would be waited for
        return b""
    try:
        with opened(path) as file:
            return file.read(PEEKED)
    except (OSError, EOFError, zlib.error):
        return b""


def _beginning(path: Path) -> tuple[list[tuple[int, str]], str | None]:
    """Lines with their numbers that stand above the first row of numbers, and this row; None where there is none."""
    text = beginning(path).decode("utf-8-sig", "ignore")
    lines: list[tuple[int, str]] = []
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip():
            continue
        if _is_row(line):
            return lines, line
        lines.append((number, line))
    return lines, None


def _is_row(line: str) -> bool:
    """Whether at least half of the fields of a line are numbers or empty, and one is a number."""
    fields = fields_of(line)
    numbers = sum(map(_is_number, fields))
    return not _is_comment(line) and numbers > 0 and 2 * (numbers + fields.count("")) >= len(fields)


def _is_comment(line: str) -> bool:
    return line.lstrip().startswith("#")


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def fields_of(line: str) -> list[str]:
    """Fields of a line, apart by commas, semicolons or tabs, or by white space where it has none of them."""
    separator = max(",;\t", key=line.count)
    fields = line.split()
    if separator in line:
        fields = line.split(separator)
    if '"' in line and separator in line:
        with suppress(csv.Error):  # of a line with a null character
            return [field.strip() for field in next(csv.reader([line], delimiter=separator, skipinitialspace=True))]
    return [field.strip().strip('"') for field in fields]
