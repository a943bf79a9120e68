"""Tables as Parquet: written piece by piece, digested in the manifest, and read back with checks."""

from __future__ import annotations

import datetime
import functools
import hashlib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from consistency.bench.types import Trial
from consistency.referee import system
from consistency.referee.column_names import COLUMNS, OWN_COVARIANCE, POSE
from consistency.referee.errors import InputError
from consistency.referee.parsing import HUGE, LARGEST_NUMBER, MOST_DOF, WHOLE, is_file, one_line, reading
from consistency.referee.readers.formats.parquet_file import open_parquet
from consistency.referee.system import NewFolder
from consistency.referee.types import Array, Failure

OPTIONAL = {  # columns of a table that may be missing
    "observations": {"z2": "float64", "source": "int64"},  # z2 by sensors of three values
    "estimates": dict.fromkeys([*OWN_COVARIANCE, "own_nees"], "float64"),
    "map": {"joint_nees": "float64"},
}
NULLABLE = {"nees", "nis", *OPTIONAL["estimates"], *OPTIONAL["map"]}
GIVEN = {"truth", "landmarks", "controls", "observations"}  # tables of the world, which no filter makes diverge
SQUARES = {"nees", "own_nees"}  # never negative
UNBOUNDED = {"joint_nees"}  # infinite where the joint covariance of a run is not positive definite
BY_FILTER = {"estimates", "map"}  # tables whose row groups hold one filter each
REPEATED = {"t", "dt"}  # floating-point columns of few different values
ROWS = 65_536  # of a row group, and of a batch that is read
TYPES = {"str": pa.string(), "int64": pa.int64(), "float64": pa.float64()}
NO_NUMBERS = (bool, np.bool_, datetime.date, datetime.timedelta, np.datetime64, np.timedelta64)
Columns = dict[str, Array]  # columns of a table by name, equally long
TABLES = (".parquet", ".csv")  # the latter of logs alone

# --- writing -------------------------------------------------------------------------------------


class Writer:
    """A Parquet file of the table ``name``, in row groups of ``ROWS`` rows however many are added at a time.

    ``columns`` are those of the rows to come, where an optional one may be among them.
    """

    def __init__(self, path: Path, name: str, columns: Iterable[str] = ()) -> None:
        kinds = column_kinds(name, columns)
        self.optional = set(OPTIONAL.get(name, ()))
        self.schema = pa.schema([(column, TYPES[kind]) for column, kind in kinds.items()])
        # the bytes of similar numbers are alike: apart from each other they take less room, and nothing is lost
        split = [column for column, kind in kinds.items() if kind == "float64" and column not in REPEATED]
        repeated = [column for column in kinds if column not in split]
        # numbers hardly compress, so that damage to them goes unseen without a checksum
        self._file = pq.ParquetWriter(
            path, self.schema, compression="zstd", use_dictionary=repeated, use_byte_stream_split=split,
            write_page_checksum=True,
        )  # fmt: skip
        self._pieces: list[Any] = []
        self._rows = 0

    def __enter__(self) -> Writer:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def add(self, columns: Columns, filter_name: str | None = None) -> None:
        """Rows of arrays, all of the filter that is named; an optional column that is not among them is null."""
        rows = len(next(iter(columns.values())))
        arrays = []
        for field in self.schema:
            if field.name == "filter" and filter_name is not None:
                array = pa.repeat(pa.scalar(filter_name, field.type), rows)
            elif field.name in self.optional and field.name not in columns:
                array = pa.nulls(rows, field.type)
            else:
                array = pa.array(columns[field.name], field.type, from_pandas=True)
            arrays.append(array)
        self._pieces.append(pa.RecordBatch.from_arrays(arrays, schema=self.schema))
        self._rows += rows
        if self._rows >= ROWS:
            self._write(self._rows - self._rows % ROWS)

    def end_group(self) -> None:
        """The rows that come next begin a row group of their own."""
        if self._rows:
            self._write(self._rows)

    def _write(self, rows: int) -> None:
        table = pa.Table.from_batches(self._pieces)
        self._file.write_table(table.slice(0, rows), row_group_size=ROWS)
        self._pieces = table.slice(rows).to_batches()
        self._rows -= rows


def column_kinds(name: str, columns: Iterable[str]) -> dict[str, str]:
    """Types of the columns of a table, with those of the optional ones that are among ``columns``."""
    present = set(columns)
    return COLUMNS[name] | {key: kind for key, kind in OPTIONAL.get(name, {}).items() if key in present}


def write_table(path: Path, name: str, table: pd.DataFrame) -> None:
    """A whole table; estimates and maps in row groups of one filter each."""
    kinds = column_kinds(name, map(str, table))
    table = table[list(kinds)].astype(kinds)
    with Writer(path, name, kinds) as writer:
        if name not in BY_FILTER:
            writer.add({str(column): table[column].to_numpy() for column in table})
        else:
            for filter_name in table["filter"].unique():
                part = table[table["filter"] == filter_name].drop(columns="filter")
                writer.add({str(column): part[column].to_numpy() for column in part}, filter_name)
                writer.end_group()
        writer.end_group()


# --- reading -------------------------------------------------------------------------------------


def read_parquet(folder: Path, name: str) -> pd.DataFrame:
    """One table of a folder, checked: columns, types, no NaN where none is allowed.

    Raises
    ------
    InputError
        The file is missing, damaged, lacks a column or holds what the column may not.
    """
    path = folder / f"{name}.parquet"
    file = require_table(folder, name)
    dtypes = column_kinds(name, file.schema_arrow.names)
    with reading(path):
        read = _plain(file.read(list(dtypes)))
        table = read.to_pandas()
    for column, kind in dtypes.items():
        if kind == "str":
            _require_text(path, read.column(column))
        else:
            check_column(path, table[column], kind)
    with reading(path):
        checked: pd.DataFrame = table.astype(dtypes)
    return checked


def read_batches(folder: Path, name: str, columns: Sequence[str], filter_name: str | None = None) -> Iterator[Columns]:
    """Columns of numbers, some rows at a time and checked likewise; of one filter where it is named."""
    path, dtypes = folder / f"{name}.parquet", COLUMNS[name] | OPTIONAL.get(name, {})
    file = require_table(folder, name, columns)
    needed = [*columns, "filter"] if filter_name is not None else list(columns)
    filters_of_groups = None if filter_name is None else _filters_of(path)
    first = 0
    for group in range(file.num_row_groups):
        if filters_of_groups is not None and filter_name not in filters_of_groups[group]:
            first += file.metadata.row_group(group).num_rows
            continue
        with reading(path):
            for batch in map(_plain, file.iter_batches(ROWS, [group], needed)):
                table = {column: batch.column(column).to_pandas() for column in columns}
                for column, values in table.items():
                    values.name = column
                    check_column(path, values, dtypes[column], first)
                of_filter: Any = slice(None)
                if filter_name is not None:
                    _require_text(path, batch.column("filter"), first)
                    of_filter = pc.equal(batch.column("filter"), filter_name).to_numpy(zero_copy_only=False)
                first += batch.num_rows
                yield {column: values.to_numpy(dtypes[column])[of_filter] for column, values in table.items()}
    pa.default_memory_pool().release_unused()


def require_table(folder: Path, name: str, also: Sequence[str] = ()) -> Any:
    """The opened file of a table, refused where it is missing, damaged or lacks a column, those in ``also`` too."""
    path = folder / f"{name}.parquet"
    if not is_file(path):
        raise InputError(f"{path}: {'is not a file' if path.exists() else 'missing'}; write the folder again")
    file = open_parquet(path)
    needed, names = dict.fromkeys((*COLUMNS[name], *also)), file.schema_arrow.names
    if missing := [column for column in needed if column not in names]:
        raise InputError(f"{path}: column '{missing[0]}' is missing; needed: {', '.join(needed)}")
    if repeated := [column for column in needed if names.count(column) > 1]:
        raise InputError(f"{path}: column '{repeated[0]}' is duplicated")
    return file


def read_frame(path: Path) -> pd.DataFrame:
    """Read a whole Parquet file of unknown columns, by columns alone; raises :class:`InputError`."""
    file = open_parquet(path)
    with reading(path):
        table: pd.DataFrame = _plain(file.read()).to_pandas()
        return table


def _plain(table: Any) -> Any:
    """A table or batch without the notes of other programs, which may turn columns into an index or other types."""
    return table.replace_schema_metadata(None)


def _filters_of(path: Path) -> tuple[frozenset[str], ...]:
    """Names of the filters in each row group of a table, which is passed over where a filter is not in it.

    They are read and not taken from the statistics of the file: those that are damaged end the process, as pyarrow lets
    no exception out of what it says of a column.
    """
    with reading(path):
        about = path.stat()
    return _filters_read(path, about.st_mtime_ns, about.st_size)


@functools.lru_cache(maxsize=16)
def _filters_read(path: Path, mtime_ns: int, size: int) -> tuple[frozenset[str], ...]:
    file, first, filters_of_groups = open_parquet(path), 0, []
    for group in range(file.num_row_groups):
        with reading(path):
            names = file.read_row_group(group, ["filter"]).column("filter")
        _require_text(path, names, first)
        filters_of_groups.append(frozenset(pc.unique(names).to_pylist()))
        first += len(names)
    return tuple(filters_of_groups)


def _require_text(path: Path, names: Any, first: int = 0) -> None:
    kind = names.type.value_type if pa.types.is_dictionary(names.type) else names.type
    if not (pa.types.is_string(kind) or pa.types.is_large_string(kind)):
        raise InputError(f"{path}: a column of text holds {one_line(kind, 40)}; write the folder again")
    if names.null_count:
        row = first + pc.index(names.is_null(), True).as_py()
        raise InputError(f"{path}: a column of text, row {row}: nothing there")


def are_no_numbers(cells: pd.Series[Any]) -> Array:
    """Which cells (N,) are truth values, dates or durations, which pandas would turn into numbers."""
    if cells.dtype.kind != "O":
        return np.full(len(cells), cells.dtype.kind in "bmM")
    return np.fromiter((isinstance(cell, NO_NUMBERS) for cell in cells), bool, len(cells))


def check_column(path: Path, column: pd.Series[Any], kind: str, first: int = 0) -> None:
    """Refuse what is not a number; ``first`` is the row of the file that the column begins with."""
    with reading(path, f"column '{column.name}' cannot be read as numbers"):
        if column.dtype.kind == "c" or are_no_numbers(column).any():
            raise ValueError(column.dtype)
        values = pd.to_numeric(column, errors="coerce").to_numpy(float, na_value=np.nan)
    if column.name in NULLABLE:
        values = np.where(column.isna() | (values == np.inf) & (column.name in UNBOUNDED), 0.0, values)
    largest = LARGEST_NUMBER
    if column.name == "nis_dof":
        largest = MOST_DOF - 1
    elif path.stem in GIVEN:
        largest = HUGE
    is_allowed = np.abs(values) <= largest  # false of NaN
    if not is_allowed.all():
        row = int(np.argmin(is_allowed))
        value, what = one_line(column.iloc[row], 60), "too large a" if np.isfinite(values[row]) else "not a finite"
        raise InputError(f"{path}: column '{column.name}', row {first + row}: {what} number ({value})")
    if column.name in SQUARES and (values < 0).any():
        row = int(np.argmax(values < 0))
        raise InputError(f"{path}: column '{column.name}', row {first + row}: negative ({values[row]:g})")
    if kind == "int64" and ((values != np.round(values)) | (np.abs(values) > WHOLE)).any():
        row = int(np.flatnonzero((values != np.round(values)) | (np.abs(values) > WHOLE))[0])
        raise InputError(f"{path}: column '{column.name}', row {first + row}: not a whole number ({values[row]})")


def write_tables(
    folder: Path,
    tables: dict[str, pd.DataFrame],
    manifest: dict[str, Any],
    extra: Callable[[Path], None] | None = None,
    overwrite: bool = False,
    keep_others: bool = False,
) -> None:
    """Tables as Parquet, the manifest, and whatever ``extra`` writes, as :func:`system.write_folder`."""

    def contents(at: Path) -> None:
        for name, table in tables.items():
            write_table(at / f"{name}.parquet", name, table)
        if extra is not None:
            extra(at)

    system.write_folder(folder, manifest, contents, overwrite, keep_others, with_tables)


def write_texts(folder: Path, texts: Mapping[str, str]) -> None:
    """Texts in files of these names."""
    for name, text in texts.items():
        (folder / name).write_text(text, encoding="utf-8")


def with_tables(new: NewFolder, manifest: dict[str, Any]) -> dict[str, Any]:
    """The manifest with what tables there are; of results also their rows and digests. Logs may be edited."""
    tables = sorted(COLUMNS.keys() & {file.stem for file in new.path.iterdir() if file.suffix in TABLES})
    manifest = manifest | {"tables": tables}
    if new.kind == "results":
        with new.writing():
            manifest["contents"] = {name: _content_of(new.path, name) for name in tables}
    return manifest


def _content_of(folder: Path, name: str) -> dict[str, Any]:
    with (folder / f"{name}.parquet").open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    return {"rows": require_table(folder, name).metadata.num_rows, "sha256": digest}


def require_unchanged(folder: Path, manifest: dict[str, Any]) -> None:
    """Refuse tables that are not those that were written with the manifest; one of before has nothing to say.

    Raises
    ------
    InputError
        A table was edited, replaced or damaged, or is missing; the manifest names none of this bench.
    """
    written_contents = manifest.get("contents", {})
    if not isinstance(written_contents, dict) or not written_contents.keys() <= COLUMNS.keys():
        raise InputError(f"{folder / 'manifest.json'}: key 'contents' must have tables as keys; write the folder again")
    for name in written_contents:
        path = folder / f"{name}.parquet"
        try:
            content_now = _content_of(folder, name)
        except OSError as error:
            raise InputError(f"{path}: cannot be read ({error.strerror or error})") from None
        if content_now != written_contents[name]:
            raise InputError(
                f"{path}: is not as it was written, but damaged or edited; write the folder again, or, if the change "
                f"is meant, take '{name}' out of the key 'contents' of manifest.json"
            )


class Rejected(NamedTuple):
    """How many observations a guard was offered in a run, and what it rejected; a row of ``rejections``."""

    filter: str
    run: int
    offered: int
    spurious: int
    rejected: int
    rejected_spurious: int


def truth_columns(trial: Trial, path: Array) -> Columns:
    return {
        "run": np.full(len(path), trial.run),
        "step": np.arange(len(path)),
        "t": trial.t,
        **dict(zip(POSE, path.T, strict=True)),
    }


def stacked_table(name: str, parts: Sequence[tuple[str, Columns]], also: Sequence[str] = ()) -> pd.DataFrame:
    """Table ``name`` of (filter, columns), one below the other; NaN where a column is lacking, one of ``also`` too.

    The columns are nobody else's: pandas would copy them, at millions of rows half the memory.
    """
    table = pd.DataFrame(columns=list(COLUMNS[name])).astype(COLUMNS[name])
    if parts:
        rows, stacked = [len(columns["run"]) for _, columns in parts], dict[str, Any]()
        if name in BY_FILTER:
            filter_names = pd.Series([filter_name for filter_name, _ in parts], dtype="str")
            stacked["filter"] = filter_names.repeat(rows).reset_index(drop=True)
        for column in dict.fromkeys(column for _, part in parts for column in part):
            pairs = zip(parts, rows, strict=True)
            column_pieces = [part[column] if column in part else np.full(n, np.nan) for (_, part), n in pairs]
            stacked[column] = np.concatenate(column_pieces)
        table = pd.DataFrame(stacked, copy=False)
    missing_columns = [column for column in also if column not in table]
    return table.assign(**dict.fromkeys(missing_columns, np.nan)) if missing_columns else table


def noted_table(name: str, rows: Sequence[Failure | Rejected]) -> pd.DataFrame:
    """``failures.parquet`` or ``rejections.parquet``."""
    return pd.DataFrame(rows, columns=list(COLUMNS[name])).astype(COLUMNS[name])


def controls_table(trials: Sequence[Trial]) -> pd.DataFrame:
    tables = []
    for trial in trials:
        columns: Columns = {"run": np.full(trial.steps, trial.run), "step": np.arange(1, trial.steps + 1)}
        columns |= dict(zip(["dt", "v", "omega"], trial.controls.T, strict=True))
        tables.append(pd.DataFrame(columns))
    return pd.concat(tables, ignore_index=True)


def observations_table(trials: Sequence[Trial]) -> pd.DataFrame:
    """``observations.parquet``; with a column ``source`` if a row is not of the landmark that it says."""
    has_sources = any(trial.source is not None for trial in trials)
    tables = []
    for trial in trials:
        columns: Columns = {"run": np.full(len(trial.landmark), trial.run), "step": trial.step}
        columns["landmark"] = trial.landmark
        columns |= dict(zip(["z0", "z1", "z2"], trial.z.T, strict=False))
        if has_sources:
            columns["source"] = trial.landmark if trial.source is None else trial.source
        tables.append(pd.DataFrame(columns))
    return pd.concat(tables, ignore_index=True)
