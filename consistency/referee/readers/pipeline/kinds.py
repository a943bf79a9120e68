"""The kinds of files of estimates: how one is told, options that do not go with it, and its reader.

A reader is loaded when a file of its kind is read.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from consistency.referee.diagnostics.records.record import Record
from consistency.referee.readers.declared_axes import OPTIONS
from consistency.referee.readers.formats.file_kinds import (
    ARCHIVES,
    TABLES,
    TRAJECTORIES,
    is_bag,
    is_foreign,
    is_plane,
    is_spatial,
    table_files,
    trajectory_files,
)
from consistency.referee.readers.options import Reading
from consistency.referee.readers.truth_matching import Estimator

OF_TRAJECTORIES = ("covariance", "covariance_order", "axes", "lever_arm")  # options
OF_BAGS = ("topic", "truth_topic")
OF_FILES = ("state", "covariance", "covariance_order", "truth", "lever_arm")  # bags have these in messages
OF_NAMES = ("columns", "truth_columns")
OF_TRUTH_FILES = ("truth", "max_dt", "time_offset", "align", "truth_covariance")  # of truth in a file of its own
Found = Sequence[Estimator | Record]


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
    from consistency.referee.readers.formats.table_folder import read_folder

    return (read_folder if path.is_dir() else read_tables)(path, r, poses_alone)


def _trajectories(path: Path, r: Reading, poses_alone: bool) -> Found:
    from consistency.referee.readers.formats.tum import read_tum

    return read_tum(path, r, poses_alone)


def _is_archive(path: Path, r: Reading) -> bool:
    return path.suffix.lower() in ARCHIVES


def _is_table(path: Path, r: Reading) -> bool:
    named = path.suffix.lower() in TABLES and (r.state is not None or not is_spatial(path, r.columns))
    if path.is_dir():
        return bool(table_files(path)) and not trajectory_files(path, r.columns)
    return named or is_plane(path, r.columns)


def _is_trajectory(path: Path, r: Reading) -> bool:
    return path.suffix.lower() in (*TRAJECTORIES, ".csv", ".pos") or path.is_dir()


KINDS = (  # a file is of the first that knows it
    Kind(lambda path, r: is_bag(path), (*OF_NAMES, *OF_FILES), _bags),
    Kind(_is_archive, (*OF_NAMES, *OPTIONS, *OF_BAGS, "state", *OF_TRAJECTORIES, *OF_TRUTH_FILES), _archive),
    Kind(_is_table, (*OF_BAGS, *OF_TRAJECTORIES), _tables),
    Kind(_is_trajectory, (*OF_BAGS, "state"), _trajectories),
)


def kind_of(path: Path, r: Reading) -> Kind | None:
    """The kind of a file or folder; None if it is of none."""
    return None if is_foreign(path) else next((kind for kind in KINDS if kind.is_one(path, r)), None)
