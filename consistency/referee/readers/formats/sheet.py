"""Text files and Parquet tables, with the place of every row for messages."""

from __future__ import annotations

import csv
import itertools
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from consistency.referee.errors import InputError
from consistency.referee.extras import require
from consistency.referee.parsing import HUGE, MOST_DOF, WHOLE, is_file, one_line, reading, require_name
from consistency.referee.readers.formats.column_renaming import Columns, renamed
from consistency.referee.readers.formats.text_blocks import Block, blocks
from consistency.referee.readers.places import cut_note, exact, listed, refuse
from consistency.referee.types import Array, Indices

Column = Array  # (N,), floats with NaN where a cell is empty; or objects, text for one, with None there
EMPTY = frozenset(
    [
        "#N/A",
        "#N/A N/A",
        "#NA",
        "-1.#IND",
        "-1.#QNAN",
        "-NaN",
        "-nan",
        "1.#IND",
        "1.#QNAN",
        "<NA>",
        "N/A",
        "NA",
        "NULL",
        "NaN",
        "None",
        "n/a",
        "nan",
        "null",
        "",
    ]
)  # what pandas and R write for no value
TRUTHS = {text: value for value in (True, False) for text in (str(value), str(value).lower(), str(value).upper())}


@dataclass(frozen=True)
class TableRows:
    """A table of N rows, with the place of each row in the file."""

    path: Path
    data: dict[str, Column]
    line: Indices  # (N,), line of a text file, row of a Parquet file
    unit: str  # line | row
    open_line: int = 0  # line of a row without an end, which may be cut short; 0 without one
    cut: str = ""  # note on a line that is left out, because it is

    def __contains__(self, column: str) -> bool:
        return column in self.data

    def __len__(self) -> int:
        return len(self.line)

    @property
    def columns(self) -> str:
        return listed(list(self.data), 12)

    def place(self, row: int) -> str:
        return f"{self.path}, {self.unit} {self.line[row]}"

    def numbers(self, column: str, finite: bool = False, whole: bool = False) -> Array:
        """A column as floats, NaN where empty; refused where it is text, or not finite or whole as asked for."""
        cells = self.data[column]
        if cells.dtype.kind != "f":
            cells = np.array([_number(cell) for cell in cells], float)
        values = bounded(cells)
        bad, cells = np.isnan(values) & ~self.empty(column), self.data[column]
        what = "not a number"
        if not all(isinstance(cell, str) for cell in cells[bad]):
            what = "a truth value or a date, which is to be written as a number"
            if any(hasattr(cell, "__len__") for cell in cells[bad]):
                what = "a list, of which each number needs a column of its own"
        if not bad.any() and (finite or whole):
            bad, what = ~np.isfinite(values), "not a finite number"
        if not bad.any() and whole:
            bad, what = values != np.round(values), "not a whole number"
        if not bad.any() and whole:
            bad, what = np.abs(values) > WHOLE, "a number too large to be counted exactly"
        if bad.any():
            row = int(np.flatnonzero(bad)[0])
            if re.fullmatch(r"[-+]?\d+,\d+", str(cells[row])):
                what += " with a decimal point"
            raise InputError(f"{self.place(row)}: column '{column}': {what} ({one_line(cells[row], 60)})")
        return values

    def rows(self, keep: Array) -> TableRows:
        return replace(self, data={name: cells[keep] for name, cells in self.data.items()}, line=self.line[keep])

    def renamed(self, columns: Columns | None) -> TableRows:
        """The table with names of ``columns`` in place of its own."""
        names = renamed(list(self.data), columns, self.path)
        return replace(self, data=dict(zip(names, self.data.values(), strict=True)))

    def open_end(self, row: int) -> str:
        """What to note of a row if it is cut short; "" where its line has an end."""
        return cut_note(self.path, self.open_line) if self.line[row] == self.open_line else ""

    def texts(self, column: str) -> Array:
        return np.array([str(cell) for cell in self.data[column]], object)

    def empty(self, column: str) -> Array:
        cells = self.data[column]
        return np.isnan(cells) if cells.dtype.kind == "f" else np.array([cell is None for cell in cells], bool)


@dataclass(frozen=True)
class Lines:
    """The numbers of a text file."""

    path: Path
    values: Array  # (N, columns), the first of which is t
    line: Indices  # (N,)
    note: str = ""  # what they were read as
    unit: str = "line"  # line | message
    rest: Array | None = None  # (N, 3) velocity in the world, m/s, or (N, 9) biases of gyroscope and accelerometer, too
    open_line: int = 0  # line of the last row if it has no end, and may be cut short; 0 otherwise
    cut: str = ""  # note on a line that is left out, because it is

    @property
    def t(self) -> Array:
        """First column, (N,), s."""
        return self.values[:, 0]

    def place(self, row: int) -> str:
        return f"{self.path}, {self.unit} {self.line[row]}"

    def of(self, columns: slice) -> Lines:
        """Some of the columns, without holding the others in memory."""
        return replace(self, values=self.values[:, columns].copy())

    def without_cut(self, bad: Array) -> Lines:
        """The lines without the last one if it alone is ``bad``, (N,) of bool, and has no end."""
        if not self.open_line or len(bad) < 2 or not bad[-1] or bad[:-1].any():
            return self
        rest = self.rest
        if rest is not None:
            rest = rest[:-1]
        cut = cut_note(self.path, self.open_line)
        return replace(self, values=self.values[:-1], line=self.line[:-1], rest=rest, open_line=0, cut=cut)

    @property
    def open_end(self) -> str:
        """What to note of the last row if it is cut short; "" where its line has an end."""
        return cut_note(self.path, self.open_line) if self.open_line else ""


def bounded(values: Array) -> Array:
    """Numbers, with infinity for those too large for any measurement, as a filter that broke down writes."""
    return np.where(np.abs(values) > HUGE, np.copysign(np.inf, values), values)


def are_dof(values: Array) -> Array:
    """Whether numbers are degrees of freedom: whole, from 0 to below 2^31."""
    return np.asarray((values >= 0) & (values < MOST_DOF) & (values == np.round(values)))


def read_sheet(path: Path, columns: Columns | None = None) -> TableRows:
    """A CSV file (comma, semicolon or tab; # comments) or a Parquet file, with names of ``columns`` for its own."""
    if path.suffix.lower() in (".parquet", ".pq"):
        if not is_file(path):
            raise InputError(f"{path}: no such file")
        require(f"{path}: Parquet", "parquet")
        from consistency.referee.readers.formats.parquet_file import read_columns

        data, rows = read_columns(path, "cannot be read as Parquet")
        sheet = TableRows(path, data, np.arange(rows), "row")
    elif path.suffix.lower() in (".jsonl", ".ndjson"):
        from consistency.referee.readers.formats.json_lines import read_json_lines

        data, line, open_line, cut = read_json_lines(path)
        sheet = TableRows(path, data, line, "line", open_line, cut)
    else:
        sheet = _read_csv(path)
    if not len(sheet):
        raise InputError(f"{path}: holds no row")
    sheet = sheet.renamed(columns)
    if "filter" in sheet:
        refuse(sheet.empty("filter"), sheet.place, "column 'filter' is empty")
        for name in dict.fromkeys(sheet.texts("filter")):
            require_name(name, f"{path}: column 'filter'")
    return sheet


def frame_rows(frame: Any, name: str) -> TableRows:
    """Rows of a table in memory with columns by name, as a DataFrame of pandas or polars, called ``name`` in messages.

    Raises
    ------
    InputError
        It holds no row, or a column is duplicated.
    """
    names = [str(column) for column in frame.columns]
    if twice := {column for column in names if names.count(column) > 1}:
        raise InputError(f"{name}: column '{sorted(twice)[0]}' is duplicated")
    data = {str(column): _cells(np.asarray(frame[column])) for column in frame.columns}
    rows = len(next(iter(data.values()), ()))
    if not rows:
        raise InputError(f"{name}: holds no row")
    return TableRows(Path(name), data, np.arange(1, rows + 1), "row")


def _cells(values: Array) -> Column:
    """A column in memory: floats, or objects with None where a cell is empty."""
    if values.dtype.kind in "fiu":
        return np.asarray(values, float)
    return np.array([None if str(cell) in EMPTY else cell for cell in values.tolist()], object)


def _read_csv(path: Path) -> TableRows:
    names: list[str] = []
    tables: list[dict[str, Column]] = []
    line: list[Indices] = []
    separator, open_line, cut = ",", 0, ""
    for block in blocks(path):
        if not names:
            lines = block.lines()
            if not lines:
                continue
            names, separator = _header(path, lines[0][1])
            found = _rows(path, lines[1:], names, separator)
        elif tables and not block.ends and not _is_like(block.lines(), tables[-1], separator):
            cut = cut_note(path, block.first)
            break
        else:
            found = _plain_rows(block, names, separator) or _rows(path, block.lines(), names, separator)
        if found is not None:
            tables.append(found[0])
            line.append(found[1])
            open_line = 0 if block.ends else block.first
    if not names:
        raise InputError(f"{path}: is empty")
    if not tables:
        raise InputError(f"{path}: holds no row under its header")
    data = {name: _joined([table[name] for table in tables]) for name in names}
    return TableRows(path, data, np.concatenate(line), "line", open_line, cut)


def _is_like(lines: list[tuple[int, str]], above: dict[str, Column], separator: str) -> bool:
    """Whether a line is as long as the rows above it, with numbers where they have numbers."""
    for _, line in lines:
        cells = [cell.strip() for cell in line.split(separator)]
        if '"' not in line and len(cells) != len(above):
            return False
        if line.count('"') % 2:
            return False
        for cell, column in zip(cells, above.values(), strict=False):
            if '"' not in line and column.dtype.kind == "f" and cell not in EMPTY and math.isnan(_number(cell)):
                return False
    return True


def _header(path: Path, line: str) -> tuple[list[str], str]:
    separator = max(",;\t", key=line.count)
    names = [name.strip().strip('"') for name in line.split(separator)]
    twice = {name for name in names if names.count(name) > 1}
    if twice:
        raise InputError(f"{path}: column '{sorted(twice)[0]}' is duplicated")
    return names, separator


def _rows(
    path: Path, lines: list[tuple[int, str]], names: list[str], separator: str
) -> tuple[dict[str, Column], Indices] | None:
    """Rows of a table from its lines, out of quotes where they are in some, and their numbers; None without any."""
    rows = []
    for number, line in lines:
        fields = line.split(separator)
        if '"' in line:
            if line.count('"') % 2:
                raise InputError(
                    f"{path}: cannot be read as CSV (line {number}: a quoted field goes over several lines)"
                )
            with reading(path, f"line {number} cannot be read as CSV"):
                (fields,) = csv.reader([line], delimiter=separator, skipinitialspace=True)
        if len(fields) != len(names):
            raise InputError(f"{path}, line {number}: has {len(fields)} columns, the header has {len(names)}")
        rows.append(fields)
    return (_columns(rows, names), np.array([number for number, _ in lines])) if rows else None


def _plain_rows(block: Block, names: list[str], separator: str) -> tuple[dict[str, Column], Indices] | None:
    """Rows of a block in which every line is a row; None where the block must be parsed line by line."""
    if len(names) == 1 or not block.plain or b"\n\t" in block.data or block.data[:1] == b"\t":
        return None
    if (block.count_of(separator.encode()) != len(names) - 1).any():
        return None
    numbers = block.first + np.arange(block.count)
    found = None if "filter" in names else block.numbers(separator.encode())
    if found is not None and found[0].shape == (block.count, len(names)):
        return dict(zip(names, found[0].T, strict=True)), numbers
    return _columns([line.split(separator) for line in block.text.splitlines()], names), numbers


def _columns(rows: list[list[str]], names: list[str]) -> dict[str, Column]:
    """Columns of floats where all cells are numbers or empty; of text or truth values else."""
    columns = (map(str.lstrip, cells) for cells in zip(*rows, strict=True))
    return {name: _column(list(cells), name == "filter") for name, cells in zip(names, columns, strict=True)}


def _column(cells: list[str], is_text: bool) -> Column:
    filled: list[Any] = [None if cell in EMPTY else cell for cell in cells]
    if not is_text:
        values = np.array([_number(cell) for cell in filled], float)
        if all(cell is None for cell in itertools.compress(filled, np.isnan(values))):
            return values
        if all(cell is None or cell in TRUTHS for cell in filled):
            filled = [TRUTHS.get(cell) for cell in cells]
    return np.array(filled, object)


def _number(cell: object) -> float:
    """A cell as a number; NaN where it is empty or none."""
    if isinstance(cell, str):
        if "_" in cell or not cell.isascii():  # numbers to Python alone
            return math.nan
        try:
            return float(cell)
        except ValueError:
            return math.nan
    return float(cell) if isinstance(cell, int | float | np.number) and not isinstance(cell, bool) else math.nan


def _joined(parts: list[Column]) -> Column:
    """Parts of a column below each other, as objects where one of them is."""
    if any(part.dtype.kind == "O" for part in parts):
        parts = [part if part.dtype.kind == "O" else np.where(np.isnan(part), np.array(None), part) for part in parts]
    return np.concatenate(parts)


def read_numbers(path: Path, widths: Sequence[int], layout: str) -> Lines:
    """A text file of numbers, every line of the same one of the ``widths``, the first column increasing."""
    return increasing(read_rows(path, widths, layout))


def read_rows(path: Path, widths: Sequence[int], layout: str, header: int = 0) -> Lines:
    """A text file of numbers, every line but ``header``, counted from 1, of the same one of the ``widths``."""
    values: list[Array] = []
    line: list[Indices] = []
    width, open_line, cut = 0, 0, ""
    for block in blocks(path):
        if width and not block.ends and not _are_numbers(block.lines(), width):
            cut = cut_note(path, block.first)
            break
        found = block.numbers()
        if found is None or found[0].shape[1] not in widths or width not in (0, found[0].shape[1]):
            rows = [(number, text) for number, text in block.lines() if number != header]
            found = _number_rows(path, rows, widths, width, layout)
        if len(found[1]):
            width = found[0].shape[1]
            values.append(bounded(found[0]))
            line.append(found[1])
            open_line = 0 if block.ends else block.first
    if not values:
        raise InputError(f"{path}: is empty; each line should be {layout}")
    return Lines(path, np.concatenate(values), np.concatenate(line), open_line=open_line, cut=cut)


def _are_numbers(lines: list[tuple[int, str]], width: int) -> bool:
    """Whether all lines are ``width`` numbers."""
    rows = [line.replace(",", " ").split() for _, line in lines]
    try:
        return all(len([float(field) for field in row]) == width for row in rows)
    except ValueError:
        return False


def increasing(lines: Lines) -> Lines:
    """Lines whose first column is finite and increases; others are refused."""
    late = np.append(True, np.diff(lines.t) > 0)
    lines = lines.without_cut(~(late & np.isfinite(lines.t)))
    t = lines.t
    refuse(~np.isfinite(t), lines.place, "the timestamp is not finite")

    def what(row: int) -> str:
        of = "is duplicated" if t[row] == t[row - 1] else "is less than the one before"
        return f"timestamp {exact(t[row])} {of}; they must increase, so leave the row out"

    refuse(np.append(False, np.diff(t) <= 0), lines.place, what)
    return lines


def _number_rows(
    path: Path, lines: list[tuple[int, str]], widths: Sequence[int], width: int, layout: str
) -> tuple[Array, Indices]:
    """Numbers of some lines, after lines of ``width`` columns if it is not 0; refused with the number of the line."""
    rows: list[list[float]] = []
    for number, line in lines:
        fields = line.replace(",", " ").split()
        if len(fields) not in widths:
            hint = ""
            if ";" in line:
                hint = "; columns apart by semicolons need names, and numbers decimal points"
            raise InputError(f"{path}, line {number}: has {len(fields)} columns; should be {layout}{hint}")
        width = width or len(fields)
        if len(fields) != width:
            raise InputError(f"{path}, line {number}: has {len(fields)} columns, the lines before {width}")
        try:
            rows.append([float(field) for field in fields])
        except ValueError:
            raise InputError(
                f"{path}, line {number}: not a number in '{line.strip()[:60]}'; should be {layout}"
            ) from None
    return np.array(rows).reshape(len(rows), -1 if rows else 0), np.array([number for number, _ in lines], int)
