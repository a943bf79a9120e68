"""Files of other estimators, read as errors and covariances; docs/files.md describes the formats.

Filters, scenarios and results folders of this package do not belong here.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from consistency.referee.diagnostics import Evidence
from consistency.referee.errors import InputError
from consistency.referee.extras import function_at
from consistency.referee.geometry.conventions import INERTIAL, PLANAR, SPATIAL
from consistency.referee.parsing import require_name
from consistency.referee.readers.formats.file_kinds import (
    ARCHIVES,
    OF_BAGS,
    OF_TRAJECTORIES,
    TRAJECTORIES,
    is_bag,
    is_drive,
    is_foreign,
    kind_of,
    trajectory_files,
    unknown_kind,
)
from consistency.referee.readers.formats.text_blocks import is_cut, without_end
from consistency.referee.readers.options import Reading, flag_of

if TYPE_CHECKING:
    from consistency.referee.readers.windows import Relative

CONVENTIONS = tuple(dict.fromkeys((*PLANAR, *INERTIAL)))
ALIGNMENTS = ("none", "origin", "posyaw", "posyaw-all", "se3", "se3-all")
GUESS = "guess"  # judge every convention
NO_GUESS = {
    "truth_covariance": ", whose covariance is of a declared error too",
    "shared": ", which is fitted to a declared error",
    "relative": ", which judges motions in one error; name the conventions one by one",
}
OF_TRUTH = ("truth_covariance", "truth_errors", "truth_shared")
OF_SHARED = ("shared", "shared_from", "shared_truth")
OF_WINDOWS = ("relative", "motions", "windows")


def is_recording(path: Path, reading: Reading) -> bool:
    """Whether a path is something :func:`read_recordings` reads, and not a folder of ``consistency run``.

    Raises
    ------
    InputError
        The path is a results folder, with an option for other files; or a folder of neither kind.
    """
    given = reading.given()
    if path.is_dir() and not (path / "manifest.json").exists():
        recording = bool(trajectory_files(path)) or is_bag(path) or bool(given)
        if not recording:
            known = f"trajectories ({', '.join(TRAJECTORIES)}) or ROS bags"
            raise InputError(f"{path}: holds no results of 'consistency run', and no {known}")
    else:
        recording = not path.is_dir() and (path.exists() or path.suffix != "")
    if not recording and path.exists() and given:
        raise InputError(f"{flag_of(given[0])}: does not go with {path}, a folder of 'consistency run'")
    return recording


def read_frames(estimates: Any, truth: Any, reading: Reading) -> list[Evidence]:
    """Tables in memory, with columns by name: one recording for each estimator.

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

    over = _windows(reading)
    sheet = frame_rows(estimates, "estimates") if hasattr(estimates, "columns") else Path(estimates)
    true = frame_rows(truth, "truth") if hasattr(truth, "columns") else truth if truth is None else Path(truth)
    r = _checked(replace(reading, truth=cast(Any, true)), over)
    _refuse(Path("tables in memory"), r, *OF_TRAJECTORIES, *OF_BAGS)
    return _asked("tables", r, over, lambda kind: read_tables(sheet, replace(r, error=kind), over))


def read_recordings(estimates: Path, reading: Reading | None = None) -> list[Evidence]:
    """Read CSV, Parquet, TUM or NumPy files, or ROS bags: one recording for each estimator.

    Parameters
    ----------
    estimates : .csv, .parquet, .npz, .bag, or a TUM trajectory, or a folder of these with one for each run

    Raises
    ------
    InputError
        Something cannot be used: names file, line, column or option, and what is allowed.
    """
    cut: dict[Path, str] = {}
    refusal: InputError | None = None
    while True:
        try:
            with without_end(frozenset(cut)):
                found = _read(estimates, reading or Reading())
            end = next((end for one in found for failure in one.failures if (end := _cut_by(failure.reason))), None)
            if end is None or end[0] in cut:
                return [replace(found[0], notes=(*cut.values(), *found[0].notes)), *found[1:]] if cut else found
        except InputError as error:
            refusal, end = refusal or error, _cut_at(str(error))
            if end is None or end[0] in cut:
                raise refusal from None
        cut[end[0]] = f"{end[0]}: the last line, {end[1]}, has no end and is left out; it seems to be cut short"


def _cut_at(message: str) -> tuple[Path, int] | None:
    """The file and the line of a refusal, if it is a last line that has no end."""
    found = re.match(r"(.+?), line (\d+): ", message)
    return (Path(found[1]), int(found[2])) if found and is_cut(Path(found[1]), int(found[2])) else None


def _cut_by(reason: str) -> tuple[Path, int] | None:
    """The same of a failure, unless it was written as such: NaN stays a failure."""
    found = re.search(r"\((.+), line (\d+)\)$", reason)
    if not found or "not finite" in reason:
        return None
    return _cut_at(f"{found[1]}, line {found[2]}: ")


def _read(estimates: Path, r: Reading) -> list[Evidence]:
    over = _windows(r)
    r = _checked(r, over)
    return _asked(str(estimates), r, over, lambda kind: _by_kind(estimates, replace(r, error=kind), over))


def guessed(name: str, r: Reading, read: Callable[[str | None], list[Evidence]]) -> list[Evidence]:
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


def _windows(r: Reading) -> Relative | None:
    """Windows that are judged in place of poses."""
    if not r.given(OF_WINDOWS):
        return None
    from consistency.referee.readers.windows import relative_of

    return relative_of(r.relative, bool(r.motions), r.windows)


def _asked(
    name: str, r: Reading, over: Relative | None, read: Callable[[str | None], list[Evidence]]
) -> list[Evidence]:
    """Records of what is read under a convention, or under each."""
    if r.error == GUESS:
        return guessed(name, r, lambda kind: _declared(read(kind), r, over))
    return _declared(read(r.error), r, over)


def _declared(records: list[Evidence], r: Reading, over: Relative | None) -> list[Evidence]:
    """Records with what is declared of their truth, in pieces or without what all share where that is asked."""
    pieces = pieces_asked(r)
    if r.given(OF_TRUTH) or any(record.truth_covariance is not None for record in records):
        from consistency.referee.readers.truth_covariance import declared

        records = declared(records, r)
    if r.shared is not None:
        from consistency.referee.readers.shared_calibration import less_shared, other_drives

        others = None if r.shared_from is None else _by_kind(r.shared_from, other_drives(r), over)
        return less_shared(records, others, r.shared)
    if pieces is None:
        return records
    from consistency.referee.diagnostics.planning.single_log import in_pieces

    return [in_pieces(record, pieces or None) for record in records]


def _by_kind(estimates: Path, r: Reading, over: Relative | None) -> list[Evidence]:
    if not estimates.exists():
        raise InputError(f"{estimates}: no such file")
    require_name(estimates.name, "file")
    if r.body is not None and not (r.truth is not None and is_drive(r.truth)):
        raise InputError(f"--body {r.body}: goes with --truth DIR, the folder of a KITTI drive")
    kind = kind_of(estimates, r)
    _refuse(estimates, r, *(OF_BAGS if kind is None else kind.refused))
    if kind is None:
        raise unknown_kind(estimates)
    if r.truth is not None and is_foreign(r.truth):
        raise unknown_kind(r.truth)
    records: list[Evidence] = function_at(kind.records)(estimates, r, over)
    if r.truth is None or not is_drive(r.truth):
        return records
    of = f"the truth is the path of the {r.body or 'imu'} as its first pose sees it, t in s from the first packet"
    return [replace(records[0], notes=(f"{r.truth}: {of}", *records[0].notes)), *records[1:]]


def pieces_asked(r: Reading) -> int | None:
    """Number of pieces of ``--split``, 0 for the advised one; None without the option.

    Raises
    ------
    InputError
        It is no number of pieces, or another option makes runs of the log.
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


def _checked(r: Reading, over: Relative | None) -> Reading:
    """Options that go together, whatever the file; numbers are floats, and no alignment is None."""
    if r.error not in (None, GUESS, *CONVENTIONS):
        raise InputError(f"--error {r.error}: must be one of {', '.join((*CONVENTIONS, GUESS))}")
    if r.max_dt is not None and not (math.isfinite(r.max_dt) and r.max_dt >= 0):
        raise InputError(f"--max-dt {r.max_dt:g}: must be 0 or more, in s")
    if r.lever_arm is not None and not (len(r.lever_arm) == 3 and all(map(math.isfinite, r.lever_arm))):
        raise InputError("--lever-arm: must be three numbers x,y,z, in m")
    offset = float(r.time_offset) if isinstance(r.time_offset, int) else r.time_offset
    if offset not in (None, "estimate") and not (isinstance(offset, float) and math.isfinite(offset)):
        raise InputError(f"--time-offset {offset}: must be a number of seconds, or 'estimate'")
    if offset is not None and r.truth is None and r.truth_topic is None:
        raise InputError("--time-offset needs --truth: without truth there are no clocks to compare")
    if over is not None and offset == "estimate":
        raise InputError("--time-offset estimate: needs poses in one world; with --relative give seconds")
    if r.given(OF_TRUTH):
        from consistency.referee.readers.truth_covariance import require_truth_options

        require_truth_options(r)
    if r.given(OF_SHARED):
        from consistency.referee.readers.shared_calibration import require_shared_options

        require_shared_options(r)
    if r.align not in (None, *ALIGNMENTS):
        raise InputError(f"--align {r.align}: must be one of {', '.join(ALIGNMENTS)}")
    align = None if r.align == "none" else r.align
    if align is not None and (r.truth or r.truth_topic) is None:
        raise InputError(f"--align {align} needs --truth, with which the estimates are aligned")
    if over is not None and align is not None:
        raise InputError(f"--align {align}: does not go with --relative, which needs no common world; leave it out")
    pieces_asked(r)  # refused before anything is read
    return replace(r, time_offset=offset, align=align)


def _refuse(path: Path, r: Reading, *names: str) -> None:
    if given := r.given(names):
        keys = {"truth": "truth", "axes": "axes", "truth_covariance": "truth_covariances"}
        kept = path.suffix.lower() in ARCHIVES and given[0] in keys
        instead = f", an archive; it has a key '{keys[given[0]]}' in its place" if kept else ""
        raise InputError(f"{flag_of(given[0])}: does not go with {path}{instead}")
