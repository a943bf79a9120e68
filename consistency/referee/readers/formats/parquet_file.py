"""Parquet files, opened with checks, and read as columns; needs pyarrow."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from consistency.referee.errors import InputError
from consistency.referee.parsing import one_line, reading, require_room
from consistency.referee.types import Array


def open_parquet(path: Path, refusal: str = "cannot be read, damaged or cut short") -> Any:
    """A Parquet file, opened and checked for the room that it takes; raises :class:`InputError`."""
    with reading(path, refusal):
        file = pq.ParquetFile(path, page_checksum_verification=True)
        about = file.metadata
        groups = list(map(about.row_group, range(about.num_row_groups)))
        pages = sum(group.total_byte_size for group in groups)
        require_room(path, max(pages, about.num_rows * about.num_columns * 8))
        if about.num_rows != sum(group.num_rows for group in groups):
            raise ValueError("its numbers of rows do not agree")  # no checksum is over them
    return file


def read_columns(path: Path, refusal: str) -> tuple[dict[str, Array], int]:
    """Read a whole Parquet file: its columns as arrays, and the number of rows.

    Arrays are floats with NaN where a cell is empty, or objects with None there.

    Raises
    ------
    InputError
        It cannot be read, or has a name of a column twice.
    """
    file = open_parquet(path, refusal)
    with reading(path, refusal):
        table = file.read()
    names = table.column_names
    if twice := [name for name in names if names.count(name) > 1]:
        raise InputError(f"{path}: column '{one_line(twice[0])}' is duplicated")
    cells: dict[str, Array] = {}
    with reading(path, refusal):
        for name, column in zip(names, table.columns, strict=True):
            if pa.types.is_decimal(column.type):
                column = column.cast(pa.float64())
            if name != "filter" and (pa.types.is_integer(column.type) or pa.types.is_floating(column.type)):
                cells[name] = column.to_numpy().astype(float)
            else:
                cells[name] = np.fromiter(column.to_pylist(), object, len(column))
    return cells, table.num_rows
