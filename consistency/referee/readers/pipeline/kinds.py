"""The kinds of files of estimates: how one is told, options that do not go with it, and its reader.

A reader is loaded when a file of its kind is read.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from consistency.referee.diagnostics.records.record import Record
from consistency.referee.errors import InputError
from consistency.referee.parsing import is_file, read_json, require_name
from consistency.referee.readers.declared_axes import OPTIONS
from consistency.referee.readers.formats.file_kinds import (
    ARCHIVES,
    TABLES,
    TRAJECTORIES,
    is_bag,
    is_drive,
    is_foreign,
    is_plane,
    is_spatial,
    table_files,
    trajectory_files,
    unknown_kind,
)
from consistency.referee.readers.options import Reading, flag_of
from consistency.referee.readers.truth_matching import Estimator

OF_TRAJECTORIES = ("covariance", "covariance_order", "axes", "lever_arm")  # options
OF_BAGS = ("topic", "truth_topic")
OF_FILES = ("state", "covariance", "covariance_order", "truth", "lever_arm")  # bags have these in messages
OF_NAMES = ("columns", "truth_columns")
OF_TRUTH_FILES = ("truth", "max_dt", "time_offset", "align", "truth_covariance")  # of truth in a file of its own
Found = Sequence[Estimator | Record]
PROGRAM_RUNS = "monte-carlo"  # kind of the manifest of a folder with runs of a program


def is_program_runs(path: Path) -> bool:
    """Whether a path is a folder that ``consistency monte-carlo`` wrote."""
    manifest = path / "manifest.json"
    if not is_file(manifest):
        return False
    data = read_json(manifest)
    return isinstance(data, dict) and data.get("kind") == PROGRAM_RUNS


class Kind(NamedTuple):
    """A kind of files; its reader gives estimators, or records where a file holds no poses and no errors."""

    is_one: Callable[[Path, Reading], bool]
    refused: tuple[str, ...]  # options
    read: Callable[[Path, Reading, bool], Found]  # path, options, poses alone: covariances are not looked at


def _bags(path: Path, r: Reading, poses_alone: bool) -> Found:
    from consistency.referee.readers.formats.ros_bag import read_bags

    return read_bags(path, r, poses_alone)


def _archive(path: Path, r: Reading, poses_alone: bool) -> Found:
    from consistency.referee.readers.formats.numpy_archive import read_archive

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
    from consistency.referee.readers.pipeline.run_folders import read_table_folder

    return read_table_folder(path, r, poses_alone)


def _is_table_folder(path: Path, r: Reading) -> bool:
    return path.is_dir() and bool(table_files(path)) and (r.state is not None or not trajectory_files(path, r.columns))


def _is_archive(path: Path, r: Reading) -> bool:
    return path.suffix.lower() in ARCHIVES


def _is_table(path: Path, r: Reading) -> bool:
    named = path.suffix.lower() in TABLES and (r.state is not None or not is_spatial(path, r.columns))
    return named or is_plane(path, r.columns)


def _is_trajectory(path: Path, r: Reading) -> bool:
    return path.suffix.lower() in (*TRAJECTORIES, ".csv", ".pos") or path.is_dir()


KINDS = (  # a file is of the first that knows it
    Kind(lambda path, r: is_program_runs(path), (), _program_runs),
    Kind(lambda path, r: is_bag(path), (*OF_NAMES, *OF_FILES), _bags),
    Kind(_is_archive, (*OF_NAMES, *OPTIONS, *OF_BAGS, "state", *OF_TRAJECTORIES, *OF_TRUTH_FILES), _archive),
    Kind(_is_table, (*OF_BAGS, *OF_TRAJECTORIES), _tables),
    Kind(_is_table_folder, (*OF_BAGS, *OF_TRAJECTORIES), _table_folder),
    Kind(_is_trajectory, (*OF_BAGS, "state"), _trajectories),
)


def kind_of(path: Path, r: Reading) -> Kind | None:
    """The kind of a file or folder; None if it is of none."""
    return None if is_foreign(path) else next((kind for kind in KINDS if kind.is_one(path, r)), None)


def found_in(estimates: Path, r: Reading) -> Found:
    """What the reader of a file gives; raises InputError for a file of no kind, and options that do not go with it."""
    if not estimates.exists():
        raise InputError(f"{estimates}: no such file")
    require_name(estimates.name, "file")
    if r.body is not None and not (r.truth is not None and is_drive(r.truth)):
        raise InputError(f"--body {r.body}: goes with --truth DIR, the folder of a KITTI drive")
    kind = kind_of(estimates, r)
    refuse_options(estimates, r, *(OF_BAGS if kind is None else kind.refused))
    if kind is None:
        raise unknown_kind(estimates)
    if r.truth is not None and is_foreign(r.truth):
        raise unknown_kind(r.truth)
    return kind.read(estimates, r, False)


def refuse_options(path: Path, r: Reading, *names: str) -> None:
    """Refuse options among ``names`` that are given, but do not go with a file."""
    if names and (given := r.given(names)):
        keys = {"truth": "truth", "axes": "axes", "truth_covariance": "truth_covariances"}
        kept = path.suffix.lower() in ARCHIVES and given[0] in keys
        instead = f", an archive; it has a key '{keys[given[0]]}' in its place" if kept else ""
        raise InputError(f"{flag_of(given[0])}: does not go with {path}{instead}")
