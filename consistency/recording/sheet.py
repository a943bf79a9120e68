"""Text files and Parquet tables, with the place of every row for messages."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import overload

import numpy as np
import pandas as pd

from consistency.errors import InputError
from consistency.reading import HUGE, MOST_DOF, is_file, one_line, reading, require_name
from consistency.recording.text import Block, blocks
from consistency.store.parquet import are_no_numbers, read_frame
from consistency.types import Array, Indices


@dataclass(frozen=True)
class Sheet:
    """A table and where each of its rows stands in the file."""

    path: Path
    data: pd.DataFrame
    line: Indices  # (N,), line of a text file, row of a Parquet file
    unit: str  # line | row

    def __contains__(self, column: str) -> bool:
        return column in self.data.columns

    @property
    def columns(self) -> str:
        """The names of the first columns, for messages."""
        names = [str(name) for name in self.data.columns]
        return ", ".join(names[:12]) + ", …" * (len(names) > 12)

    def place(self, row: int) -> str:
        return f"{self.path}, {self.unit} {self.line[row]}"

    def numbers(self, column: str, finite: bool = False, whole: bool = False) -> Array:
        """A column as floats, NaN where empty; refused where it is text, or not finite or whole as asked for."""
        cells = self.data[column]
        with reading(self.path, f"column '{column}' cannot be read as numbers"):
            values: Array = pd.to_numeric(cells, errors="coerce").to_numpy(float, na_value=np.nan)
            values = bounded(values)
            other = are_no_numbers(cells)
            bad = other | np.isnan(values) & ~cells.isna().to_numpy()
        what = "a truth value or a date, which is to be written as a number" if other.any() else "not a number"
        if not bad.any() and (finite or whole):
            bad, what = ~np.isfinite(values), "not a finite number"
        if not bad.any() and whole:
            bad, what = values != np.round(values), "not a whole number"
        if bad.any():
            row = int(np.flatnonzero(bad)[0])
            raise InputError(f"{self.place(row)}: column '{column}': {what} ({one_line(cells.iloc[row], 60)})")
        return values

    def rows(self, keep: Array) -> Sheet:
        """The rows of a mask or of indices."""
        index = np.arange(len(self.data))[keep]
        return Sheet(self.path, self.data.iloc[index], self.line[index], self.unit)


@dataclass(frozen=True)
class Lines:
    """The numbers of a text file."""

    path: Path
    values: Array  # (N, columns), the first of which is t
    line: Indices  # (N,)

    @property
    def t(self) -> Array:
        """First column, (N,), s."""
        return self.values[:, 0]

    def place(self, row: int) -> str:
        return f"{self.path}, line {self.line[row]}"

    def of(self, columns: slice) -> Lines:
        """Some of the columns, without holding the others in memory."""
        return Lines(self.path, self.values[:, columns].copy(), self.line)


class Places(Sequence[str]):
    """Where some rows of a file stand, put into words when asked for."""

    def __init__(self, of: Callable[[int], str], rows: Indices) -> None:
        self._of, self._rows = of, rows

    @overload
    def __getitem__(self, which: int) -> str: ...
    @overload
    def __getitem__(self, which: slice) -> Places: ...
    def __getitem__(self, which: int | slice) -> str | Places:
        if isinstance(which, slice):
            return Places(self._of, self._rows[which])
        return self._of(int(self._rows[which]))

    def __len__(self) -> int:
        return len(self._rows)

    def at(self, rows: Indices) -> Places:
        """Those of some of the rows."""
        return Places(self._of, self._rows[rows])


def bounded(values: Array) -> Array:
    """Numbers, where those that no sensor measures are infinite: what a filter that broke down writes."""
    return np.where(np.abs(values) > HUGE, np.copysign(np.inf, values), values)


def are_dof(values: Array) -> Array:
    """Whether numbers are degrees of freedom: whole, from 0 to below 2^31."""
    return np.asarray((values >= 0) & (values < MOST_DOF) & (values == np.round(values)))


def read_sheet(path: Path) -> Sheet:
    """A CSV file (comma, semicolon or tab; # comments) or a Parquet file."""
    sheet = _read_parquet(path) if path.suffix.lower() in (".parquet", ".pq") else _read_csv(path)
    if sheet.data.empty:
        raise InputError(f"{path}: holds no row")
    if "filter" in sheet:
        for name in sheet.data["filter"].dropna().unique():
            require_name(str(name), f"{path}: column 'filter'")
    return sheet


def _read_parquet(path: Path) -> Sheet:
    if not is_file(path):
        raise InputError(f"{path}: no such file")
    data = read_frame(path, "cannot be read as Parquet")
    names = [str(name) for name in data.columns]
    if twice := [name for name in names if names.count(name) > 1]:
        raise InputError(f"{path}: column '{one_line(twice[0])}' is there twice")
    return Sheet(path, data, np.arange(len(data)), "row")


def _read_csv(path: Path) -> Sheet:
    names: list[str] = []
    separator, tables, line = ",", list[pd.DataFrame](), list[Indices]()
    for block in blocks(path):
        if not names:
            lines = block.lines()
            if not lines:
                continue
            names, separator = _header(path, lines[0][1])
            found = _rows(path, lines[1:], names, separator)
        else:
            found = _plain_rows(block, names, separator) or _rows(path, block.lines(), names, separator)
        if found is not None:
            tables.append(found[0])
            line.append(found[1])
    if not names:
        raise InputError(f"{path}: is empty")
    if not tables:
        raise InputError(f"{path}: holds no row under its header")
    return Sheet(path, pd.concat(tables, ignore_index=True), np.concatenate(line), "line")


def _header(path: Path, line: str) -> tuple[list[str], str]:
    """Names of the columns, and the character between them."""
    separator = max(",;\t", key=line.count)
    names = [name.strip().strip('"') for name in line.split(separator)]
    twice = {name for name in names if names.count(name) > 1}
    if twice:
        raise InputError(f"{path}: column '{sorted(twice)[0]}' is there twice")
    return names, separator


def _rows(
    path: Path, lines: list[tuple[int, str]], names: list[str], separator: str
) -> tuple[pd.DataFrame, Indices] | None:
    """Rows of a table from its lines, and their numbers; None without any."""
    for number, line in lines:
        fields = line.count(separator) + 1
        if fields != len(names) and '"' not in line:
            raise InputError(f"{path}, line {number}: has {fields} columns, the header has {len(names)}")
    if not lines:
        return None
    data = _parsed(path, io.StringIO("\n".join(line for _, line in lines)), names, separator)
    if len(data) != len(lines):
        raise InputError(f"{path}: cannot be read as CSV (a quoted field goes over several lines)")
    return data, np.array([number for number, _ in lines])


def _plain_rows(block: Block, names: list[str], separator: str) -> tuple[pd.DataFrame, Indices] | None:
    """The same of a block that every line of is a row; None where that has to be looked at."""
    if len(names) == 1 or not block.plain or b"\n\t" in block.data or block.data[:1] == b"\t":
        return None
    if (block.count_of(separator.encode()) != len(names) - 1).any():
        return None
    data = _parsed(block.path, io.BytesIO(block.data), names, separator)
    return (data, block.first + np.arange(block.count)) if len(data) == block.count else None


def _parsed(path: Path, file: io.StringIO | io.BytesIO, names: list[str], separator: str) -> pd.DataFrame:
    with reading(path, "cannot be read as CSV"):
        return pd.read_csv(
            file, sep=separator, header=None, names=names, index_col=False, skipinitialspace=True,
            float_precision="round_trip", low_memory=False, dtype={"filter": str} if "filter" in names else None,
        )  # fmt: skip


def read_numbers(path: Path, widths: Sequence[int], layout: str) -> Lines:
    """A text file of numbers, every line of the same one of the ``widths``, the first column increasing."""
    values, line, width = list[Array](), list[Indices](), 0
    for block in blocks(path):
        found = block.numbers()
        if found is None or found[0].shape[1] not in widths or width not in (0, found[0].shape[1]):
            found = _number_rows(path, block.lines(), widths, width, layout)
        if len(found[1]):
            width = found[0].shape[1]
            values.append(bounded(found[0]))
            line.append(found[1])
    if not values:
        raise InputError(f"{path}: is empty; each line should be {layout}")
    lines = Lines(path, np.concatenate(values), np.concatenate(line))
    wrong = np.flatnonzero(~np.isfinite(lines.t))
    if len(wrong):
        raise InputError(f"{lines.place(int(wrong[0]))}: the timestamp is not finite")
    wrong = np.flatnonzero(np.diff(lines.t) <= 0)
    if len(wrong):
        row = int(wrong[0]) + 1
        what = "is there twice" if lines.t[row] == lines.t[row - 1] else "is less than the one before"
        raise InputError(f"{lines.place(row)}: timestamp {lines.t[row]:.10g} {what}; they must increase")
    return lines


def _number_rows(
    path: Path, lines: list[tuple[int, str]], widths: Sequence[int], width: int, layout: str
) -> tuple[Array, Indices]:
    """The same of some lines, after lines of ``width`` columns if it is not 0; refused with the number of the line."""
    rows: list[list[float]] = []
    for number, line in lines:
        fields = line.replace(",", " ").split()
        if len(fields) not in widths:
            raise InputError(f"{path}, line {number}: has {len(fields)} columns; should be {layout}")
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
