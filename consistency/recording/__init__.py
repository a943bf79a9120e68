"""Files of estimators that are not ours, read as errors and covariances; docs/files.md describes them.

No filter, no scenario and no results folder of this package belongs here.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from consistency.errors import InputError
from consistency.geometry.conventions import PLANAR, SPATIAL, planar_error, se2_log, se3_log, spatial_error
from consistency.recording.alignment import ALIGNMENTS, require_alignment
from consistency.recording.archive import read_archive
from consistency.recording.bags import is_bag, read_bags
from consistency.recording.record import Recording
from consistency.recording.table import read_tables
from consistency.recording.tum import ORDERS, SUFFIXES, read_tum, trajectory_files

__all__ = [
    "ALIGNMENTS",
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
        It is such a folder, and one of the ``options`` of other files is given with it.
    """
    if path.is_dir() and not (path / "manifest.json").exists():
        recording = bool(trajectory_files(path)) or is_bag(path) or any(value is not None for value in options.values())
    else:
        recording = path.is_file() or (path.suffix != "" and not path.exists())
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
    align: str | None = None,
) -> list[Recording]:
    """What estimators said, from CSV, Parquet, TUM or NumPy files: one recording for each estimator.

    Parameters
    ----------
    estimates : .csv, .parquet, .npz, or a TUM trajectory, or a folder of these with one for each run
    truth : of the same kind; not with .npz
    covariance : of a TUM trajectory
    convention : of the error, one of ``CONVENTIONS``; None is the default of the kind
    state : names of the columns that make up the state, in .csv and .parquet; None is x, y, heading
    covariance_order : one of ``ORDERS``, of the 6 x 6 covariance of a trajectory
    max_dt : s, between an estimate and its truth; None is 0.01, half a period of a 50 Hz truth
    time_offset : s to add to the timestamps of the estimates, or "estimate"; with None an offset that is found is
        named in the notes
    axes : components of the error of a trajectory that are judged: of x, y, z, roll, pitch, yaw; None is all
    topic, truth_topic : of a ROS bag: PoseWithCovarianceStamped or Odometry; poses, or PARENT:CHILD of /tf
    align : one of ``ALIGNMENTS``: how the estimates are moved into the world of the truth; None is none

    Raises
    ------
    InputError
        Something cannot be used: names file, line, column or option, and what is allowed.
    """
    estimates = Path(estimates)
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
    align = require_alignment(align, truth or truth_topic)
    if not estimates.exists():
        raise InputError(f"{estimates}: no such file")
    suffix = estimates.suffix.lower()
    own: dict[str, object] = {"state": state, "max-dt": max_dt, "covariance": covariance, "truth": truth}
    own |= {"covariance-order": covariance_order, "time-offset": time_offset, "axes": axes}
    own |= {"topic": topic, "truth-topic": truth_topic, "align": align}
    if is_bag(estimates):
        _refuse(estimates, own, ("state", "covariance", "covariance-order", "truth"))
        return read_bags(estimates, topic, truth_topic, convention, max_dt, time_offset, axes, align)
    _refuse(estimates, own, ("topic", "truth-topic"))
    if suffix == ".npz":
        _refuse(
            estimates,
            own,
            ("state", "max-dt", "covariance", "covariance-order", "truth", "time-offset", "axes", "align"),
        )
        return read_archive(estimates, convention)
    if suffix in TABLES:
        _refuse(estimates, own, ("covariance", "covariance-order", "axes"))
        if state is not None and (len(set(state)) < len(state) or not all(state)):
            raise InputError(f"--state {','.join(state)}: needs names of columns, each once")
        return read_tables(estimates, truth, convention, state, max_dt, time_offset, align)
    if suffix not in SUFFIXES and not estimates.is_dir():
        known = ", ".join((*TABLES, ".npz", ".bag", *SUFFIXES))
        raise InputError(f"{estimates}: unknown kind of file; known are {known} (TUM trajectories)")
    _refuse(estimates, own, ("state",))
    return read_tum(estimates, truth, covariance, convention, covariance_order, max_dt, time_offset, axes, align)


def _refuse(path: Path, options: dict[str, object], names: Sequence[str]) -> None:
    for name in names:
        if options[name] is not None:
            raise InputError(f"--{name}: does not go with {path}")
