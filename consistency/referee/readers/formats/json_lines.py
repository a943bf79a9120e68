"""JSON lines: an object a line, as loggers write them; columns are the keys, inner ones after a dot: ``P.0.1``."""

from __future__ import annotations

import json
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from consistency.referee.errors import InputError
from consistency.referee.parsing import keys_once, reading
from consistency.referee.readers.formats.text_blocks import LineParser, Parsed, parsed
from consistency.referee.types import Array

GPSD = "is a report of gpsd, whose epx, epy and epv are of unknown certainty; solve the receiver's raw data with RTKLIB"


class _Objects(LineParser):
    def row(self, number: int, line: str) -> dict[str, Any]:
        return _row(self.path, number, line)

    def is_whole(self, line: str, above: object) -> bool:
        return line.rstrip().endswith("}")


def read_json_lines(path: Path) -> tuple[dict[str, Array], Parsed]:
    """Columns of a file of JSON lines, with None or NaN where a line lacks a key, and the lines that they are of."""
    found = parsed(_Objects(path))
    rows = list(chain.from_iterable(found.parts))
    columns = {}
    for name in dict.fromkeys(chain.from_iterable(rows)):
        columns[name] = _column([row.get(name) for row in rows])
    return columns, found


def _row(path: Path, number: int, line: str) -> dict[str, Any]:
    with reading(path, f"line {number} is not valid JSON"):
        value = json.loads(line, object_pairs_hook=keys_once)
        cells = list(_cells("", value))
    row = dict(cells)
    if not isinstance(value, dict) or len(row) < len(cells):
        raise InputError(f"{path}, line {number}: must be an object, and no key a.b beside b within a")
    if row.get("class") in ("TPV", "SKY", "GST"):
        raise InputError(f"{path}, line {number}: {GPSD}")
    return row


def _cells(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    if isinstance(value, list):
        value = dict(enumerate(value))
    if not isinstance(value, dict):
        yield name, value
        return
    for key, each in value.items():
        yield from _cells(f"{name}.{key}".lstrip("."), each)


def _column(cells: list[Any]) -> Array:
    """Floats where all cells are numbers or missing, else objects."""
    if set(map(type, cells)) <= {int, float, type(None)}:
        return np.array([np.nan if cell is None else min(max(cell, -1e308), 1e308) for cell in cells], float)
    return np.array([*cells, None], object)[:-1]
