"""Windows of one span, which do not overlap, each in a few pieces; jumps and windows without motion are left out.

A piece is a motion as a vector (n,): its shift, in the frame of its beginning, and its rotation vector.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from consistency.referee.errors import InputError
from consistency.referee.fit_covariance.drives import Drive
from consistency.referee.geometry import inverse, log, matrices, vectors
from consistency.referee.readers.runs_to_record import Relative, relative_of, windows
from consistency.referee.types import Array, Indices

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
        return rests(self.pieces)[:, 0]

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
            first, last, left_out = _rows_of_windows(drive, span)
        except InputError as error:
            refused.append(error)
            continue
        ends = _ends(first, last, pieces)
        estimated = motions_between(drive.estimate, ends[:, :-1], ends[:, 1:], planar)
        true_pieces = motions_between(drive.truth, ends[:, :-1], ends[:, 1:], planar)
        true = motion_matrices(motions_between(drive.truth, first, last, planar))
        parts.append((np.full(len(first), number), first, last, estimated, true, true_pieces))
        long += left_out
    if not parts:
        raise refused[-1]
    rows: dict[str, Any] = dict(zip(ROWS, map(np.concatenate, zip(*parts, strict=True)), strict=True))
    found = DriveWindows(tuple(drives), span, planar, **rows, long=long)
    moves = _moves(found)
    jumps = _jumps(found)
    sound = moves & ~jumps
    if not sound.any():
        raise InputError(f"--span {span.option}: no window of {drives[0].name} has motion without a jump; take another")
    counted = replace(found, still=int((~moves).sum()), jumps=int((moves & jumps).sum()))
    return counted.of(sound)


def _rows_of_windows(drive: Drive, span: Relative) -> tuple[Indices, Indices, int]:
    """First and last row of each window of a drive, and how many are left out."""
    rows = drive.row if span.unit == "step" else np.arange(len(drive.t))
    first, last, left_out = windows(drive.t, drive.truth[:, :-1, -1], rows, span, drive.name)
    return np.searchsorted(rows, first), np.searchsorted(rows, last), left_out


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


def rests(pieces: Array) -> Array:
    """Motion from the beginning of each piece to the end of its window, (W, P, n) -> (W, P + 1, d + 1, d + 1)."""
    T = motion_matrices(pieces)
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
