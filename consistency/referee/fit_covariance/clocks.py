"""The time by which the clocks of estimates and truth differ, from motions of both, which need no common world."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from consistency.referee.errors import InputError
from consistency.referee.geometry.lie_groups import inverse, log, matrices
from consistency.referee.readers.clock_offset import GRID, MOST, REACH, refined
from consistency.referee.readers.truth_matching import Poses
from consistency.referee.types import Array

LONG = 1.0  # s, of the motions that are compared
KEPT = 0.9  # of the squared errors, the smallest: jumps decide nothing
PARTS = 5  # drives that show how well the offset is known; fewer ones are cut into as many parts
UNSURE = 0.1  # s, standard error of an offset that is not used


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
        last = np.searchsorted(poses.t, poses.t + LONG)
        first = np.flatnonzero(last < len(poses.t))
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
