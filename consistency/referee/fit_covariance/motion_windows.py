"""Windows of one span, which do not overlap, each in a few pieces; jumps and windows without motion are left out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from consistency.referee.errors import InputError
from consistency.referee.fit_covariance.drives import Drive
from consistency.referee.geometry.groups import inverse, log
from consistency.referee.readers.windows import Relative, relative_of, windows
from consistency.referee.types import Array, Indices

PIECES = 20  # of a window: sums over them are independent of the rate of the file, and as good as integrals
STILL = 0.1  # of the span: a window with less motion says nothing about the span
JUMP = (12.0, 3.0)  # medians of the errors of its drive's pieces, and windows, that a piece exceeds in a jump
BLOCKS = 20  # of windows, where drives are too few for the jackknife
ENOUGH = 5  # drives for which they are the blocks
ROUNDED = 1e-4  # rad, of rotation errors that neither jump nor grow: a file with four digits has them
PLANE, SPACE = ("x", "y", "yaw"), ("x", "y", "z", "roll", "pitch", "yaw")


@dataclass(frozen=True)
class DriveWindows:
    """W windows of some drives, in P pieces of estimated motion each; a piece that is the identity is none."""

    span: Relative
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
    def cut(self) -> float:
        return self.jumps / max(len(self.drive) + self.jumps, 1)

    def of(self, keep: Indices | Array) -> DriveWindows:
        names = ("drive", "first", "last", "pieces", "true", "true_pieces")
        return replace(self, **{name: getattr(self, name)[keep] for name in names})


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


def cut_windows(drives: Sequence[Drive], span: Relative, planar: bool = False, pieces: int = PIECES) -> DriveWindows:
    """The windows of all drives; drives in which none fits have none.

    Parameters
    ----------
    planar : x, y and yaw alone of motions in space
    pieces : of a window

    Raises
    ------
    InputError
        No window fits in any drive.
    """
    parts, long, refused = [], 0, None
    for number, drive in enumerate(drives):
        try:
            position = drive.truth[:, : drive.d, drive.d]
            rows = drive.row if span.unit == "step" else np.arange(len(position))
            first, last, skipped = windows(drive.t, position, rows, span, drive.name)
        except InputError as error:
            refused = error
            continue
        long += skipped
        first, last = np.searchsorted(rows, first), np.searchsorted(rows, last)
        parts.append(_pieces(number, drive, first, last, planar, pieces))
    if not parts:
        assert refused is not None
        raise refused
    index, first, last, motions, true, true_pieces, errors = (np.concatenate(each) for each in zip(*parts, strict=True))
    found = DriveWindows(span, index, first, last, motions, true, true_pieces, long)
    moved, jumped = _moves(found), _jumps(errors, found)
    found = replace(found, still=int((~moved).sum()), jumps=int((moved & jumped).sum()))
    if not (moved & ~jumped).any():
        raise InputError(f"--span {span.option}: no window of {drives[0].name} has motion without a jump; take another")
    return found.of(moved & ~jumped)


def windows_at(drives: Sequence[Drive], windows: DriveWindows, size: float, planar: bool) -> DriveWindows | None:
    """The windows of all drives over a span of another size, in pieces of the same size; None where none fits.

    Turns of another size would hold another share of the noise.
    """
    pieces = max(round(PIECES * size / windows.span.size), 1)
    try:
        return cut_windows(drives, replace(windows.span, size=size), planar, pieces)
    except InputError:
        return None


def _pieces(
    number: int, drive: Drive, first: Indices, last: Indices, planar: bool, pieces: int
) -> tuple[Indices, Indices, Indices, Array, Array, Array, Array]:
    """Windows of one drive: index, rows, pieces (W, P, ...), true motions and pieces, errors of pieces (W, P, n)."""
    share = np.linspace(0.0, 1.0, pieces + 1)
    ends = np.rint(first[:, None] + share * (last - first)[:, None]).astype(np.int64)
    T, true = drive.estimate, drive.truth
    D, M = (inverse(each[ends[:, :-1]]) @ each[ends[:, 1:]] for each in (T, true))
    whole = inverse(true[first]) @ true[last]
    if planar and drive.d == 3:
        D, M, whole = (in_plane(each) for each in (D, M, whole))
    error = log((inverse(D) @ M).reshape(-1, *D.shape[-2:])).reshape(*D.shape[:2], -1)
    error[ends[:, 1:] == ends[:, :-1]] = np.nan
    return np.full(len(first), number), first, last, D, whole, M, error


def in_plane(T: Array) -> Array:
    """Motions in space (..., 4, 4) as x, y and yaw, (..., 3, 3); yaw is the direction of the x axis."""
    out = np.zeros((*T.shape[:-2], 3, 3))
    yaw = np.arctan2(T[..., 1, 0], T[..., 0, 0])
    out[..., 0, 0] = out[..., 1, 1] = np.cos(yaw)
    out[..., 1, 0] = np.sin(yaw)
    out[..., 0, 1] = -out[..., 1, 0]
    out[..., :2, 2], out[..., 2, 2] = T[..., :2, 3], 1.0
    return out


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
    d = pieces.shape[-1] - 1
    return np.asarray(np.linalg.norm(pieces[..., :d, d], axis=-1))


def rotation_vectors(pieces: Array) -> Array:
    """Rotation vectors (W, P, 3), or (W, P, 1) in the plane, rad."""
    if pieces.shape[-1] == 3:
        return np.arctan2(pieces[..., 1, 0], pieces[..., 0, 0])[..., None]
    flat = pieces[..., :3, :3].reshape(-1, 3, 3)
    vectors = Rotation.from_matrix(flat).as_rotvec() if len(flat) else np.empty((0, 3))
    return np.asarray(vectors.reshape(*pieces.shape[:2], 3))


def lengthened(pieces: Array, slip: float) -> Array:
    """Motions whose way is longer by ``slip`` for each radian of their turn; none goes backwards by this."""
    out, d, way = np.array(pieces), pieces.shape[-1] - 1, ways(pieces)
    turn = np.linalg.norm(rotation_vectors(pieces), axis=-1)
    out[..., :d, d] *= np.maximum(1.0 + slip * turn / np.where(way > 0, way, np.inf), 0.0)[..., None]
    return out


def _moves(of: DriveWindows) -> Array:
    """Which windows have motion, (W,): on the way, for a span in m; in way or turn, compared with others, otherwise."""
    way = ways(of.pieces).sum(axis=1)
    if of.span.unit == "m":
        return np.asarray(way >= STILL * of.span.size)
    turn = np.linalg.norm(rotation_vectors(of.pieces), axis=-1).sum(axis=1)
    return np.asarray((way > STILL * np.median(way)) | (turn > STILL * np.median(turn)))


def _jumps(errors: Array, of: DriveWindows) -> Array:
    """Which windows have a piece whose error (W, P, n), of position or rotation, is a jump in its drive, (W,)."""
    out, whole = np.zeros(len(errors), bool), of.errors
    for part, least in ((slice(0, of.d), 0.0), (slice(of.d, None), ROUNDED)):
        pieces, windows = (np.linalg.norm(each[..., part], axis=-1) for each in (errors, whole))
        for drive in np.unique(of.drive):
            rows = of.drive == drive
            medians = float(np.nanmedian(pieces[rows])), float(np.median(windows[rows]))
            limit = max(JUMP[0] * medians[0], JUMP[1] * medians[1], least)
            out[rows] |= (np.nan_to_num(pieces[rows]) > limit).any(axis=1) & (limit > 0)
    return out


def blocks_of(drive: Indices, enough: int = ENOUGH) -> list[Indices]:
    """Windows (W,) in blocks for the jackknife: drives where they are enough, otherwise consecutive windows."""
    names = np.unique(drive)
    if len(names) >= enough:
        return [np.flatnonzero(drive == name) for name in names]
    return [part for part in np.array_split(np.arange(len(drive)), min(BLOCKS, len(drive))) if len(part)]
