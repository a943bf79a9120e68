"""The innovations of one run: NIS and degrees of freedom from a table, an archive, or lines as they come."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from consistency.referee.errors import InputError
from consistency.referee.parsing import MOST_DOF, require_name
from consistency.referee.readers.formats.archives import Archive, load_arrays
from consistency.referee.readers.formats.file_kinds import ARCHIVES, TABLES, unknown_kind
from consistency.referee.readers.formats.sheet import DOF_NEEDED, CsvTable, TableRows, checked_dof, read_sheet
from consistency.referee.readers.formats.table_columns import row_order, with_clock, with_nis
from consistency.referee.readers.formats.text_blocks import bounded
from consistency.referee.readers.options import Reading
from consistency.referee.readers.places import listed
from consistency.referee.types import Array

DEFAULT = Reading()
NEEDED = ("nis", "nis_dof")
WAYS = "needed are nis and nis_dof, or innovation and innovation_variance"


@dataclass(frozen=True)
class NisLog:
    """NIS and degrees of freedom of the innovations of one run."""

    name: str
    step: Array  # (N,), as the file numbers them
    t: Array  # (N,), s; NaN where not given
    nis: Array  # (N,), NaN where there is none
    dof: Array  # (N,), whole numbers of 0 or more
    notes: tuple[str, ...] = ()  # what a reader must know: what was left out


def numbered_log(name: str, t: Array, nis: Array, dof: Array, notes: Iterable[str] = ()) -> NisLog:
    """A log whose steps are numbered from 1."""
    return NisLog(name, np.arange(1.0, len(nis) + 1), t, nis, dof, tuple(notes))


def read_nis(path: Path, filter_name: str | None = None, run: int | None = None, r: Reading = DEFAULT) -> NisLog:
    """Columns ``nis`` and ``nis_dof`` of a .csv, .parquet or .npz file; ``step``, ``t``, ``run``, ``filter`` if there.

    Parameters
    ----------
    filter_name, run : which one, where the file holds several; the runs of an archive are its rows, from 0
    r : of a table, ``columns`` in place of its own, and ``dof`` of each NIS where no column states them

    Raises
    ------
    InputError
        Something cannot be used: names file, column and line, and what is allowed.
    """
    suffix = path.suffix.lower()
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    require_name(path.name, "file")
    if suffix not in (*TABLES, *ARCHIVES):
        raise unknown_kind(path, (*TABLES, *ARCHIVES, ".ulg", ".bin"), "nis=nis, nis_dof=dof")
    if suffix in ARCHIVES:
        if filter_name is not None:
            raise InputError(f"--filter {filter_name}: does not go with {path}")
        refuse_options(path, r)
        return _of_archive(path, run)
    sheet, note = with_nis(read_sheet(path, r.components.columns), r.statement.dof)
    _require_columns(path, list(sheet.data))
    sheet = _of_one(_of_one(sheet, "filter", filter_name), "run", run)
    return _of_table(sheet, note)


def refuse_options(path: Path, r: Reading) -> None:
    """Refuse the options of tables."""
    for option in r.given(("columns", "dof")):
        raise InputError(f"--{option}: goes with tables, not with {path}")


class SeveralError(InputError):
    """Refusal of a file with several items of which one has to be chosen."""

    def __init__(self, path: Path, option: str, there: Sequence[Any], what: str) -> None:
        super().__init__(f"{path}: holds more than one {what} ({listed(there)}); choose with --{option}")
        self.option = option
        self.there = there
        self.what = what


def choose(path: Path, option: str, there: list[Any], choice: Any, what: str = "") -> Any:
    """The wanted item, or the only one; ``what`` describes the items in messages, if the option's name does not.

    Raises
    ------
    InputError
        The item is missing, or there are several and none is named.
    """
    if choice is None and len(there) == 1:
        return there[0]
    if choice is None:
        raise SeveralError(path, option, there, what or option)
    if choice not in there:
        raise InputError(f"--{option} {choice}: is not in {path}; there are: {listed(there)}")
    return choice


def _require_columns(place: Path | str, columns: Sequence[str]) -> None:
    for needed in NEEDED:
        if needed not in columns:
            raise InputError(f"{place}: '{needed}' is missing; {WAYS}, there are: {listed(columns, 12)}; --columns "
                             f"{needed}=NAME says what it is called")  # fmt: skip


def _of_table(sheet: TableRows, note: str) -> NisLog:
    """The innovations of one run of one filter, in the order of their steps or times."""
    for key in ("step", "t"):
        if key in sheet:
            sheet = sheet.rows(row_order(sheet, np.zeros(len(sheet), int), key))
            break
    sheet = with_clock(sheet, required=False)
    nis = sheet.numbers("nis")
    dof = checked_dof(nis, sheet.numbers("nis_dof"), sheet.place)
    name = sheet.path.stem
    step = np.arange(1.0, len(nis) + 1)
    t = np.full(len(nis), np.nan)
    if "filter" in sheet:
        name = str(sheet.data["filter"][0])
    if "step" in sheet:
        step = sheet.numbers("step")
    if "t" in sheet:
        t = sheet.numbers("t")
    return NisLog(name, step, t, nis, dof, tuple(filter(None, [sheet.cut, note])))


def _of_one(sheet: TableRows, column: str, choice: str | int | None) -> TableRows:
    if column not in sheet:
        if choice is not None:
            raise InputError(f"--{column} {choice}: {sheet.path} has no column '{column}'")
        return sheet
    values = sheet.texts(column)
    if column != "filter":
        values = sheet.numbers(column, whole=True).astype(int)
    there = list(dict.fromkeys(values.tolist()))
    return sheet.rows(values == choose(sheet.path, column, there, choice))


def _of_archive(path: Path, run: int | None) -> NisLog:
    arrays = _with_nis(path, load_arrays(path, "nis and nis_dof"))
    _require_columns(path, list(arrays))
    archive = Archive(path, arrays)
    for key in NEEDED:
        archive.require_numbers(key)
    nis = np.atleast_2d(bounded(np.asarray(arrays["nis"], float)))
    if nis.ndim != 2 or not nis.size:
        raise InputError(f"{path}: key 'nis' has shape {nis.shape}, needs (steps,) or (runs, steps)")
    dof = archive.whole_numbers("nis_dof", nis.shape)
    row = choose(path, "run", list(range(len(nis))), run)
    steps = archive.lengths(*nis.shape)[row]
    own = nis[row, :steps]
    t = archive.times(nis.shape[1])[:steps]
    dof = checked_dof(own, dof[row, :steps], lambda k: f"{path}, run {row}, step {k + 1}")
    return numbered_log(path.stem, t, own, dof)


def _with_nis(path: Path, arrays: dict[str, Array]) -> dict[str, Array]:
    """The arrays with the NIS of innovations and their covariances, where they hold these in its place."""
    keys = ("innovations", "innovation_covariances")
    if "nis" in arrays or not set(keys) <= set(arrays):
        return arrays
    from consistency.referee.diagnostics.whiteness import nis_of

    v, S = (arrays[key] for key in keys)
    are_numbers = v.dtype.kind in "fiu" and S.dtype.kind in "fiu"
    if not are_numbers or v.ndim < 2 or S.shape != (*v.shape, v.shape[-1]):
        raise InputError(
            f"{path}: keys 'innovations' {v.shape} and 'innovation_covariances' {S.shape} must be numbers of shape "
            "(steps, m) and (steps, m, m), with runs before them where there are several"
        )
    nis, dof = nis_of(np.asarray(v, float), np.asarray(S, float))
    indefinite = np.isfinite(v).all(axis=-1) & np.isnan(nis)
    if indefinite.any():
        place = "runs and steps, from 0" if v.ndim > 2 else "step, from 0"
        at = np.argwhere(indefinite)[0].tolist()
        raise InputError(f"{path}: key 'innovation_covariances' is not positive definite at {at} ({place})")
    return arrays | {"nis": nis, "nis_dof": dof}


def stream_nis(lines: Iterable[str], name: str, r: Reading = DEFAULT) -> Iterator[tuple[str, float, float]]:
    """Place, NIS and degrees of freedom from the lines of a CSV file of one run, each as it comes.

    Raises
    ------
    InputError
        The header lacks a column, or a line cannot be used.
    """
    table = CsvTable(Path(name))
    for number, line in enumerate(lines, 1):
        text = line.lstrip("\ufeff").strip()
        if not text or text.startswith("#"):
            continue
        fields = table.row(number, text)
        if fields is None:
            empty = TableRows(table.path, dict.fromkeys(table.names, np.empty(0)), np.empty(0, int), "line")
            empty, _ = with_nis(empty.renamed(r.components.columns), r.statement.dof)
            _require_columns(name, list(empty.data))
            for several in empty.among(("run", "filter")):
                raise InputError(f"{name}: column '{several}': lines as they come must be of one run of one filter")
            continue
        row = TableRows(table.path, table.part([fields], [number]), np.array([number]), "line")
        row, _ = with_nis(row.renamed(r.components.columns), r.statement.dof)
        nis = float(row.numbers("nis")[0])
        dof = float(row.numbers("nis_dof")[0])
        if dof >= MOST_DOF:
            raise InputError(f"{row.place(0)}: nis_dof must be {DOF_NEEDED}, got {dof:g}")
        if np.isnan(nis) and np.isnan(dof):
            dof = 0.0
        yield row.place(0), nis, dof
    if not table.names:
        raise InputError(f"{name}: is empty; its first line must name the columns, nis and nis_dof among them")
