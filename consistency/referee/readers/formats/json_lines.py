"""JSON lines: an object a line, as loggers write them; columns are the keys, inner ones after a dot: ``P.0.1``."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from consistency.referee.errors import InputError
from consistency.referee.parsing import keys_once, reading
from consistency.referee.readers.formats.text_blocks import blocks
from consistency.referee.readers.places import cut_note
from consistency.referee.types import Array, Indices

GPSD = "is a report of gpsd, whose epx, epy and epv are of unknown certainty; solve the receiver's raw data with RTKLIB"


def read_json_lines(path: Path) -> tuple[dict[str, Array], Indices, int, str]:
    """Columns of a file of JSON lines, with None or NaN where a line lacks a key, and the numbers of its lines.

    Also the last line if it has no end, or else 0, and a note if it is cut short and left out.
    """
    numbers: list[int] = []
    rows: list[dict[str, Any]] = []
    open_line, cut = 0, ""
    for block in blocks(path):
        for number, line in block.lines():
            if rows and not block.ends and not line.rstrip().endswith("}"):
                cut = cut_note(path, number)
                break
            rows.append(_row(path, number, line))
            numbers.append(number)
            open_line = 0 if block.ends else number
    names = dict.fromkeys(name for row in rows for name in row)
    columns = {name: _column([row.get(name) for row in rows]) for name in names}
    return columns, np.array(numbers), open_line, cut


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
    if not isinstance(value, (dict, list)):
        yield name, value
        return
    inner = value.items() if isinstance(value, dict) else enumerate(value)
    for key, each in inner:
        yield from _cells(f"{name}.{key}".lstrip("."), each)


def _column(cells: list[Any]) -> Array:
    """Floats where all cells are numbers or missing, else objects."""
    if {type(cell) for cell in cells} <= {int, float, type(None)}:
        return np.array([np.nan if cell is None else float(min(max(cell, -1e308), 1e308)) for cell in cells])
    return np.array([*cells, None], object)[:-1]
