"""Tables of a log, in Parquet or as CSV, with the same checks."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pandas as pd
import pyarrow as pa
import pyarrow.csv as pa_csv

from consistency.bench.store.parquet import OPTIONAL, check_column, read_parquet, require_table
from consistency.referee.column_names import COLUMNS
from consistency.referee.errors import InputError
from consistency.referee.parsing import is_file, reading, require_room

FORMATS = ("parquet", "csv")
DAMAGED = "cannot be read as CSV; needs a header, and in each row as many numbers, with commas between them"


def require_format(form: str) -> None:
    """Refuse a form of tables that is none of ``FORMATS``."""
    if form not in FORMATS:
        raise InputError(f"--format {form}: must be {' or '.join(FORMATS)}")


def table_file(folder: Path, name: str) -> Path:
    """Where a table of a log is, or would be: NAME.parquet, or NAME.csv where that is there.

    Raises
    ------
    InputError
        Both are there.
    """
    paths = [folder / f"{name}.{form}" for form in FORMATS]
    there = [path for path in paths if path.exists()]
    if len(there) > 1:
        raise InputError(f"{folder}: holds {there[0].name} and {there[1].name}; take one of them away")
    return there[0] if there else paths[0]


def read_table_file(folder: Path, name: str, also: Sequence[str] = ()) -> pd.DataFrame:
    """One table of numbers, checked: its columns and those in ``also``, types, no NaN where none is allowed.

    Raises
    ------
    InputError
        The file is missing, damaged, lacks a column or holds what the column may not.
    """
    path = table_file(folder, name)
    if path.suffix == ".parquet":
        require_table(folder, name, also)
        return read_parquet(folder, name)
    if not is_file(path):
        raise InputError(f"{path}: is not a file")
    names = _header(path)
    needed = dict.fromkeys((*COLUMNS[name], *also))
    if missing := [column for column in needed if column not in names]:
        raise InputError(f"{path}: column '{missing[0]}' is missing; needed: {', '.join(needed)}")
    if twice := [column for column in names if names.count(column) > 1]:
        raise InputError(f"{path}: column '{twice[0]}' is duplicated")
    kinds = COLUMNS[name] | {key: kind for key, kind in OPTIONAL.get(name, {}).items() if key in names}
    with reading(path, DAMAGED):
        convert = pa_csv.ConvertOptions(include_columns=list(kinds), column_types=dict.fromkeys(kinds, pa.float64()))
        read = pa_csv.read_csv(path, convert_options=convert)
        require_room(path, read.nbytes)
        table: pd.DataFrame = read.to_pandas()
    for column, kind in kinds.items():
        check_column(path, table[column], kind)
    return table.astype(kinds)


def _header(path: Path) -> list[str]:
    with reading(path, DAMAGED), path.open(encoding="utf-8-sig") as file:
        return [name.strip('"') for name in file.readline(2**16).strip().split(",")]
