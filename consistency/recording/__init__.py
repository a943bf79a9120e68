"""Files of estimators that are not ours, read as errors and covariances; docs/files.md describes them.

No filter, no scenario and no results folder of this package belongs here.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from consistency.errors import InputError
from consistency.geometry.conventions import PLANAR, SPATIAL, planar_error, se2_log, se3_log, spatial_error
from consistency.reading import require_name
from consistency.recording.alignment import ALIGNMENTS, require_alignment
from consistency.recording.archive import read_archive
from consistency.recording.bags import is_bag, read_bags
from consistency.recording.kitti import BODIES, is_drive
from consistency.recording.record import Recording
from consistency.recording.relative import MARGINAL
from consistency.recording.table import read_tables
from consistency.recording.tum import ORDERS, SUFFIXES, read_tum, trajectory_files
from consistency.recording.windows import relative_of

__all__ = [
    "ALIGNMENTS",
    "BODIES",
    "CONVENTIONS",
    "ORDERS",
    "Recording",
    "is_recording",
    "planar_error",
    "read_recordings",
    "se2_log",
    "se3_log",
    "spatial_error",
]

CONVENTIONS = tuple(dict.fromkeys((*PLANAR, *SPATIAL)))
TABLES = (".csv", ".parquet", ".pq")


def is_recording(path: Path, **options: Any) -> bool:
    """Whether a path is something :func:`read_recordings` reads, and not a folder of ``consistency run``.

    Raises
    ------
    InputError
        It is such a folder, and one of the ``options`` of other files is given with it; or it is a folder of neither.
    """
    if path.is_dir() and not (path / "manifest.json").exists():
        recording = bool(trajectory_files(path)) or is_bag(path) or any(value is not None for value in options.values())
        if not recording:
            known = f"trajectories ({', '.join(SUFFIXES)}) or ROS bags"
            raise InputError(f"{path}: holds no results of 'consistency run', and no {known}")
    else:
        recording = not path.is_dir() and (path.exists() or path.suffix != "")
    if not recording and path.exists():
        keys = [name for name, value in options.items() if value is not None]
        if keys:
            name = {"convention": "error"}.get(keys[0], keys[0].replace("_", "-"))
            raise InputError(f"--{name}: does not go with {path}, a folder of 'consistency run'")
    return recording


def read_recordings(
    estimates: Path,
    truth: Path | None = None,
    covariance: Path | None = None,
    convention: str | None = None,
    *,
    state: Sequence[str] | None = None,
    covariance_order: str | None = None,
    max_dt: float | None = None,
    time_offset: float | str | None = None,
    axes: Sequence[str] | None = None,
    topic: str | None = None,
    truth_topic: str | None = None,
    body: str | None = None,
    relative: str | float | None = None,
    motions: bool | None = None,
    windows: str | None = None,
    align: str | None = None,
) -> list[Recording]:
    """What estimators said, from CSV, Parquet, TUM or NumPy files: one recording for each estimator.

    Parameters
    ----------
    estimates : .csv, .parquet, .npz, or a TUM trajectory, or a folder of these with one for each run
    truth : of the same kind, or the folder of a KITTI drive; not with .npz
    covariance : of a TUM trajectory
    convention : of the error, one of ``CONVENTIONS``; None is the default of the kind
    state : names of the columns that make up the state, in .csv and .parquet; None is x, y, heading
    covariance_order : one of ``ORDERS``, of the 6 x 6 covariance of a trajectory
    max_dt : s, between an estimate and its truth; None is 0.01, half a period of a 50 Hz truth
    time_offset : s to add to the timestamps of the estimates, or "estimate"; with None an offset that is found is
        named in the notes
    axes : components of the error of a trajectory that are judged: of x, y, z, roll, pitch, yaw; None is all
    topic, truth_topic : of a ROS bag: PoseWithCovarianceStamped or Odometry; poses, or PARENT:CHILD of /tf
    body : whose poses a drive of KITTI gives as truth: one of ``BODIES``; None is imu
    relative : judge motions over windows of so many steps (100), seconds ("10s") or metres ("50m") in place of poses
    motions : with ``relative``: each row is the motion since the row before, and errors of motions are independent
    windows : "independent": errors of different windows are; with motions they are anyway
    align : one of ``ALIGNMENTS``: how the estimates are moved into the world of the truth; None is none

    Raises
    ------
    InputError
        Something cannot be used: names file, line, column or option, and what is allowed.
    """
    estimates = Path(estimates)
    over = relative_of(relative, bool(motions), windows)
    if convention is not None and convention not in CONVENTIONS:
        raise InputError(f"--error {convention}: must be one of {', '.join(CONVENTIONS)}")
    if max_dt is not None and not (math.isfinite(max_dt) and max_dt >= 0):
        raise InputError(f"--max-dt {max_dt:g}: must be 0 or more, in s")
    if isinstance(time_offset, int):
        time_offset = float(time_offset)
    if time_offset not in (None, "estimate") and not (isinstance(time_offset, float) and math.isfinite(time_offset)):
        raise InputError(f"--time-offset {time_offset}: must be a number of seconds, or 'estimate'")
    if time_offset is not None and truth is None and truth_topic is None:
        raise InputError("--time-offset needs --truth: without truth there are no clocks to compare")
    if over is not None and time_offset == "estimate":
        raise InputError("--time-offset estimate: needs poses in one world; with --relative give seconds")
    align = require_alignment(align, truth or truth_topic)
    if over is not None and align is not None:
        raise InputError(f"--align {align}: does not go with --relative, which needs no common world; leave it out")
    if not estimates.exists():
        raise InputError(f"{estimates}: no such file")
    require_name(estimates.name, "file")
    suffix = estimates.suffix.lower()
    own: dict[str, object] = {"state": state, "max-dt": max_dt, "covariance": covariance, "truth": truth}
    own |= {"covariance-order": covariance_order, "time-offset": time_offset, "axes": axes}
    own |= {"topic": topic, "truth-topic": truth_topic, "body": body, "align": align}
    if body is not None and not (truth is not None and is_drive(truth)):
        raise InputError(f"--body {body}: goes with --truth DIR, the folder of a KITTI drive")
    if is_bag(estimates):
        _refuse(estimates, own, ("state", "covariance", "covariance-order", "truth"))
        if over is not None:
            raise InputError(f"{estimates}: --relative: {MARGINAL}")
        return read_bags(estimates, topic, truth_topic, convention, max_dt, time_offset, axes, align)
    _refuse(estimates, own, ("topic", "truth-topic"))
    if suffix == ".npz":
        _refuse(
            estimates,
            own,
            ("state", "max-dt", "covariance", "covariance-order", "truth", "time-offset", "axes", "align"),
        )
        return read_archive(estimates, convention, over)
    if suffix in TABLES:
        _refuse(estimates, own, ("covariance", "covariance-order", "axes"))
        if state is not None and (len(set(state)) < len(state) or not all(state)):
            raise InputError(f"--state {','.join(state)}: needs names of columns, each once")
        found = read_tables(estimates, truth, convention, state, max_dt, time_offset, body, over, align)
        return _with_frame(found, truth, body)
    if suffix not in SUFFIXES and not estimates.is_dir():
        known = ", ".join((*TABLES, ".npz", ".bag", *SUFFIXES))
        raise InputError(f"{estimates}: unknown kind of file; known are {known} (TUM trajectories)")
    _refuse(estimates, own, ("state",))
    found = read_tum(
        estimates, truth, covariance, convention, covariance_order, max_dt, time_offset, axes, body, over, align
    )
    return _with_frame(found, truth, body)


def _with_frame(recordings: list[Recording], truth: Path | None, body: str | None) -> list[Recording]:
    """Say whose poses a drive gives, and in which world."""
    if truth is None or not is_drive(truth):
        return recordings
    note = (
        f"{truth}: the truth is the path of the {body or 'imu'} as its first pose sees it, t in s from the first packet"
    )
    return [replace(recordings[0], notes=(note, *recordings[0].notes)), *recordings[1:]]


def _refuse(path: Path, options: dict[str, object], names: Sequence[str]) -> None:
    for name in names:
        if options[name] is not None:
            kept = path.suffix.lower() == ".npz" and name in ("truth", "axes")
            instead = f", an archive; it has a key '{name}' in its place" if kept else ""
            raise InputError(f"--{name}: does not go with {path}{instead}")
