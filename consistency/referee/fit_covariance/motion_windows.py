"""Windows of one span, which do not overlap, each in a few pieces; jumps and windows without motion are left out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from consistency.referee.errors import InputError
from consistency.referee.fit_covariance.drives import Drive
from consistency.referee.geometry.lie_groups import inverse, log, matrices
from consistency.referee.readers.windows import Relative, relative_of, windows
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
    """W windows of some drives, in P pieces of estimated motion each; a piece that is the identity is none."""

    drives: tuple[Drive, ...] = field(repr=False)
    span: Relative
    is_planar: bool  # x, y and yaw alone, also of motions in space
    drive: Indices  # (W,), index of the drive
    first: Indices  # (W,), rows of the drive
    last: Indices  # (W,)
    pieces: Array  # (W, P, d + 1, d + 1), motions
    true: Array  # (W, d + 1, d + 1), of the whole window
    true_pieces: Array  # (W, P, d + 1, d + 1)
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

    def lengthened(self, slip: float) -> DriveWindows:
        """The same windows with a longer estimated way in each piece that turns."""
        return replace(self, pieces=lengthened(self.pieces, slip))

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
    parts: list[DriveWindows] = []
    refused: InputError | None = None
    for number in range(len(drives)):
        try:
            parts.append(_cut_drive(tuple(drives), number, span, planar, pieces))
        except InputError as error:
            refused = error
    if not parts:
        assert refused is not None
        raise refused
    rows: dict[str, Any] = {}
    for name in ROWS:
        rows[name] = np.concatenate([getattr(part, name) for part in parts])
    found = replace(parts[0], **rows, long=sum(part.long for part in parts))
    moves = _moves(found)
    jumps = _jumps(found)
    sound = moves & ~jumps
    if not sound.any():
        raise InputError(f"--span {span.option}: no window of {drives[0].name} has motion without a jump; take another")
    still = int((~moves).sum())
    return replace(found, still=still, jumps=int((moves & jumps).sum())).of(sound)


def _cut_drive(
    drives: tuple[Drive, ...],
    number: int,
    span: Relative,
    planar: bool,
    pieces: int,
) -> DriveWindows:
    drive = drives[number]
    position = drive.truth[:, :-1, -1]
    rows = drive.row if span.unit == "step" else np.arange(len(position))
    first, last, left_out = windows(drive.t, position, rows, span, drive.name)
    first = np.searchsorted(rows, first)
    last = np.searchsorted(rows, last)
    ends = _ends(first, last, pieces)
    estimated = motions_between(drive.estimate, ends[:, :-1], ends[:, 1:])
    true_pieces = motions_between(drive.truth, ends[:, :-1], ends[:, 1:])
    true = motions_between(drive.truth, first, last)
    if planar and drive.d == 3:
        estimated = in_plane(estimated)
        true_pieces = in_plane(true_pieces)
        true = in_plane(true)
    index = np.full(len(first), number)
    return DriveWindows(drives, span, planar, index, first, last, estimated, true, true_pieces, left_out)


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
    return np.asarray((way > STILL * np.median(way)) | (angle > STILL * np.median(angle)))


def _jumps(of: DriveWindows) -> Array:
    """Which windows have a piece whose error, of position or rotation, is a jump in its drive, (W,)."""
    W, P = of.pieces.shape[:2]
    gaps = inverse(of.pieces) @ of.true_pieces
    flat = gaps.reshape(W * P, of.d + 1, of.d + 1)
    errors = log(flat).reshape(W, P, -1)
    ends = _ends(of.first, of.last, P)
    errors[ends[:, 1:] == ends[:, :-1]] = np.nan  # a piece without a row
    positions = slice(0, of.d), 0.0
    rotations = slice(of.d, None), ROUNDED
    found = np.zeros(W, bool)
    for part, least in (positions, rotations):
        of_pieces = norms(errors[..., part])
        of_windows = norms(of.errors[:, part])
        for drive in np.unique(of.drive):
            rows = of.drive == drive
            by_pieces = JUMP_OF_PIECES * float(np.nanmedian(of_pieces[rows]))
            by_windows = JUMP_OF_WINDOWS * float(np.median(of_windows[rows]))
            limit = max(by_pieces, by_windows, least)
            exceeds = np.nan_to_num(of_pieces[rows]) > limit
            found[rows] |= exceeds.any(axis=1) & (limit > 0)
    return found


# --- motions in pieces ------------------------------------------------------------------------------------------------


def motions_between(T: Array, first: Indices, last: Indices) -> Array:
    """Motions between rows of poses (N, d + 1, d + 1), in the frame of the first."""
    return inverse(T[first]) @ T[last]


def in_plane(T: Array) -> Array:
    """Motions in space (..., 4, 4) as x, y and yaw, (..., 3, 3); yaw is the direction of the x axis."""
    yaw = np.arctan2(T[..., 1, 0], T[..., 0, 0])
    poses = np.concatenate([T[..., :2, 3], yaw[..., None]], axis=-1)
    flat = matrices(poses.reshape(-1, 3))
    return flat.reshape(*yaw.shape, 3, 3)


def rests(pieces: Array) -> Array:
    """Motion from the beginning of each piece to the end of its window, (W, P, ...) -> (W, P + 1, ...)."""
    W, P, m, _ = pieces.shape
    out = np.empty((W, P + 1, m, m))
    out[:, P] = np.eye(m)
    for k in reversed(range(P)):
        out[:, k] = pieces[:, k] @ out[:, k + 1]
    return out


def ways(pieces: Array) -> Array:
    """Length of each piece, (W, P), m."""
    return norms(pieces[..., :-1, -1])


def rotation_vectors(pieces: Array) -> Array:
    """Rotation vectors (W, P, 3), or (W, P, 1) in the plane, rad."""
    if pieces.shape[-1] == 3:
        return np.arctan2(pieces[..., 1, 0], pieces[..., 0, 0])[..., None]
    shape = (*pieces.shape[:2], 3)
    if pieces.size == 0:
        return np.empty(shape)
    turns = Rotation.from_matrix(pieces[..., :3, :3].reshape(-1, 3, 3))
    return np.asarray(turns.as_rotvec().reshape(shape))


def angles(pieces: Array) -> Array:
    """Angle by which each piece turns, (W, P), rad, at least 0."""
    return norms(rotation_vectors(pieces))


def rotated(pieces: Array, vectors: Array) -> Array:
    """Pieces with other rotations, of rotation vectors (W, P, 3) or (W, P, 1)."""
    out = np.array(pieces)
    if pieces.shape[-1] == 3:
        out[..., 0, 0] = out[..., 1, 1] = np.cos(vectors[..., 0])
        out[..., 1, 0] = np.sin(vectors[..., 0])
        out[..., 0, 1] = -out[..., 1, 0]
    elif pieces.size:
        turns = Rotation.from_rotvec(vectors.reshape(-1, 3))
        out[..., :3, :3] = turns.as_matrix().reshape(*pieces.shape[:2], 3, 3)
    return out


def turn_per_way(pieces: Array) -> Array:
    """Angle over length of each piece, (W, P), rad/m; 0 where a piece turns without a way."""
    way = ways(pieces)
    return angles(pieces) / np.where(way > 0, way, np.inf)


def lengthened(pieces: Array, slip: float) -> Array:
    """Motions whose way is longer by ``slip`` for each radian of their turn; none goes backwards by this."""
    out = np.array(pieces)
    factor = np.maximum(1.0 + slip * turn_per_way(pieces), 0.0)
    out[..., :-1, -1] *= factor[..., None]
    return out


# --- numbers of windows -----------------------------------------------------------------------------------------------


def norms(vectors: Array) -> Array:
    """Lengths of vectors (..., n)."""
    return np.asarray(np.linalg.norm(vectors, axis=-1))


def mean_square(errors: Array) -> Array:
    """Mean square of each axis, (W, ...) -> (...)."""
    return np.asarray((errors**2).mean(axis=0))


def blocks_of(drive: Indices, enough: int = ENOUGH) -> list[Indices]:
    """Windows (W,) in blocks for the jackknife: drives where they are enough, otherwise consecutive windows."""
    names = np.unique(drive)
    if len(names) >= enough:
        return [np.flatnonzero(drive == name) for name in names]
    return np.array_split(np.arange(len(drive)), min(BLOCKS, len(drive)))
