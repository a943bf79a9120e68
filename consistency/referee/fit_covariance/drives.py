"""Drives of an odometry beside their truth, from every file that verdicts are given on, on one clock."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from consistency.referee.errors import InputError
from consistency.referee.geometry import composed, inverse, log, matrices
from consistency.referee.readers.axes_and_units import in_axes_of_estimates, require_radians
from consistency.referee.readers.clocks import GRID, MOST, REACH, refined
from consistency.referee.readers.formats.file_kinds import (
    ARCHIVES,
    TABLES,
    TRAJECTORIES,
    is_bag,
    is_plane,
    is_solution,
    trajectory_files,
    unknown_kind,
)
from consistency.referee.readers.options import Reading
from consistency.referee.readers.pipeline.program_runs import read_table_of_run
from consistency.referee.readers.pipeline.read_files import Found, kind_of
from consistency.referee.readers.places import refuse
from consistency.referee.readers.truth_matching import Estimator, Poses
from consistency.referee.types import Array, Indices

LONG = 1.0  # s, of the motions that are compared
KEPT = 0.9  # of the squared errors, the smallest: jumps decide nothing
PARTS = 5  # drives that show how well the offset is known; fewer ones are cut into as many parts
UNSURE = 0.1  # s, standard error of an offset that is not used


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
    r = reading or Reading().with_truth(None if truth is None else Path(truth))
    path = Path(estimates)
    if not path.exists():
        raise InputError(f"{path}: no such file")
    offset = r.matching.time_offset
    if offset not in (None, "estimate") and not isinstance(offset, (int, float)):
        raise InputError(f"--time-offset {offset}: must be a number of seconds, or 'estimate'")
    poses = _poses(path, r)
    require_radians(str(path), poses)
    found = [(each, _matrices(each, r)) for each in poses]
    if offset != "estimate":
        return [_drive(each, T, float(offset or 0.0)) for each, T in found]
    shift = clock_offset(found)
    return [replace(_drive(each, T, shift), shift=shift) for each, T in found]


def drive_of(
    name: str, estimate: Array, truth: Array, t: Array | None = None, row: Indices | None = None, motions: bool = False
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


def _poses(path: Path, r: Reading) -> list[Poses]:
    """The poses of each drive, without covariances."""
    if not is_bag(path) and path.is_dir() and not trajectory_files(path, r.components.columns):
        return _of_folder(path, r)
    kind = kind_of(path, r)
    if kind is None or is_solution(path):
        raise _no_poses(path)
    return _of_one(path, kind.read(path, r, True), r)


def _no_poses(path: Path) -> InputError:
    return unknown_kind(path, (*TABLES, *ARCHIVES, ".bag", *TRAJECTORIES), "estimates=poses, truth=true_poses")


def _of_one(path: Path, found: Found, r: Reading) -> list[Poses]:
    """The runs of the one estimator of a file."""
    if len(found) > 1:
        raise InputError(f"{path}: holds several estimators in its column 'filter'; keep the rows of one")
    (one,) = found
    if not isinstance(one, Estimator):
        raise _no_poses(path)
    if one.innovations_alone:
        raise InputError(f"{path}: needs --truth FILE, poses in any world")
    return list(in_axes_of_estimates(one, r).runs)


def _of_folder(folder: Path, r: Reading) -> list[Poses]:
    """Tables of a folder, one for each drive, with truths of the same names in another."""
    columns = r.components.columns
    files = sorted(path for path in folder.iterdir() if path.suffix.lower() in TABLES or is_plane(path, columns))
    if not files:
        raise InputError(f"{folder}: holds no tables, trajectories ({', '.join(TRAJECTORIES)}) or ROS bags")
    found = []
    for path in files:
        stem = path.name.split(".")[0]
        for poses in _of_one(path, read_table_of_run(path, r, poses_alone=True), r):
            own = poses.source.name
            found.append(poses.with_values(name=stem if own == path.stem else f"{stem}, {own}"))
    return found


def _matrices(poses: Poses, r: Reading) -> Array:
    """Estimated poses, (N, d + 1, d + 1)."""
    finite = np.isfinite(poses.own.estimate).all(axis=1)
    what = "the pose is not finite; end the drive before it, or leave the row out"
    refuse(~finite, poses.own.place.__getitem__, what)
    T = matrices(poses.own.estimate)
    return composed(T) if r.runs.motions else T


def _drive(poses: Poses, T: Array, shift: float) -> Drive:
    name = poses.source.name
    t = poses.own.t + shift
    known = poses.known(shift)
    if len(known.rows) < 2:
        raise InputError(
            f"{name}: {len(known.rows)} of {len(t)} poses have a truth within {poses.max_dt:g} s (--max-dt); t "
            f"is {t[0]:.15g} to {t[-1]:.15g}, but {poses.true.t[0]:.15g} to {poses.true.t[-1]:.15g} in the truth"
        )
    return Drive(name, poses.seconds[known.rows] + shift, known.rows, T[known.rows], matrices(known.truth))


class TimedMotions(NamedTuple):
    """Some motions of a drive, K of them."""

    starts: Poses
    ends: Poses
    motions: Array  # (K, d + 1, d + 1), estimated

    def squares(self, shift: float) -> Array:
        """Squared errors (k, 2) of positions and rotations, with the truth ``shift`` s later, where it is known."""
        true = np.full((2, *self.motions.shape), np.nan)
        for T, poses in zip(true, (self.starts, self.ends), strict=True):
            known = poses.known(shift)
            T[known.rows] = matrices(known.truth)
        is_known = np.isfinite(true).all(axis=(0, 2, 3))
        start, end = true[:, is_known]
        error = log(inverse(self.motions[is_known]) @ inverse(start) @ end)
        d = self.motions.shape[-1] - 1
        positions = (error[:, :d] ** 2).sum(axis=1)
        rotations = (error[:, d:] ** 2).sum(axis=1)
        return np.column_stack([positions, rotations])


def clock_offset(drives: Sequence[tuple[Poses, Array]]) -> float:
    """Time to add to the timestamps of the estimates, s, one for all drives.

    The offset minimises the squared errors of motions over ``LONG`` s, of positions times rotations, so that no scale
    of either decides.

    Parameters
    ----------
    drives : poses, and their estimates as matrices (N, d + 1, d + 1)

    Raises
    ------
    InputError
        The motions do not tell it.
    """
    parts: list[TimedMotions] = []
    for poses, T in drives:
        last = np.searchsorted(poses.own.t, poses.own.t + LONG)
        first = np.flatnonzero(last < len(poses.own.t))
        some = first[:: max(len(first) * len(drives) // MOST, 1)]
        for rows in np.array_split(some, -(-PARTS // len(drives))):
            if len(rows):
                ends = last[rows]
                motions = inverse(T[rows]) @ T[ends]
                parts.append(TimedMotions(poses.of_rows(rows), poses.of_rows(ends), motions))
    if len(parts) > 1:
        offset = _best(parts)
        spread = float(np.std([_best([part]) for part in parts], ddof=1))
        if np.isfinite(offset) and spread < UNSURE * np.sqrt(len(parts)):
            return offset
    raise InputError(
        "--time-offset estimate: the motions do not tell it, because nothing moves unevenly, or the offset is more "
        f"than {REACH:g} s; give seconds"
    )


def _best(parts: Sequence[TimedMotions]) -> float:
    """The offset with the smallest errors; NaN where that is at an end of ``GRID``, or no offset is better."""

    def size(shift: float) -> float:
        squares = np.sort(np.concatenate([part.squares(shift) for part in parts]), axis=0)
        kept = squares[: max(int(KEPT * len(squares)), 1)]
        return float(np.log(kept.mean(axis=0) + 1e-300).sum())

    sizes = np.array([size(shift) for shift in GRID])
    if np.isnan(sizes).all():
        return float("nan")
    best = int(np.nanargmin(sizes))
    is_told = np.nanmax(sizes) - sizes[best] > 1e-6
    if best in (0, len(GRID) - 1) or not is_told:
        return float("nan")
    return refined(size, sizes, 1e-4)
