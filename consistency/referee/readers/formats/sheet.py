"""Tables from text files and Parquet, with the place of every row for messages."""

from __future__ import annotations

import csv
import itertools
import json
import math
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from consistency.referee.errors import InputError
from consistency.referee.extras import require
from consistency.referee.parsing import MOST_DOF, WHOLE, is_file, keys_once, one_line, reading, require_name
from consistency.referee.readers.formats.columns import Columns, clock_of, renamed
from consistency.referee.readers.formats.file_kinds import Head, separator_of
from consistency.referee.readers.formats.text_blocks import (
    Block,
    FileRows,
    LineParser,
    bounded,
    floats,
    parsed,
    read_rows,
)
from consistency.referee.readers.places import listed, refuse
from consistency.referee.types import Array, Indices

Column = Array  # (N,), floats with NaN where a cell is empty; or objects, text for one, with None there
EMPTY = frozenset((  # what pandas and R write for no value
    "", "#N/A", "#N/A N/A", "#NA", "-1.#IND", "-1.#QNAN", "-NaN", "-nan", "1.#IND", "1.#QNAN", "<NA>", "N/A", "NA",
    "NULL", "NaN", "None", "n/a", "nan", "null",
))  # fmt: skip
NIS_DOF = "it is the number of measurements in each nis"  # of a column that is missing
DOF_NEEDED = "a whole number from 0 to below 2^31"
DATE = re.compile(r"(\d{4}-\d\d-\d\d)[T ](\d\d:\d\d)(?::(\d\d(?:[.,]\d+)?))?\s?(Z|UTC|[+-]\d\d:?\d\d)?")
TRUTHS = {"True": True, "true": True, "TRUE": True, "False": False, "false": False, "FALSE": False}


@dataclass(frozen=True)
class TableRows(FileRows):
    """A table of N rows."""

    path: Path
    data: dict[str, Column]
    line: Indices
    unit: str
    open_line: int = 0
    cut: str = ""  # note on a line that is left out, because it is cut short

    def __contains__(self, column: str) -> bool:
        return column in self.data

    def __len__(self) -> int:
        return len(self.line)

    @property
    def columns(self) -> str:
        return listed(list(self.data), 12)

    def numbers(self, column: str, finite: bool = False, whole: bool = False) -> Array:
        """A column as floats, NaN where empty; refused where it is text, or not finite or whole as asked for."""
        cells = self.data[column]
        values = cells
        if cells.dtype.kind != "f":
            values = np.array(list(map(_number, cells)), float)
        values = bounded(values)
        unread = np.isnan(values) & ~self.empty(column)
        if unread.any() and clock_of([column]) is not None:
            values[unread] = list(map(seconds_of_date, cells[unread]))
            unread = np.isnan(values) & ~self.empty(column)
        self._refuse(unread, column, _no_number(cells[unread]))
        if finite or whole:
            self._refuse(~np.isfinite(values), column, "not a finite number")
        if whole:
            self._refuse(values != np.round(values), column, "not a whole number")
            self._refuse(np.abs(values) > WHOLE, column, "a number too large to be counted exactly")
        return values

    def matrix(self, columns: Iterable[str], finite: bool = False) -> Array:
        """Some columns as floats, (N, columns)."""
        return np.column_stack([self.numbers(column, finite) for column in columns])

    def among(self, names: Iterable[str]) -> list[str]:
        """Those of some names that are columns."""
        return list(filter(self.data.__contains__, names))

    def has(self, *columns: str) -> bool:
        """Whether all of these columns are there."""
        return set(columns) <= set(self.data)

    def _refuse(self, bad: Array, column: str, what: str) -> None:
        def full(row: int) -> str:
            cell = self.data[column][row]
            hint = ""
            if re.fullmatch(r"[-+]?\d+,\d+", str(cell)):
                hint = " with a decimal point"
            return f"column '{column}': {what}{hint} ({one_line(cell, 60)})"

        refuse(bad, self.place, full)

    def rows(self, keep: Array) -> TableRows:
        """Some of the rows."""
        data = {name: cells[keep] for name, cells in self.data.items()}
        return replace(self, data=data, line=self.line[keep])

    def renamed(self, columns: Columns | None) -> TableRows:
        """The table with names of ``columns`` in place of its own."""
        cells = list(self.data.values())
        names = renamed(list(self.data), columns, self.path)
        return replace(self, data={name: cells[place] for name, place in names})

    def texts(self, column: str) -> Array:
        return np.array(list(map(str, self.data[column])), object)

    def empty(self, column: str) -> Array:
        cells = self.data[column]
        if cells.dtype.kind == "f":
            return np.isnan(cells)
        return np.array([cell is None for cell in cells], bool)


def are_dof(values: Array) -> Array:
    """Whether numbers are degrees of freedom: whole, from 0 to below 2^31."""
    return np.asarray((values >= 0) & (values < MOST_DOF) & (values == np.round(values)))


def checked_dof(nis: Array, dof: Array, place: Callable[[int], str]) -> Array:
    """Degrees of freedom (N,), 0 where neither they nor a NIS is given.

    Raises
    ------
    InputError
        A NIS is negative or infinite, or its degrees of freedom are not a whole number of 0 or more.
    """
    dof = np.where(np.isnan(nis) & np.isnan(dof), 0.0, dof)
    bad = (nis < 0) | np.isinf(nis) | ~are_dof(dof)
    needed = f"nis must be 0 or more and finite, nis_dof {DOF_NEEDED}"
    refuse(bad, place, lambda row: f"nis {nis[row]:g} with nis_dof {dof[row]:g}; {needed}")
    return dof


# --- tables ------------------------------------------------------------------------------------------


def read_sheet(path: Path, columns: Columns | None = None) -> TableRows:
    """A CSV file (comma, semicolon or tab; # comments), JSON lines or Parquet, with ``columns`` for its own names."""
    suffix = path.suffix.lower()
    if suffix in (".parquet", ".pq"):
        if not is_file(path):
            raise InputError(f"{path}: no such file")
        require(f"{path}: Parquet", "parquet")
        from consistency.referee.readers.formats.parquet_file import read_columns

        data, rows = read_columns(path, "cannot be read as Parquet")
        sheet = TableRows(path, data, np.arange(rows), "row")
    elif suffix in (".jsonl", ".ndjson"):
        sheet = _read_json_lines(path)
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


def sheet_of(head: Head) -> TableRows:
    """A text file under the names of its ``head``, which may stand in a comment or be apart by white space."""
    if not (head.comment or head.spaced):
        return read_sheet(head.path, head.renaming)
    header = 0 if head.comment else head.line
    width = max(head.places) + 1
    lines = read_rows(head.path, [width], f"{width} columns as named", header)
    data: dict[str, Column] = {}
    for name, place in zip(head.names, head.places, strict=True):
        data.setdefault(name, lines.values[:, place])
    return TableRows(head.path, data, lines.line, "line", lines.open_line, lines.cut)


def frame_rows(frame: Any, name: str) -> TableRows:
    """Rows of a table in memory with columns by name, as a DataFrame of pandas or polars, called ``name`` in messages.

    Raises
    ------
    InputError
        It holds no row, or a column is duplicated.
    """
    require_distinct(list(map(str, frame.columns)), name)
    data = {}
    for column in frame.columns:
        values = np.asarray(frame[column])
        is_number = values.dtype.kind in "fiu"
        data[str(column)] = np.asarray(values, float) if is_number else _cells(values.tolist())
    rows = len(next(iter(data.values()), ()))
    if not rows:
        raise InputError(f"{name}: holds no row")
    return TableRows(Path(name), data, np.arange(1, rows + 1), "row")


def require_distinct(names: Sequence[str], where: Path | str) -> None:
    """Refuse names of columns of which two are the same."""
    twice = sorted(name for name, count in Counter(names).items() if count > 1)
    if twice:
        raise InputError(f"{where}: column '{twice[0]}' is duplicated")


def _cells(values: Sequence[Any]) -> Column:
    """Cells as floats where all are numbers or empty, or as objects with None where one is empty."""
    if set(map(type, values)) <= {int, float, type(None)}:
        return np.array([np.nan if cell is None else min(max(cell, -1e308), 1e308) for cell in values], float)
    filled = [None if str(cell) in EMPTY else cell for cell in values]
    return np.array([*filled, None], object)[:-1]


def _read_csv(path: Path) -> TableRows:
    table = CsvTable(path)
    found = parsed(table)
    if not table.names:
        raise InputError(f"{path}: is empty")
    if not found.parts:
        raise InputError(f"{path}: holds no row under its header")
    data = {}
    for name in table.names:
        data[name] = _joined([part[name] for part in found.parts])
    return TableRows(path, data, found.line, "line", found.open_line, found.cut)


class CsvTable(LineParser):
    """A CSV file while it is read; its first line is the header."""

    names: Sequence[str] = ()
    separator = ","
    plain = True  # no field of the block is a number in Python alone

    def at_once(self, block: Block) -> dict[str, Column] | None:
        if "filter" in self.names:
            return None
        values = block.numbers(len(self.names), self.separator)
        return None if values is None else dict(zip(self.names, values.T, strict=True))

    def row(self, number: int, line: str) -> list[str] | None:
        """Fields of a line, out of quotes where some are in them."""
        if not self.names:
            self.separator = separator_of(line)
            self.names = [name.strip().strip('"') for name in line.split(self.separator)]
            require_distinct(self.names, self.path)
            return None
        fields = line.split(self.separator)
        if '"' in line:
            if line.count('"') % 2:
                what = f"line {number}: a quoted field goes over several lines"
                raise InputError(f"{self.path}: cannot be read as CSV ({what})")
            with reading(self.path, f"line {number} cannot be read as CSV"):
                (fields,) = csv.reader([line], delimiter=self.separator, skipinitialspace=True)
        if len(fields) != len(self.names):
            what = f"has {len(fields)} columns, the header has {len(self.names)}"
            raise InputError(f"{self.path}, line {number}: {what}")
        self.plain &= "_" not in line and line.isascii()
        return fields

    def part(self, rows: list[list[str]], numbers: list[int]) -> dict[str, Column]:
        """Columns of floats where all cells are numbers or empty; of text or truth values elsewhere."""
        values = floats(rows) if self.plain and "filter" not in self.names else None
        self.plain = True
        if values is not None:
            return dict(zip(self.names, values.T, strict=True))
        columns = {}
        for name, cells in zip(self.names, zip(*rows, strict=True), strict=True):
            columns[name] = _column(list(map(str.lstrip, cells)), name == "filter")
        return columns

    def is_whole(self, line: str, above: dict[str, Column]) -> bool:
        """Whether a line is as long as the rows above it, with numbers where they have numbers."""
        if '"' in line:
            return line.count('"') % 2 == 0
        cells = list(map(str.strip, line.split(self.separator)))
        if len(cells) != len(above):
            return False
        for cell, column in zip(cells, above.values(), strict=True):
            if column.dtype.kind == "f" and cell not in EMPTY and math.isnan(_number(cell)):
                return False
        return True


def _column(cells: list[str], is_text: bool) -> Column:
    filled: list[Any] = [None if cell in EMPTY else cell for cell in cells]
    if not is_text:
        values = np.array(list(map(_number, filled)), float)
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
    if isinstance(cell, int | float | np.number) and not isinstance(cell, bool):
        return float(cell)
    return math.nan


def seconds_of_date(cell: object) -> float:
    """Seconds since 1970 of a date with a time of ISO 8601, which is in UTC unless it says otherwise; NaN of others."""
    found = DATE.fullmatch(str(cell).strip())
    if found is None:
        return math.nan
    day, minute, second, zone = found.groups()
    with suppress(ValueError):
        at = np.datetime64(f"{day}T{minute}", "s").astype(np.int64) + float((second or "0").replace(",", "."))
        if zone and zone[0] in "+-":
            at -= int(f"{zone[0]}1") * (3600 * int(zone[1:3]) + 60 * int(zone[-2:]))
        return float(at)
    return math.nan


def _no_number(cells: Array) -> str:
    """What cells hold in place of numbers."""
    if all(isinstance(cell, str) for cell in cells):
        return "not a number"
    if any(hasattr(cell, "__len__") for cell in cells):
        return "a list, of which each number needs a column of its own"
    return "a truth value or a date, which is to be written as a number"


def _joined(parts: list[Column]) -> Column:
    """Parts of a column below each other, as objects where one of them is."""
    if all(part.dtype.kind == "f" for part in parts):
        return np.concatenate(parts)
    as_objects = []
    for part in parts:
        if part.dtype.kind != "O":
            part = np.where(np.isnan(part), np.array(None), part)
        as_objects.append(part)
    return np.concatenate(as_objects)


# --- JSON lines --------------------------------------------------------------------------------------

GPSD = "is a report of gpsd, whose epx, epy and epv are of unknown certainty; solve the receiver's raw data with RTKLIB"


class _Objects(LineParser):
    def row(self, number: int, line: str) -> dict[str, Any]:
        with reading(self.path, f"line {number} is not valid JSON"):
            value = json.loads(line, object_pairs_hook=keys_once)
            cells = list(_keys("", value))
        row = dict(cells)
        where = f"{self.path}, line {number}"
        if not isinstance(value, dict) or len(row) < len(cells):
            raise InputError(f"{where}: must be an object, and no key a.b beside b within a")
        if row.get("class") in ("TPV", "SKY", "GST"):
            raise InputError(f"{where}: {GPSD}")
        return row

    def is_whole(self, line: str, above: object) -> bool:
        return line.rstrip().endswith("}")


def _read_json_lines(path: Path) -> TableRows:
    """An object a line, as loggers write them: columns are the keys, inner ones after a dot (``P.0.1``).

    Cells are None or NaN where a line lacks a key.
    """
    found = parsed(_Objects(path))
    rows = list(itertools.chain.from_iterable(found.parts))
    columns = {}
    for name in dict.fromkeys(itertools.chain.from_iterable(rows)):
        columns[name] = _cells([row.get(name) for row in rows])
    return TableRows(path, columns, found.line, "line", found.open_line, found.cut)


def _keys(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(value, list):
        value = dict(enumerate(value))
    if not isinstance(value, dict):
        yield name, value
        return
    for key, each in value.items():
        yield from _keys(f"{name}.{key}".lstrip("."), each)
