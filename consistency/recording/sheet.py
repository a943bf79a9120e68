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
from consistency.reading import HUGE, MOST_DOF, is_file, one_line, reading
from consistency.reading import read_text as read_whole
from consistency.store.parquet import read_frame
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
            bad = np.isnan(values) & ~cells.isna().to_numpy()
        what = "not a number"
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
    return sheet


def _read_parquet(path: Path) -> Sheet:
    if not is_file(path):
        raise InputError(f"{path}: no such file")
    data = read_frame(path, "cannot be read as Parquet")
    names = [str(name) for name in data.columns]
    if twice := [name for name in names if names.count(name) > 1]:
        raise InputError(f"{path}: column '{one_line(twice[0])}' is there twice")
    return Sheet(path, data, np.arange(len(data)), "row")


def read_text(path: Path) -> list[tuple[int, str]]:
    """Lines with their numbers, without comments and empty lines."""
    if not path.exists():
        raise InputError(f"{path}: no such file")
    text = read_whole(path, "not a text file; known are .csv, .parquet, .npz, and .txt or .tum", None, "utf-8-sig")
    numbered = enumerate(text.splitlines(), 1)
    return [(number, line) for number, line in numbered if line.strip() and not line.lstrip().startswith("#")]


def _read_csv(path: Path) -> Sheet:
    lines = read_text(path)
    if not lines:
        raise InputError(f"{path}: is empty")
    header = lines[0][1]
    separator = max(",;\t", key=header.count)
    names = [name.strip().strip('"') for name in header.split(separator)]
    twice = {name for name in names if names.count(name) > 1}
    if twice:
        raise InputError(f"{path}: column '{sorted(twice)[0]}' is there twice")
    for number, line in lines[1:]:
        fields = line.count(separator) + 1
        if fields != len(names) and '"' not in line:
            raise InputError(f"{path}, line {number}: has {fields} columns, the header has {len(names)}")
    body = "\n".join(line for _, line in lines[1:])
    if not body:
        raise InputError(f"{path}: holds no row under its header")
    with reading(path, "cannot be read as CSV"):
        data = pd.read_csv(
            io.StringIO(body), sep=separator, header=None, names=names, index_col=False,
            skipinitialspace=True, float_precision="round_trip", low_memory=False,
        )  # fmt: skip
    if len(data) != len(lines) - 1:
        raise InputError(f"{path}: cannot be read as CSV (a quoted field goes over several lines)")
    return Sheet(path, data, np.array([number for number, _ in lines[1:]]), "line")


def read_numbers(path: Path, widths: Sequence[int], layout: str) -> Lines:
    """A text file of numbers, every line of the same one of the ``widths``, the first column increasing."""
    numbered = read_text(path)
    if not numbered:
        raise InputError(f"{path}: is empty; each line should be {layout}")
    rows: list[list[float]] = []
    for number, line in numbered:
        fields = line.replace(",", " ").split()
        if len(fields) not in widths:
            raise InputError(f"{path}, line {number}: has {len(fields)} columns; should be {layout}")
        if rows and len(fields) != len(rows[0]):
            raise InputError(f"{path}, line {number}: has {len(fields)} columns, the lines before {len(rows[0])}")
        try:
            rows.append([float(field) for field in fields])
        except ValueError:
            raise InputError(
                f"{path}, line {number}: not a number in '{line.strip()[:60]}'; should be {layout}"
            ) from None
    lines = Lines(path, bounded(np.array(rows)), np.array([number for number, _ in numbered]))
    wrong = np.flatnonzero(~np.isfinite(lines.t))
    if len(wrong):
        raise InputError(f"{lines.place(int(wrong[0]))}: the timestamp is not finite")
    wrong = np.flatnonzero(np.diff(lines.t) <= 0)
    if len(wrong):
        row = int(wrong[0]) + 1
        what = "is there twice" if lines.t[row] == lines.t[row - 1] else "is less than the one before"
        raise InputError(f"{lines.place(row)}: timestamp {lines.t[row]:.10g} {what}; they must increase")
    return lines
