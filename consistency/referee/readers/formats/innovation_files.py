"""The innovations of one run: NIS and degrees of freedom from a table, an archive, or lines as they come."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from consistency.referee.errors import InputError
from consistency.referee.parsing import MOST_DOF, one_line, require_name
from consistency.referee.readers.formats.file_kinds import ARCHIVES, TABLES, unknown_kind
from consistency.referee.readers.formats.numpy_archive import load_arrays, run_lengths, step_times, whole_numbers
from consistency.referee.readers.formats.other_names import with_clock
from consistency.referee.readers.formats.sheet import TableRows, are_dof, bounded, read_sheet
from consistency.referee.readers.formats.table_columns import row_order
from consistency.referee.readers.places import listed, refuse
from consistency.referee.types import Array

NEEDED = ("nis", "nis_dof")


@dataclass(frozen=True)
class NisLog:
    """NIS and degrees of freedom of the innovations of one run."""

    name: str
    step: Array  # (N,), as the file numbers them
    t: Array  # (N,), s; NaN where not given
    nis: Array  # (N,), NaN where there is none
    dof: Array  # (N,), whole numbers of 0 or more
    notes: tuple[str, ...] = ()  # what a reader must know: what was left out


def read_nis(path: Path, filter_name: str | None = None, run: int | None = None) -> NisLog:
    """Columns ``nis`` and ``nis_dof`` of a .csv, .parquet or .npz file; ``step``, ``t``, ``run``, ``filter`` if there.

    Parameters
    ----------
    filter_name, run : which one, where the file holds several; the runs of an archive are its rows, from 0

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
        return _of_archive(path, run)
    sheet = read_sheet(path)
    _require_columns(str(path), list(sheet.data))
    sheet = _of_one(_of_one(sheet, "filter", filter_name), "run", run)
    key = next((column for column in ("step", "t") if column in sheet), None)
    if key is not None:
        sheet = sheet.rows(row_order(sheet, np.zeros(len(sheet), int), key))
    sheet = with_clock(sheet, required=False)
    nis = sheet.numbers("nis")
    dof = checked_dof(nis, sheet.numbers("nis_dof"), sheet.place)
    name, step, t = path.stem, np.arange(1.0, len(nis) + 1), np.full(len(nis), np.nan)
    if "filter" in sheet:
        name = str(sheet.data["filter"][0])
    if "step" in sheet:
        step = sheet.numbers("step")
    if "t" in sheet:
        t = sheet.numbers("t")
    return NisLog(name, step, t, nis, dof, tuple(filter(None, [sheet.cut])))


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
        raise InputError(f"{path}: holds more than one {what or option} ({listed(there)}); choose with --{option}")
    if choice not in there:
        raise InputError(f"--{option} {choice}: is not in {path}; there are: {listed(there)}")
    return choice


def checked_dof(nis: Array, dof: Array, place: Callable[[int], str]) -> Array:
    """Degrees of freedom (N,), 0 where neither they nor a NIS is given.

    Raises
    ------
    InputError
        A NIS is negative or infinite, or its degrees of freedom are not a whole number of 0 or more.
    """
    dof = np.where(np.isnan(nis) & np.isnan(dof), 0.0, dof)
    bad = (nis < 0) | np.isinf(nis) | ~are_dof(dof)
    needed = "nis must be 0 or more and finite, nis_dof a whole number from 0 to below 2^31"
    refuse(bad, place, lambda row: f"nis {nis[row]:g} with nis_dof {dof[row]:g}; {needed}")
    return dof


def _require_columns(place: str, columns: list[str]) -> None:
    missing = [column for column in NEEDED if column not in columns]
    if missing:
        raise InputError(
            f"{place}: '{missing[0]}' is missing; needed are nis and nis_dof, there are: {', '.join(columns[:12])}"
        )


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
    _require_columns(str(path), list(arrays))
    for key in NEEDED:
        if arrays[key].dtype.kind not in "fiu":
            raise InputError(f"{path}: key '{key}' holds {arrays[key].dtype}, not numbers")
    nis = np.atleast_2d(bounded(np.asarray(arrays["nis"], float)))
    if nis.ndim != 2 or not nis.size:
        raise InputError(f"{path}: key 'nis' has shape {nis.shape}, needs (steps,) or (runs, steps)")
    dof = whole_numbers(path, arrays, "nis_dof", nis.shape)
    row = choose(path, "run", list(range(len(nis))), run)
    steps = run_lengths(path, arrays, *nis.shape)[row]
    t = step_times(path, arrays, nis.shape[1])[:steps]
    own = nis[row, :steps]
    dof = checked_dof(own, dof[row, :steps], lambda k: f"{path}, run {row}, step {k + 1}")
    return NisLog(path.stem, np.arange(1.0, steps + 1), t, own, dof)


def _with_nis(path: Path, arrays: dict[str, Array]) -> dict[str, Array]:
    """The arrays with the NIS of innovations and their covariances, where they hold these in its place."""
    keys = ("innovations", "innovation_covariances")
    if "nis" in arrays or not set(keys) <= set(arrays):
        return arrays
    from consistency.referee.diagnostics.questions.innovations import nis_of

    v, S = (arrays[key] for key in keys)
    if v.dtype.kind not in "fiu" or S.dtype.kind not in "fiu" or v.ndim < 2 or S.shape != (*v.shape, v.shape[-1]):
        raise InputError(
            f"{path}: keys 'innovations' {v.shape} and 'innovation_covariances' {S.shape} must be numbers of shape "
            "(steps, m) and (steps, m, m), with runs before them where there are several"
        )
    known = np.isfinite(v).all(axis=-1)
    nis, dof = nis_of(np.asarray(v, float), np.asarray(S, float))
    place = "runs and steps, from 0" if v.ndim > 2 else "step, from 0"
    if bad := np.argwhere(known & np.isnan(nis)).tolist():
        raise InputError(f"{path}: key 'innovation_covariances' is not positive definite at {bad[0]} ({place})")
    return arrays | {"nis": nis, "nis_dof": dof}


def stream_nis(lines: Iterable[str], name: str) -> Iterator[tuple[str, float, float]]:
    """Place, NIS and degrees of freedom from the lines of a CSV file of one run, each as it comes.

    Raises
    ------
    InputError
        The header lacks a column, or a line cannot be used.
    """
    columns: list[str] = []
    separator = ","
    for number, line in enumerate(lines, 1):
        text = line.lstrip("\ufeff").strip()
        if not text or text.startswith("#"):
            continue
        if not columns:
            separator = max(",;\t", key=text.count)
            columns = [column.strip().strip('"') for column in text.split(separator)]
            _require_columns(name, columns)
            several = [column for column in ("run", "filter") if column in columns]
            if several:
                raise InputError(f"{name}: column '{several[0]}': lines as they come must be of one run of one filter")
            continue
        fields = text.split(separator)
        place = f"{name}, line {number}"
        if len(fields) != len(columns):
            raise InputError(f"{place}: has {len(fields)} columns, the header has {len(columns)}")
        row = dict(zip(columns, fields, strict=True))
        nis, dof = (_number(place, key, row[key].strip()) for key in NEEDED)
        if dof >= MOST_DOF:
            raise InputError(f"{place}: nis_dof must be a whole number from 0 to below 2^31, got {dof:g}")
        yield place, nis, 0.0 if nis != nis and dof != dof else dof
    if not columns:
        raise InputError(f"{name}: is empty; its first line must name the columns, nis and nis_dof among them")


def _number(place: str, column: str, text: str) -> float:
    try:
        return float(bounded(np.array(float(text) if text else np.nan)))
    except ValueError:
        raise InputError(f"{place}: column '{column}': not a number ({one_line(text, 60)})") from None
