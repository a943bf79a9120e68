"""Drives of an odometry beside their truth, from every file that verdicts are given on; no covariance is needed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from consistency.referee.errors import InputError
from consistency.referee.extras import function_at
from consistency.referee.fit_covariance.clocks import clock_offset
from consistency.referee.geometry.groups import composed, matrices
from consistency.referee.readers.file_kinds import (
    ARCHIVES,
    TABLES,
    TRAJECTORIES,
    is_bag,
    is_drive,
    is_plane,
    is_solution,
    kind_of,
    trajectory_files,
    unknown_kind,
)
from consistency.referee.readers.formats.sheet import refuse
from consistency.referee.readers.formats.table import table_poses
from consistency.referee.readers.heading_units import require_radians
from consistency.referee.readers.options import Reading
from consistency.referee.readers.truth_matching import NamedPoses, truth_at
from consistency.referee.types import Array, Indices


@dataclass(frozen=True)
class Drive:
    """One drive, at the N times at which both poses are known; d is 2 in the plane and 3 in space."""

    name: str
    t: Array  # (N,), s; NaN where it is not known
    row: Indices  # (N,), of the estimates: neighbours differ by 1 where none is left out
    estimate: Array  # (N, d + 1, d + 1), poses in any world
    truth: Array  # (N, d + 1, d + 1)
    shift: float = 0.0  # s, that was estimated and added to its times

    @property
    def d(self) -> int:
        """2 in the plane, 3 in space."""
        return int(self.truth.shape[-1]) - 1


def read_drives(
    estimates: str | Path, truth: str | Path | None = None, *, reading: Reading | None = None
) -> list[Drive]:
    """Poses of an odometry and of the truth, from files of any kind that ``consistency analyse`` reads.

    Covariances in the files are not looked at. A file or a value of the column ``run`` is a drive.

    Parameters
    ----------
    estimates : .csv, .parquet, .npz, .bag, a TUM trajectory, or a folder of these with one for each drive
    truth : of the same kind, or the folder of a KITTI drive; in any world frame
    reading : further options of files, in place of ``truth``

    Raises
    ------
    InputError
        Something cannot be used: names file, line, column or option, and what is allowed.
    """
    r = reading or Reading(truth=None if truth is None else Path(truth))
    path = Path(estimates)
    if not path.exists():
        raise InputError(f"{path}: no such file")
    if r.time_offset not in (None, "estimate") and not isinstance(r.time_offset, (int, float)):
        raise InputError(f"--time-offset {r.time_offset}: must be a number of seconds, or 'estimate'")
    found = list(_poses(path, r))
    require_radians(str(path), [each.poses for each in found])
    estimated = [_estimated(each, r) for each in found]
    is_estimated = r.time_offset == "estimate"
    if is_estimated:
        shift = clock_offset([(each.poses, T) for each, T in zip(found, estimated, strict=True)])
    else:
        shift = float(r.time_offset or 0.0)
    return [_drive(each, T, shift, is_estimated) for each, T in zip(found, estimated, strict=True)]


def drive_of(
    name: str,
    estimate: Array,
    truth: Array,
    t: Array | None = None,
    row: Indices | None = None,
    motions: bool = False,
) -> Drive:
    """A drive of arrays.

    Parameters
    ----------
    estimate, truth : (N, 3), x, y, heading in m and rad, or (N, 7), x, y, z and a quaternion x, y, z, w
    t : (N,), s, increasing
    motions : estimates are motions since the row before, not poses

    Raises
    ------
    InputError
        Shapes do not fit, or a value is not finite.
    """
    estimate, truth = np.asarray(estimate, float), np.asarray(truth, float)
    if estimate.ndim != 2 or estimate.shape != truth.shape or estimate.shape[1] not in (3, 7):
        raise InputError(f"{name}: estimates {estimate.shape} and truth {truth.shape} must both be (N, 3) or (N, 7)")
    if not (np.isfinite(estimate).all() and np.isfinite(truth).all()):
        raise InputError(f"{name}: a pose is not finite; leave such rows out")
    T = matrices(estimate)
    if t is None:
        t = np.full(len(T), np.nan)
    if row is None:
        row = np.arange(len(T))
    return Drive(name, np.asarray(t, float), row, composed(T) if motions else T, matrices(truth))


def _poses(path: Path, r: Reading) -> Iterator[NamedPoses]:
    kind = kind_of(path, r)
    if not is_bag(path) and path.is_dir() and not trajectory_files(path):
        yield from _tables(path, r)
    elif kind is None or not kind.poses or is_solution(path):
        raise unknown_kind(path, (*TABLES, *ARCHIVES, ".bag", *TRAJECTORIES), "estimates=poses, truth=true_poses")
    else:
        yield from function_at(kind.poses)(path, r)


def _tables(folder: Path, r: Reading) -> Iterator[NamedPoses]:
    """Tables of a folder, one for each drive, with truths of the same names in another."""
    files = sorted(path for path in folder.iterdir() if path.suffix.lower() in TABLES or is_plane(path))
    if not files:
        raise InputError(f"{folder}: holds no tables, trajectories ({', '.join(TRAJECTORIES)}) or ROS bags")
    for path in files:
        truth = r.truth
        if truth is not None and truth.is_dir() and not is_drive(truth):
            truth = truth / path.name
        if truth is not None and not truth.exists():
            raise InputError(f"--truth {r.truth}: holds no file '{path.name}' for {path}")
        for name, poses, clock in table_poses(path, replace(r, truth=truth)):
            stem = path.name.split(".")[0]
            yield NamedPoses(stem if name == path.stem else f"{stem}, {name}", poses, clock)


def _estimated(read: NamedPoses, r: Reading) -> Array:
    """Estimated poses, (N, d + 1, d + 1)."""
    finite = np.isfinite(read.poses.estimate).all(axis=1)
    what = "the pose is not finite; end the drive before it, or leave the row out"
    refuse(~finite, read.poses.place.__getitem__, what)
    T = matrices(read.poses.estimate)
    return composed(T) if r.motions else T


def _drive(read: NamedPoses, T: Array, shift: float, is_estimated: bool) -> Drive:
    """The drive where its truth is known, with ``shift`` s added to its times."""
    name, poses, clock = read
    t = poses.t + shift
    known = truth_at(t, poses.true_t, poses.truth, poses.manifold, poses.max_dt)
    rows = known.rows
    if len(rows) < 2:
        raise InputError(
            f"{name}: {len(rows)} of {len(t)} poses have a truth within {poses.max_dt:g} s (--max-dt); t is "
            f"{t[0]:.15g} to {t[-1]:.15g}, but {poses.true_t[0]:.15g} to {poses.true_t[-1]:.15g} in the truth"
        )
    estimated_shift = shift if is_estimated else 0.0
    return Drive(name, clock[rows] + shift, rows, T[rows], matrices(known.truth), estimated_shift)
