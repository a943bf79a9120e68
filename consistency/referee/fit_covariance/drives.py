"""Drives of an odometry beside their truth, from every file that verdicts are given on, cut into windows of motion.

The estimates and the truth of a drive are on one clock. Windows have one span and do not overlap; each has a few
pieces, and jumps and windows without motion are left out. A piece is a motion as a vector (n,): its shift, in the
frame of its beginning, and its rotation vector.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from consistency.referee.errors import InputError
from consistency.referee.geometry import composed, inverse, log, matrices, vectors
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
from consistency.referee.readers.runs_to_record import Relative, relative_of, windows
from consistency.referee.readers.truth_matching import Estimator, Poses
from consistency.referee.types import Array, Indices

LONG = 1.0  # s, of the motions that are compared
KEPT = 0.9  # of the squared errors, the smallest: jumps decide nothing
PARTS = 5  # drives that show how well the offset is known; fewer ones are cut into as many parts
UNSURE = 0.1  # s, standard error of an offset that is not used
PIECES = 20  # of a window: sums over them are independent of the rate of the file, and as good as integrals
STILL = 0.1  # of the span: a window with less motion says nothing about the span
JUMP_OF_PIECES = 12.0  # medians of the errors of its drive's pieces that a piece exceeds in a jump
JUMP_OF_WINDOWS = 3.0  # medians of the errors of its drive's windows that it exceeds, too
ROUNDED = 1e-4  # rad, of rotation errors that neither jump nor grow: a file with four digits has them
BLOCKS = 20  # of windows, where drives are too few for the jackknife
ENOUGH = 5  # drives for which they are the blocks
PLANE, SPACE = ("x", "y", "yaw"), ("x", "y", "z", "roll", "pitch", "yaw")
ROWS = ("drive", "first", "last", "pieces", "true", "true_pieces")  # what there is of each window


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
    if path.is_dir() and not is_bag(path) and not trajectory_files(path, r.components.columns):
        poses = _of_folder(path, r)
    else:
        kind = kind_of(path, r)
        if kind is None or is_solution(path):
            raise _no_poses(path)
        poses = _of_one(path, kind.read(path, r, True), r)
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


# --- windows ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class DriveWindows:
    """W windows of some drives, in P pieces of estimated motion each; a piece of 0 is none."""

    drives: tuple[Drive, ...] = field(repr=False)
    span: Relative
    is_planar: bool  # x, y and yaw alone, also of motions in space
    drive: Indices  # (W,), index of the drive
    first: Indices  # (W,), rows of the drive
    last: Indices  # (W,)
    pieces: Array  # (W, P, n)
    true: Array  # (W, d + 1, d + 1), motion of the whole window
    true_pieces: Array  # (W, P, n)
    long: int = 0  # windows left out because rows or truth are missing
    still: int = 0  # left out, with hardly any motion
    jumps: int = 0  # left out, with a jump

    @property
    def d(self) -> int:
        """2 in the plane, 3 in space."""
        return int(self.true.shape[-1]) - 1

    @property
    def axes(self) -> tuple[str, ...]:
        return PLANE if self.d == 2 else SPACE

    @property
    def motions(self) -> Array:
        """Estimated motion of each window, (W, d + 1, d + 1)."""
        return rests(motion_matrices(self.pieces))[:, 0]

    @property
    def errors(self) -> Array:
        """Log(D^-1 M) of the estimated and the true motion, (W, n)."""
        return log(inverse(self.motions) @ self.true)

    @property
    def counts(self) -> dict[str, int]:
        """Windows, and those left out."""
        return {"windows": len(self.drive), "long": self.long, "still": self.still, "jumps": self.jumps}

    @property
    def follows(self) -> Array:
        """Whether each window but the first begins where the one before ends, (W - 1,)."""
        same_drive = self.drive[1:] == self.drive[:-1]
        return np.asarray(same_drive & (self.first[1:] == self.last[:-1]))

    def of(self, keep: Indices | Array) -> DriveWindows:
        """Some of the windows, by index or mask."""
        return replace(self, **{name: getattr(self, name)[keep] for name in ROWS})

    def over(self, size: float) -> DriveWindows | None:
        """Windows of all drives over a span of another size, in pieces of the same size; None where none fits.

        Turns of another size would hold another share of the noise.
        """
        pieces = max(round(PIECES * size / self.span.size), 1)
        try:
            return cut_windows(self.drives, replace(self.span, size=size), self.is_planar, pieces)
        except InputError:
            return None


def span_of(text: str | float) -> Relative:
    """Parse a span: 1m, 2s, 100 steps.

    Raises
    ------
    InputError
        It is not a positive number with its unit.
    """
    try:
        span = relative_of(text)
    except InputError:
        span = None
    if span is None:
        raise InputError(f"--span {text}: must be metres along the true path (1m), seconds (2s) or a number of steps")
    return replace(span, flag="--span")


def cut_windows(
    drives: Sequence[Drive],
    span: Relative,
    planar: bool = False,
    pieces: int = PIECES,
) -> DriveWindows:
    """Cut all drives into windows; drives in which none fits have none.

    Parameters
    ----------
    planar : x, y and yaw alone of motions in space
    pieces : of a window

    Raises
    ------
    InputError
        No window fits in any drive.
    """
    parts = []
    long = 0
    refused: list[InputError] = []
    for number, drive in enumerate(drives):
        try:
            rows = drive.row if span.unit == "step" else np.arange(len(drive.t))
            first, last, left_out = windows(drive.t, drive.truth[:, :-1, -1], rows, span, drive.name)
        except InputError as error:
            refused.append(error)
            continue
        first, last = np.searchsorted(rows, first), np.searchsorted(rows, last)
        ends = _ends(first, last, pieces)
        estimated = motions_between(drive.estimate, ends[:, :-1], ends[:, 1:], planar)
        true_pieces = motions_between(drive.truth, ends[:, :-1], ends[:, 1:], planar)
        true = motion_matrices(motions_between(drive.truth, first, last, planar))
        parts.append((np.full(len(first), number), first, last, estimated, true, true_pieces))
        long += left_out
    if not parts:
        raise refused[-1]
    by_name: dict[str, Any] = dict(zip(ROWS, map(np.concatenate, zip(*parts, strict=True)), strict=True))
    found = DriveWindows(tuple(drives), span, planar, **by_name, long=long)
    moves = _moves(found)
    jumps = _jumps(found)
    sound = moves & ~jumps
    if not sound.any():
        raise InputError(f"--span {span.option}: no window of {drives[0].name} has motion without a jump; take another")
    counted = replace(found, still=int((~moves).sum()), jumps=int((moves & jumps).sum()))
    return counted.of(sound)


def _ends(first: Indices, last: Indices, pieces: int) -> Indices:
    """Rows at which the pieces of windows begin and end, (W, pieces + 1)."""
    shares = np.linspace(0.0, 1.0, pieces + 1)
    return np.rint(first[:, None] + shares * (last - first)[:, None]).astype(np.int64)


def _moves(of: DriveWindows) -> Array:
    """Which windows have motion, (W,): on the way, for a span in m; in way or turn, compared with others, otherwise."""
    way = ways(of.pieces).sum(axis=1)
    if of.span.unit == "m":
        return np.asarray(way >= STILL * of.span.size)
    angle = angles(of.pieces).sum(axis=1)
    goes = way > STILL * np.median(way)
    turns = angle > STILL * np.median(angle)
    return np.asarray(goes | turns)


def _jumps(of: DriveWindows) -> Array:
    """Which windows have a piece whose error, of position or rotation, is a jump in its drive, (W,)."""
    gaps = inverse(motion_matrices(of.pieces)) @ motion_matrices(of.true_pieces)
    W, P, size, _ = gaps.shape
    errors = log(gaps.reshape(W * P, size, size)).reshape(W, P, -1)
    ends = _ends(of.first, of.last, P)
    errors[ends[:, 1:] == ends[:, :-1]] = np.nan  # a piece without a row
    of_windows = of.errors
    found = np.zeros(W, bool)
    for part, least in ((slice(of.d), 0.0), (slice(of.d, None), ROUNDED)):  # positions, rotations
        pieces = norms(errors[..., part])
        whole = norms(of_windows[:, part])
        for drive in np.unique(of.drive):
            rows = of.drive == drive
            by_pieces = JUMP_OF_PIECES * float(np.nanmedian(pieces[rows]))
            by_windows = JUMP_OF_WINDOWS * float(np.median(whole[rows]))
            limit = max(by_pieces, by_windows, least)
            exceeds = np.nan_to_num(pieces[rows]) > limit
            found[rows] |= exceeds.any(axis=1) & (limit > 0)
    return found


# --- motions as vectors -----------------------------------------------------------------------------------------------


def motions_between(
    T: Array,
    first: Indices,
    last: Indices,
    planar: bool = False,
) -> Array:
    """Motions between rows of poses (N, d + 1, d + 1), in the frame of the first, (..., n)."""
    motions = inverse(T[first]) @ T[last]
    if planar and T.shape[-1] == 4:
        motions = in_plane(motions)
    return vectors_of(motions)


def in_plane(T: Array) -> Array:
    """Motions in space (..., 4, 4) as those of x, y and yaw, (..., 3, 3); yaw is the direction of the x axis."""
    yaw = np.arctan2(T[..., 1, 0], T[..., 0, 0])
    return motion_matrices(np.concatenate([T[..., :2, 3], yaw[..., None]], axis=-1))


def motion_matrices(motions: Array) -> Array:
    """Homogeneous matrices (..., d + 1, d + 1) of motions (..., n)."""
    flat = motions.reshape(-1, motions.shape[-1])
    if flat.shape[1] == 6 and len(flat):
        turns = Rotation.from_rotvec(flat[:, 3:])
        flat = np.column_stack([flat[:, :3], turns.as_quat()])
    T = matrices(flat)
    return T.reshape(*motions.shape[:-1], *T.shape[1:])


def vectors_of(T: Array) -> Array:
    """Motions (..., n) of homogeneous matrices (..., d + 1, d + 1)."""
    flat = T.reshape(-1, *T.shape[-2:])
    if flat.shape[1] == 3 or not len(flat):
        out = vectors(flat)[:, :6]
    else:
        turns = Rotation.from_matrix(flat[:, :3, :3])
        out = np.column_stack([flat[:, :3, 3], turns.as_rotvec()])
    return out.reshape(*T.shape[:-2], out.shape[1])


def d_of(motions: Array) -> int:
    """2 of motions (..., 3) in the plane, 3 of motions (..., 6) in space."""
    return 2 if motions.shape[-1] == 3 else 3


def ways(motions: Array) -> Array:
    """Length of each motion (..., n), m."""
    return norms(motions[..., : d_of(motions)])


def angles(motions: Array) -> Array:
    """Angle by which each motion (..., n) turns, rad, at least 0."""
    return norms(motions[..., d_of(motions) :])


def turn_per_way(motions: Array) -> Array:
    """Angle over length of each motion, rad/m; 0 of one that turns without a way."""
    way = ways(motions)
    return angles(motions) / np.where(way > 0, way, np.inf)


def rests(T: Array) -> Array:
    """Motion from each end of a piece to the end of its window, (W, P + 1, d + 1, d + 1), of pieces as matrices."""
    W, P, size, _ = T.shape
    out = np.empty((W, P + 1, size, size))
    out[:, P] = np.eye(size)
    for k in reversed(range(P)):
        out[:, k] = T[:, k] @ out[:, k + 1]
    return out


# --- numbers of windows -----------------------------------------------------------------------------------------------


def norms(vectors: Array) -> Array:
    """Lengths of vectors (..., n)."""
    return np.asarray(np.linalg.norm(vectors, axis=-1))


def mean_square(errors: Array) -> Array:
    """Mean square of each axis, (W, ...) -> (...)."""
    return np.asarray((errors**2).mean(axis=0))


def root_mean_square(errors: Array) -> Array:
    """Root of the mean square of each axis, (W, n) -> (n,), above 0."""
    return np.maximum(np.sqrt(mean_square(errors)), 1e-150)


def jackknife_blocks(drive: Indices, enough: int = ENOUGH) -> list[Indices]:
    """Windows (W,) in blocks for the jackknife: drives where they are enough, otherwise consecutive windows."""
    names = np.unique(drive)
    if len(names) >= enough:
        return [np.flatnonzero(drive == name) for name in names]
    return np.array_split(np.arange(len(drive)), min(BLOCKS, len(drive)))
