"""Files of other estimators, read as errors and covariances; docs/files.md describes the formats.

Filters, scenarios and results folders of this package do not belong here.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

from consistency.referee.diagnostics.records.record import Record
from consistency.referee.errors import InputError
from consistency.referee.geometry.conventions import INERTIAL, PLANAR, SPATIAL
from consistency.referee.readers.declared_axes import in_axes_of_estimates
from consistency.referee.readers.formats.file_kinds import (
    TRAJECTORIES,
    fitted_note,
    is_bag,
    is_drive,
    table_files,
    trajectory_files,
)
from consistency.referee.readers.options import Reading, flag_of
from consistency.referee.readers.pipeline.by_column import grouped, of_record
from consistency.referee.readers.pipeline.kinds import (
    OF_BAGS,
    OF_TRAJECTORIES,
    Found,
    found_in,
    is_program_runs,
    refuse_options,
)
from consistency.referee.readers.pipeline.records import OF_WINDOWS, records_of, windows_asked
from consistency.referee.readers.runs_to_record import with_failed_runs
from consistency.referee.readers.truth_matching import Estimator

CONVENTIONS = tuple(dict.fromkeys((*PLANAR, *INERTIAL)))
ALIGNMENTS = ("none", "origin", "posyaw", "posyaw-all", "se3", "se3-all")
GUESS = "guess"  # judge every convention
NO_GUESS = {
    "truth_covariance": ", whose covariance is of a declared error too",
    "relative": ", which judges motions in one error; name the conventions one by one",
}
OF_TRUTH = ("truth_covariance", "truth_errors", "truth_shared")


def is_recording(path: Path, reading: Reading) -> bool:
    """Whether a path is something :func:`read_recordings` reads, and not a folder of ``consistency run``.

    Raises
    ------
    InputError
        The path is a results folder, with an option for other files; or a folder of neither kind.
    """
    given = reading.given()
    if is_program_runs(path):
        return True
    if path.is_dir() and not (path / "manifest.json").exists():
        recording = bool(trajectory_files(path) or table_files(path)) or is_bag(path) or bool(given)
        if not recording:
            known = f"trajectories ({', '.join(TRAJECTORIES)}), tables or ROS bags"
            raise InputError(f"{path}: holds no results of 'consistency run', and no {known}")
    else:
        recording = not path.is_dir() and (path.exists() or path.suffix != "")
    if not recording and path.exists() and given:
        raise InputError(f"{flag_of(given[0])}: does not go with {path}, a folder of 'consistency run'")
    return recording


def read_frames(estimates: Any, truth: Any, reading: Reading) -> list[Record]:
    """Tables in memory, with columns by name: one record for each estimator.

    Parameters
    ----------
    estimates : a DataFrame, or anything with ``columns`` that gives a column by its name
    truth : of the same kind, or a path; None without truth

    Raises
    ------
    InputError
        As :func:`read_recordings`; the tables are called "estimates" and "truth".
    """
    from consistency.referee.readers.formats.sheet import frame_rows
    from consistency.referee.readers.formats.table import read_tables

    def rows(table: Any, name: str) -> Any:
        if hasattr(table, "columns"):
            return frame_rows(table, name)
        return None if table is None else Path(table)

    sheet, true = rows(estimates, "estimates"), rows(truth, "truth")
    r = checked_options(replace(reading, truth=cast(Any, true)))
    refuse_options(Path("tables in memory"), r, *OF_TRAJECTORIES, *OF_BAGS)
    return _read("tables", r, lambda options: _records(read_tables(sheet, options), options))


def read_recordings(estimates: Path, reading: Reading | None = None) -> list[Record]:
    """Read CSV, Parquet, TUM or NumPy files, or ROS bags: one record for each estimator.

    Parameters
    ----------
    estimates : .csv, .parquet, .npz, .bag, or a TUM trajectory, or a folder of these with one for each run

    Raises
    ------
    InputError
        Something cannot be used: names file, line, column or option, and what is allowed.
    """
    r = reading or Reading()
    if is_program_runs(estimates):
        from consistency.referee.readers.pipeline.program_runs import study_in, with_options

        r = with_options(study_in(estimates), r)
    return _read(str(estimates), checked_options(r), lambda r: _by_kind(estimates, r))


def _read(name: str, r: Reading, read: Callable[[Reading], list[Record]]) -> list[Record]:
    """Records under the declared convention, or under each, with what else is declared of them."""

    def under(convention: str | None) -> list[Record]:
        return _declared(read(replace(r, error=convention)), r)

    return _guessed(name, r, under) if r.error == GUESS else under(r.error)


def _guessed(name: str, r: Reading, read: Callable[[str | None], list[Record]]) -> list[Record]:
    """Records with the same runs under each convention that such poses have, the default of the files first.

    Parameters
    ----------
    read : records under a convention, or under the default
    """
    r.refuse(f"--error {GUESS}", NO_GUESS)
    first = read(None)
    default = first[0].convention
    if default not in (*PLANAR, *SPATIAL) or default == "vector":
        raise InputError(f"--error {GUESS}: is for poses; the errors of {name} are plain differences")
    kinds = [kind for kind in (SPATIAL if default in SPATIAL else PLANAR) if kind not in (default, "vector")]
    others = {kind: {one.name: one for one in read(kind)} for kind in kinds}
    return [replace(one, guesses={default: one} | {kind: others[kind][one.name] for kind in kinds}) for one in first]


def _declared(records: list[Record], r: Reading) -> list[Record]:
    """Records with what is declared of their truth, in pieces where that is asked."""
    if r.given(OF_TRUTH) or any(record.truth_covariance is not None for record in records):
        from consistency.referee.readers.truth_covariance import declared

        records = declared(records, r)
    pieces = pieces_asked(r)
    if pieces is None:
        return records
    from consistency.referee.diagnostics.planning.single_log import in_pieces

    return [in_pieces(record, pieces or None) for record in records]


def records_of_found(found: Found, r: Reading) -> list[Record]:
    """Records of what readers gave, with what the options declare of their truth."""
    return _declared(_records(found, r), r)


def _records(found: Found, r: Reading) -> list[Record]:
    """Records of what a reader gives."""
    records: list[Record] = []
    for one in found:
        if isinstance(one, Estimator):
            records += [
                replace(with_failed_runs(record, one.failed), trials=one.trials)
                for record in records_of(in_axes_of_estimates(one, r), r)
            ]
        else:
            records.append(grouped(*of_record(one, r), r))
    return records


def _by_kind(estimates: Path, r: Reading) -> list[Record]:
    records = _records(found_in(estimates, r), r)
    for path in filter(None, (estimates, r.covariance)):
        if note := fitted_note(path):
            records = [replace(records[0], notes=(note, *records[0].notes)), *records[1:]]
    if r.truth is None or not is_drive(r.truth):
        return records
    of = f"the truth is the path of the {r.body or 'imu'} as its first pose sees it, t in s from the first packet"
    return [replace(records[0], notes=(f"{r.truth}: {of}", *records[0].notes)), *records[1:]]


def pieces_asked(r: Reading) -> int | None:
    """Number of pieces of ``--split``, 0 for the advised one; None without the option.

    Raises
    ------
    InputError
        It is not a number of pieces, or another option makes runs of the log.
    """
    if r.split is None:
        return None
    r.refuse("--split", dict.fromkeys(OF_WINDOWS, ", which cuts the log into windows"))
    if r.align not in (None, "none"):
        raise InputError(f"--split: does not go with --align {r.align}: all pieces would share the error of one frame")
    if r.split == "auto":
        return 0
    if not str(r.split).isdecimal() or int(r.split) < 1:
        raise InputError(f"--split {r.split}: must be a number of pieces, or 'auto'")
    return int(r.split)


def checked_options(r: Reading) -> Reading:
    """Options that go together, whatever the file; numbers are floats, and no alignment is None."""
    windows_asked(r)
    if r.error not in (None, GUESS, *CONVENTIONS):
        raise InputError(f"--error {r.error}: must be one of {', '.join((*CONVENTIONS, GUESS))}")
    if r.max_dt is not None and not (math.isfinite(r.max_dt) and r.max_dt >= 0):
        raise InputError(f"--max-dt {r.max_dt:g}: must be 0 or more, in s")
    if r.lever_arm is not None and not (len(r.lever_arm) == 3 and all(map(math.isfinite, r.lever_arm))):
        raise InputError("--lever-arm: must be three numbers x,y,z, in m")
    offset = r.time_offset
    if isinstance(offset, int):
        offset = float(offset)
    if offset not in (None, "estimate") and not (isinstance(offset, float) and math.isfinite(offset)):
        raise InputError(f"--time-offset {offset}: must be a number of seconds, or 'estimate'")
    if offset is not None and r.truth is None and r.truth_topic is None:
        raise InputError("--time-offset needs --truth: without truth there are no clocks to compare")
    if r.relative is not None and offset == "estimate":
        raise InputError("--time-offset estimate: needs poses in one world; with --relative give seconds")
    if r.given(OF_TRUTH):
        from consistency.referee.readers.truth_covariance import require_truth_options

        require_truth_options(r)
    for name in ("by_file", "bins"):
        if r.given([name]) and r.by is None:
            raise InputError(f"{flag_of(name)}: goes with --by COLUMN")
    if r.align not in (None, *ALIGNMENTS):
        raise InputError(f"--align {r.align}: must be one of {', '.join(ALIGNMENTS)}")
    align = None if r.align == "none" else r.align
    if align is not None and (r.truth or r.truth_topic) is None:
        raise InputError(f"--align {align} needs --truth, with which the estimates are aligned")
    if r.relative is not None and align is not None:
        raise InputError(f"--align {align}: does not go with --relative, which needs no common world; leave it out")
    pieces_asked(r)  # refused before anything is read
    return replace(r, time_offset=offset, align=align)
