"""Files of other estimators, read as errors and covariances; docs/files.md describes the formats.

Each kind of files has a row in ``KINDS``: how one is told, options that do not go with it, and its reader, which is
loaded when a file of its kind is read. Filters, scenarios and results folders of this package do not belong here.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple, cast

from consistency.referee.diagnostics.record import Record
from consistency.referee.errors import InputError
from consistency.referee.geometry import CHARTS, INERTIAL, PLANAR, SPATIAL
from consistency.referee.parsing import is_file, read_json, require_name
from consistency.referee.readers.formats.columns import columns_of_axes
from consistency.referee.readers.formats.file_kinds import (
    ARCHIVES,
    TABLES,
    TRAJECTORIES,
    fitted_note,
    is_bag,
    is_drive,
    is_foreign,
    is_plane,
    is_spatial,
    table_files,
    trajectory_files,
    unknown_kind,
)
from consistency.referee.readers.options import GROUPED, OF_AXES, Reading, flag_of
from consistency.referee.readers.options import MODES as ALIGNMENTS
from consistency.referee.readers.pipeline.records import OF_WINDOWS, records_of, windows_asked
from consistency.referee.readers.runs_to_record import with_failed_runs
from consistency.referee.readers.truth_matching import Estimator

CONVENTIONS = tuple(dict.fromkeys((*PLANAR, *INERTIAL)))
IN_COLUMNS = ("so2", "so3", "so3-body", "vector", *CHARTS)  # differences of columns of positions and velocities
GUESS = "guess"  # judge every convention
NO_GUESS = {
    "truth_covariance": ", whose covariance is of a declared error too",
    "relative": ", which judges motions in one error; name the conventions one by one",
}
OF_TRAJECTORIES = ("covariance", "covariance_order", "axes", "lever_arm")  # options
OF_BAGS = ("topic", "truth_topic")
OF_FILES = ("state", "covariance", "covariance_order", "truth", "lever_arm")  # bags have these in messages
OF_STATES = ("state", "dof", "members")
OF_NAMES = ("columns", "truth_columns")
OF_BOUNDS = ("level", "gaussian", "ends", "alert_limit")
OF_TABLES = (
    "bounds and members stand in a table of t, the components, and radius_x_y, bound_x or x_low and x_high with "
    "--level, or columns of --members; or in an archive (.npz)"
)
OF_TRUTH = ("truth_covariance", "truth_errors", "truth_shared")
OF_TRUTH_FILES = ("truth", "max_dt", "time_offset", "align", "truth_covariance")  # of truth in a file of its own
OF_OTHERS_THAN_ARCHIVES = (*OF_NAMES, *OF_AXES, *OF_BAGS, *OF_STATES, *OF_TRAJECTORIES, *OF_TRUTH_FILES)
# in place of options
ARCHIVE_KEYS = {"truth": "truth", "axes": "axes", "truth_covariance": "truth_covariances", "members": "members"}
PROGRAM_RUNS = "monte-carlo"  # kind of the manifest of a folder with runs of a program
Found = Sequence[Estimator | Record]


# --- kinds of files --------------------------------------------------------------------------------


def is_program_runs(path: Path) -> bool:
    """Whether a path is a folder that ``consistency monte-carlo`` wrote."""
    manifest = path / "manifest.json"
    if not is_file(manifest):
        return False
    data = read_json(manifest)
    return isinstance(data, dict) and data.get("kind") == PROGRAM_RUNS


class Kind(NamedTuple):
    """A kind of files; its reader gives estimators, or records where a file holds no poses and no errors."""

    name: str
    is_one: Callable[[Path, Reading], bool]
    refused: tuple[str, ...]  # options
    read: Callable[[Path, Reading, bool], Found]  # path, options, poses alone: covariances are not looked at


def _bags(path: Path, r: Reading, poses_alone: bool) -> Found:
    from consistency.referee.readers.formats.ros_bag import read_bags

    return read_bags(path, r, poses_alone)


def _archive(path: Path, r: Reading, poses_alone: bool) -> Found:
    from consistency.referee.readers.formats.archives import read_archive

    return read_archive(path, r, poses_alone)


def _tables(path: Path, r: Reading, poses_alone: bool) -> Found:
    from consistency.referee.readers.formats.table import read_tables

    return read_tables(path, r, poses_alone)


def _trajectories(path: Path, r: Reading, poses_alone: bool) -> Found:
    from consistency.referee.readers.formats.tum import read_tum

    return read_tum(path, r, poses_alone)


def _program_runs(path: Path, r: Reading, poses_alone: bool) -> Found:
    from consistency.referee.readers.pipeline.program_runs import read_program_runs

    return read_program_runs(path, r, found_in)


def _table_folder(path: Path, r: Reading, poses_alone: bool) -> Found:
    from consistency.referee.readers.pipeline.program_runs import read_table_folder

    return read_table_folder(path, r, poses_alone)


def _is_table_folder(path: Path, r: Reading) -> bool:
    named = r.components.state is not None or r.statement.level is not None
    return path.is_dir() and bool(table_files(path)) and (named or not trajectory_files(path, r.components.columns))


def _is_table(path: Path, r: Reading) -> bool:
    named = r.components.state is not None or r.statement.level is not None
    if path.suffix.lower() in TABLES and (named or not is_spatial(path, r.components.columns)):
        return True
    return is_plane(path, r.components.columns)


def _is_trajectory(path: Path, r: Reading) -> bool:
    return path.suffix.lower() in (*TRAJECTORIES, ".csv", ".pos") or path.is_dir()


KINDS = (  # a file is of the first that knows it
    Kind("runs of a program", lambda path, r: is_program_runs(path), (), _program_runs),
    Kind("ROS bag", lambda path, r: is_bag(path), (*OF_NAMES, *OF_FILES, *OF_STATES, *OF_BOUNDS), _bags),
    Kind("archive of arrays", lambda path, r: path.suffix.lower() in ARCHIVES, OF_OTHERS_THAN_ARCHIVES, _archive),
    Kind("table", _is_table, (*OF_BAGS, *OF_TRAJECTORIES), _tables),
    Kind("folder of tables", _is_table_folder, (*OF_BAGS, *OF_TRAJECTORIES), _table_folder),
    Kind("trajectory", _is_trajectory, (*OF_BAGS, *OF_BOUNDS, *OF_STATES), _trajectories),
)


def kind_of(path: Path, r: Reading) -> Kind | None:
    """The kind of a file or folder; None if it is of none."""
    if not is_foreign(path):
        for kind in KINDS:
            if kind.is_one(path, r):
                return kind
    return None


def found_in(estimates: Path, r: Reading) -> Found:
    """What the reader of a file gives; raises InputError for a file of no kind, and options that do not go with it."""
    if not estimates.exists():
        raise InputError(f"{estimates}: no such file")
    require_name(estimates.name, "file")
    if r.sources.body is not None and not (r.sources.truth is not None and is_drive(r.sources.truth)):
        raise InputError(f"--body {r.sources.body}: goes with --truth DIR, the folder of a KITTI drive")
    kind = kind_of(estimates, r)
    of_truth = r
    if r.sources.repeats:
        of_truth = r.with_truth(None)
        if kind is not None and kind.read not in (_archive, _tables):
            raise InputError(f"--truth repeats: is for tables and archives of runs of the same values, not {estimates}")
    refuse_options(estimates, of_truth, *(OF_BAGS if kind is None else kind.refused))
    if kind is None:
        raise unknown_kind(estimates)
    if r.sources.truth is not None and is_foreign(r.sources.truth):
        raise unknown_kind(r.sources.truth)
    return kind.read(estimates, r, False)


def refuse_options(path: Path, r: Reading, *names: str) -> None:
    """Refuse options among ``names`` that are given, but do not go with a file."""
    given = r.given(names)
    if given:
        instead = ""
        if path.suffix.lower() in ARCHIVES and given[0] in ARCHIVE_KEYS:
            instead = f", an archive; it has a key '{ARCHIVE_KEYS[given[0]]}' in its place"
        elif given[0] in (*OF_BOUNDS, "members"):
            instead = f", which states covariances alone; {OF_TABLES}"
        raise InputError(f"{flag_of(given[0])}: does not go with {path}{instead}")


# --- from files to records ---------------------------------------------------------------------------


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
    """Read tables in memory, with columns by name: one record for each estimator.

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

    sheet = rows(estimates, "estimates")
    true = rows(truth, "truth")
    r = checked_options(reading.with_truth(cast(Any, true)))
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
    """Records under the declared convention, with what else is declared of them.

    To guess it, they have the same runs under each convention that such poses have, the default of the files first.
    """

    def under(convention: str | None) -> list[Record]:
        return _declared(read(r.with_error(convention)), r)

    if r.conventions.error != GUESS:
        return under(r.conventions.error)
    r.refuse(f"--error {GUESS}", NO_GUESS)
    first = under(None)
    default = first[0].errors.convention
    if default not in (*PLANAR, *SPATIAL) or default == "vector":
        raise InputError(f"--error {GUESS}: is for poses; the errors of {name} are plain differences")
    guesses = {one.name: {default: one} for one in first}
    for kind in SPATIAL if default in SPATIAL else PLANAR:
        if kind not in (default, "vector"):
            for one in under(kind):
                guesses[one.name][kind] = one
    return [replace(one, guesses=guesses[one.name]) for one in first]


def _declared(records: list[Record], r: Reading) -> list[Record]:
    """Records with what is declared of their truth, in pieces where that is asked."""
    if r.given(OF_TRUTH) or any(record.truth.covariance is not None for record in records):
        from consistency.referee.readers.truth_covariance import declared

        records = declared(records, r)
    if r.sources.repeats or r.statement.ensemble is not None:
        from consistency.referee.diagnostics.normal_numbers import of_ensemble, of_repeats

        if r.sources.repeats:
            records = [of_repeats(record) for record in records]
        if r.statement.ensemble is not None:
            records = [of_ensemble(record, r.statement.ensemble) for record in records]
    if r.runs.independent and r.runs.relative is None:
        from consistency.referee.readers.pipeline.relative_motions import rows_as_runs

        return [rows_as_runs(record) for record in records]
    pieces = pieces_asked(r)
    if pieces is None:
        return records
    from consistency.referee.diagnostics.planning import in_pieces

    return [in_pieces(record, pieces or None) for record in records]


def records_of_found(found: Found, r: Reading) -> list[Record]:
    """Records of what readers gave, with what the options declare of their truth."""
    return _declared(_records(found, r), r)


def _records(found: Found, r: Reading) -> list[Record]:
    """Records of what a reader gives; of an estimator with the runs that left no estimates."""
    records: list[Record] = []
    for one in found:
        if isinstance(one, Record):
            if r.groups.by is not None:
                from consistency.referee.readers.pipeline.by_column import record_in_groups

                one = record_in_groups(one, r.groups)
            records.append(one)
            continue
        if r.given(OF_AXES):
            from consistency.referee.readers.axes_and_units import in_axes_of_estimates

            one = in_axes_of_estimates(one, r)
        for record in records_of(one, r):
            own = own_names(record, r)
            record = with_failed_runs(record, one.failed)
            errors = replace(record.errors, own_names=own)
            records.append(replace(record, errors=errors, runs=replace(record.runs, trials=one.trials)))
    return records


def own_names(record: Record, r: Reading) -> dict[str, str]:
    """What ``--columns`` calls components whose errors are differences of columns; none of others, as in the body."""
    if record.errors.convention not in IN_COLUMNS or record.origin.window is not None or r.matching.align is not None:
        return {}
    return columns_of_axes(record.errors.axes, r.components.columns)


def _by_kind(estimates: Path, r: Reading) -> list[Record]:
    records = _records(found_in(estimates, r), r)
    notes = [fitted_note(path) for path in (r.sources.covariance, estimates) if path is not None]
    if r.sources.truth is not None and is_drive(r.sources.truth):
        body = r.sources.body or "imu"
        of = f"the truth is the path of the {body} as its first pose sees it, t in s from the first packet"
        notes.insert(0, f"{r.sources.truth}: {of}")
    if any(notes):
        origin = records[0].origin
        records[0] = replace(records[0], origin=replace(origin, notes=(*filter(None, notes), *origin.notes)))
    return records


def pieces_asked(r: Reading) -> int | None:
    """Number of pieces of ``--split``, 0 for the advised one; None without the option.

    Raises
    ------
    InputError
        It is not a number of pieces, or another option makes runs of the log.
    """
    split = r.runs.split
    if split is None:
        return None
    others = dict.fromkeys(OF_WINDOWS, ", which cuts the log into windows")
    r.refuse("--split", others | {"independent": ", with which each row is a run already"})
    align = r.matching.align
    if align not in (None, "none"):
        raise InputError(f"--split: does not go with --align {align}: all pieces would share the error of one frame")
    if split == "auto":
        return 0
    if not str(split).isdecimal() or int(split) < 1:
        raise InputError(f"--split {split}: must be a number of pieces, or 'auto'")
    return int(split)


def checked_options(r: Reading) -> Reading:
    """Options that go together, whatever the file; numbers are floats, and no alignment is None."""
    windows_asked(r)
    error = r.conventions.error
    if error not in (None, GUESS, *CONVENTIONS):
        raise InputError(f"--error {error}: must be one of {', '.join((*CONVENTIONS, GUESS))}")
    matching = r.matching
    if matching.max_dt is not None and not (math.isfinite(matching.max_dt) and matching.max_dt >= 0):
        raise InputError(f"--max-dt {matching.max_dt:g}: must be 0 or more, in s")
    arm = matching.lever_arm
    if arm is not None and not (len(arm) == 3 and all(map(math.isfinite, arm))):
        raise InputError("--lever-arm: must be three numbers x,y,z, in m")
    offset = matching.time_offset
    if isinstance(offset, int):
        offset = float(offset)
    if offset not in (None, "estimate") and not (isinstance(offset, float) and math.isfinite(offset)):
        raise InputError(f"--time-offset {offset}: must be a number of seconds, or 'estimate'")
    has_truth = bool(r.given(("truth", "truth_topic")))
    if offset is not None and not has_truth:
        raise InputError("--time-offset needs --truth: without truth there are no clocks to compare")
    if r.runs.relative is not None and offset == "estimate":
        raise InputError("--time-offset estimate: needs poses in one world; with --relative give seconds")
    if r.given(OF_TRUTH):
        from consistency.referee.readers.truth_covariance import require_truth_options

        require_truth_options(r)
    if r.sources.repeats:
        why = ": repeats have no truth, and each run is compared with those before"
        of_truth = (*OF_WINDOWS, *OF_TRUTH, *GROUPED, "align", "split", "time_offset")
        r.refuse("--truth repeats", dict.fromkeys(of_truth, why))
    if r.statement.ensemble is not None and r.given(OF_TRUTH):
        raise InputError(f"--ensemble: does not go with {flag_of(r.given(OF_TRUTH)[0])}, of a Gaussian error")
    if r.given(OF_BOUNDS):
        from consistency.referee.readers.formats.bounds import require_bound_options

        require_bound_options(r)
    for name in ("by_file", "bins"):
        if r.given([name]) and r.groups.by is None:
            raise InputError(f"{flag_of(name)}: goes with --by COLUMN")
    if matching.align not in (None, *ALIGNMENTS):
        raise InputError(f"--align {matching.align}: must be one of {', '.join(ALIGNMENTS)}")
    align = None if matching.align == "none" else matching.align
    if align is not None and not has_truth:
        raise InputError(f"--align {align} needs --truth, with which the estimates are aligned")
    if r.runs.relative is not None and align is not None:
        raise InputError(f"--align {align}: does not go with --relative, which needs no common world; leave it out")
    pieces_asked(r)  # refused before anything is read
    if r.runs.independent and align is not None:
        raise InputError(f"--independent: does not go with --align {align}: all rows would share the error of a frame")
    return replace(r, matching=replace(matching, time_offset=offset, align=align))
