"""The column of ``--by``: its values in every row of the estimates, and the groups of a record."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from consistency.referee.diagnostics.groups import (
    BINS,
    Column,
    column_of,
    groups_of,
    made_from_errors,
    on_steps,
    selects_on_outcome,
)
from consistency.referee.diagnostics.record import Record
from consistency.referee.errors import InputError
from consistency.referee.readers.options import GroupOptions
from consistency.referee.readers.truth_matching import ROUNDING, Estimator, Poses, evenly, submatrices
from consistency.referee.types import Array, Indices

if TYPE_CHECKING:
    from consistency.referee.readers.formats.sheet import TableRows

ENOUGH = 5000  # rows that show what a column is made from
NO_TRUTH = "has no truth, so that there are no errors to group"
NO_COLUMNS = "has no columns of its own; --by-file FILE names a table with the column and t or run"


def with_values(e: Estimator, options: GroupOptions, judged: Sequence[int]) -> tuple[Estimator, Column]:
    """The estimator with the values of the column in each row, and the column of all rows.

    Raises
    ------
    InputError
        There are no errors, or the files have no such column, or no time at which to look it up.
    """
    assert options.by is not None
    if e.innovations_alone:
        raise InputError(f"--by {options.by}: {e.path} {NO_TRUTH}")
    cells = [p.own.by for p in e.runs if p.own.by is not None]
    if options.by_file is not None:
        sheet = _sheet(options)
        cells = [_looked_up(sheet, options.by, p.source.run, p.seconds) for p in e.runs]
    if len(cells) < len(e.runs):
        raise InputError(f"--by {options.by}: {e.path} {NO_COLUMNS}")
    column = column_of(options.by, np.concatenate(cells))
    column = replace(column, outcome=selects_on_outcome(column, [e.error.axes[i] for i in judged]))
    runs = []
    start = 0
    for p in e.runs:
        end = start + len(p.own.t)
        runs.append(p.with_values(by=column.values[start:end]))
        start = end
    return replace(e, runs=runs), column


def in_groups(
    records: Sequence[Record], column: Column, e: Estimator, pairs: Sequence[Poses], options: GroupOptions
) -> list[Record]:
    """The records of an estimator with their groups.

    Parameters
    ----------
    pairs : estimates that are judged, beside their truth; none where motions are judged

    Raises
    ------
    InputError
        As :func:`grouped`.
    """
    if pairs:
        axes = itertools.chain.from_iterable(record.errors.axes for record in records)
        column = _beside_states(column, e, sorted(map(list(e.error.axes).index, axes)), pairs)
    return [grouped(record, column, options) for record in records]


def _beside_states(column: Column, e: Estimator, judged: Sequence[int], pairs: Sequence[Poses]) -> Column:
    """The column, marked where its values are those of a judged component of the truth or the estimate, or a sigma."""
    columns = _columns_of(e, judged)
    values = []
    truth = []
    estimate = []
    P = []
    for p in pairs:
        some = p.pairs(_some(len(p.own.t), len(pairs)))
        assert some.own.by is not None
        values.append(some.own.by)
        truth.append(some.true.values[:, columns[columns < some.true.values.shape[1]]])
        estimate.append(some.own.estimate[:, columns[columns < some.own.estimate.shape[1]]])
        P.append(submatrices(some.own.covariance, judged))
    column = replace(column, values=np.concatenate(values))
    stacked = map(np.concatenate, (truth, estimate, P))
    return replace(column, outcome=selects_on_outcome(column, [e.error.axes[i] for i in judged], *stacked))


def _columns_of(e: Estimator, judged: Sequence[int]) -> Indices:
    """Columns of a state that are judged components; of rotations in space, which are quaternions, none."""
    columns = np.array(judged, np.int64)
    if not e.error.convention:  # errors of an archive stand in the place of a truth
        return columns[:0]
    if e.error.in_space:
        columns = np.concatenate([columns[columns < 3], columns[columns > 5] + 1])
    return columns


def _some(count: int, parts: int = 1) -> Indices:
    """At most ``ENOUGH`` of so many rows in all, evenly chosen."""
    return evenly(count, max(ENOUGH // parts, 2))


def _sizes(record: Record) -> Array | None:
    """Sizes of errors, (runs, steps): the NEES, or what it would be of bounds; None without truth."""
    if record.errors.bounded is None:
        return record.errors.nees
    return np.asarray(np.square(record.errors.bounded.ratios).sum(axis=-1))


def grouped(record: Record, column: Column, options: GroupOptions, option: str = "--by") -> Record:
    """The record with its groups.

    Raises
    ------
    InputError
        The column is made from the errors, or makes no groups.
    """
    if record.runs.by is None:
        return record
    sizes = _sizes(record)
    if sizes is None:
        raise InputError(f"{option} {column.name}: {record.name} {NO_TRUTH}")
    if column.words and options.bins is not None:
        flag = option.replace("by", "bins")
        raise InputError(f"{flag}: {column.name} holds words, each of which is a group; leave the option out")
    counted = np.isfinite(sizes)
    if not counted.any():
        return record
    some = _some(int(counted.sum()))
    run, step = (places[some] for places in np.nonzero(counted))
    error = None
    if record.errors.error is not None:
        error = record.errors.error[run, step]
    if why := made_from_errors(column.name, record.runs.by[run, step], error, sizes[run, step]):
        raise InputError(
            f"{option} {column.name}: the column is made from the errors ({why}), and groups of small and of large "
            "errors differ in any estimator; take a column that was fixed before the error was, or rename one that is "
            "only called so"
        )
    try:
        bins = BINS if options.bins is None else options.bins
        groups = groups_of(replace(column, values=record.runs.by), bins, counted)
    except ValueError as wrong:
        raise InputError(f"{option} {column.name}: {wrong}") from None
    return replace(record, groups=groups)


def record_in_groups(record: Record, options: GroupOptions) -> Record:
    """A record that its reader has made, with its groups.

    Raises
    ------
    InputError
        The files have no such column, or as :func:`grouped`.
    """
    assert options.by is not None
    cells = record.runs.by
    if options.by_file is not None:
        sheet = _sheet(options)
        of_runs = [_looked_up(sheet, options.by, int(run), record.runs.t) for run in record.run_numbers]
        cells = np.stack(of_runs)
    if cells is None:
        raise InputError(f"--by {options.by}: {record.name} {NO_COLUMNS}")
    return _by_cells(record, options.by, cells, options)


def _by_cells(record: Record, name: str, cells: Array, options: GroupOptions, option: str = "--by") -> Record:
    """The record with groups of the cells of a column, (runs, steps)."""
    column = column_of(name, cells)
    column = replace(
        column, outcome=selects_on_outcome(column, record.errors.axes, covariance=record.errors.covariance)
    )
    return grouped(replace(record, runs=replace(record.runs, by=column.values)), column, options, option)


def with_groups(
    record: Record, by: ArrayLike | Mapping[str, ArrayLike] | None, bins: int | Sequence[float] | None
) -> Record:
    """The record with groups of an array in memory; see :func:`consistency.judge`.

    Raises
    ------
    InputError
        As :func:`grouped`; the array has another shape, or bins are given without one.
    """
    if by is None:
        raise InputError("bins: goes with by=")
    if not isinstance(by, Mapping):
        by = {"array": by}
    if len(by) != 1:
        raise InputError(f"by: one name with its values, {{'n_matches': array}}; got {len(by)} names")
    sizes = _sizes(record)
    if sizes is None:
        raise InputError(f"by: {record.name} {NO_TRUTH}")
    ((name, values),) = by.items()
    try:
        cells = on_steps(values, sizes.shape)
    except ValueError as wrong:
        raise InputError(f"by: {wrong}") from None
    return _by_cells(record, name, cells, GroupOptions(bins=bins), "by")


# --- a table of its own -------------------------------------------------------------------------------


def _sheet(options: GroupOptions) -> TableRows:
    """The table of ``--by-file``, with the column and what it is looked up by.

    Raises
    ------
    InputError
        It lacks one of them.
    """
    from consistency.referee.readers.formats.sheet import read_sheet
    from consistency.referee.readers.formats.table_columns import with_clock

    assert options.by is not None
    assert options.by_file is not None
    sheet = with_clock(read_sheet(options.by_file), required=False)
    if options.by not in sheet:
        raise InputError(f"--by {options.by}: {options.by_file} has no such column; there are: {sheet.columns}")
    if "t" not in sheet and "run" not in sheet:
        raise InputError(f"{options.by_file}: column 't' or 'run' is missing; there are: {sheet.columns}")
    return sheet


def _looked_up(sheet: TableRows, name: str, run: int, t: Array) -> Array:
    """Cells of a column for the rows of a run at times ``t`` (N,), s: the last one at or before each."""
    rows = np.arange(len(sheet))
    if "run" in sheet:
        rows = np.flatnonzero(sheet.numbers("run", whole=True) == run)
        if not len(rows):
            raise InputError(f"{sheet.path}: holds no run {run}")
    cells = sheet.data[name][rows]
    if "t" not in sheet:
        if len(rows) > 1:
            where = sheet.place(int(rows[1]))
            raise InputError(f"{where}: run {run} has several rows; they need a column t")
        return np.repeat(cells, len(t))
    if np.isnan(t).any():
        raise InputError(f"--by-file {sheet.path}: the estimates have no times at which to look up its column t")
    times = sheet.numbers("t", finite=True)[rows]
    order = np.argsort(times, kind="stable")
    place = np.searchsorted(times[order], t + ROUNDING, side="right") - 1
    found = cells[order][np.maximum(place, 0)]
    found[place < 0] = np.nan if cells.dtype.kind == "f" else None
    return np.asarray(found)
