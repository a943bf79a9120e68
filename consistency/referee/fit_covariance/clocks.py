"""The time by which the clocks of estimates and truth differ, from motions of both, which need no common world."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import optimize

from consistency.referee.errors import InputError
from consistency.referee.geometry.groups import inverse, log, matrices
from consistency.referee.readers.clock_offset import MOST, REACH
from consistency.referee.readers.truth_matching import Poses, truth_at
from consistency.referee.types import Array

LONG = 1.0  # s, of the motions that are compared
KEPT = 0.9  # of the squared errors, the smallest: jumps decide nothing
PARTS = 5  # drives that show how well the offset is known; fewer ones are cut into as many parts
UNSURE = 0.1  # s, standard error of an offset that is not used
STEPS = np.geomspace(0.004, REACH, 12)
GRID = np.concatenate([-STEPS[::-1], [0.0], STEPS])


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
    parts = []
    for poses, T in drives:
        last = np.searchsorted(poses.t, poses.t + LONG)
        first = np.flatnonzero(last < len(poses.t))
        some = first[:: max(len(first) * len(drives) // MOST, 1)]
        for rows in np.array_split(some, -(-PARTS // len(drives))):
            parts.append((poses, poses.t[[rows, last[rows]]], inverse(T[rows]) @ T[last[rows]]))
    values = [_best([part]) for part in parts if len(part[2])]
    value = _best(parts) if len(values) > 1 else np.nan
    if not np.isfinite(value) or not np.std(values, ddof=1) < UNSURE * np.sqrt(len(values)):
        raise InputError(
            "--time-offset estimate: the motions do not tell it, because nothing moves unevenly, or the offset is more "
            f"than {REACH:g} s; give seconds"
        )
    return value


def _best(parts: Sequence[tuple[Poses, Array, Array]]) -> float:
    """The offset with the smallest errors; NaN where that is at an end of ``GRID``, or no offset is better."""

    def size(shift: float) -> float:
        squares = np.sort(np.concatenate([_squares(*part, shift) for part in parts]), axis=0)
        return float(np.log(squares[: max(int(KEPT * len(squares)), 1)].mean(axis=0) + 1e-300).sum())

    sizes = np.array([size(shift) for shift in GRID])
    best = int(np.nanargmin(np.append(sizes, np.inf)))
    if best in (0, len(GRID) - 1, len(GRID)) or not np.nanmax(sizes) - sizes[best] > 1e-6:
        return float("nan")
    found = optimize.minimize_scalar(
        size, bounds=(GRID[best - 1], GRID[best + 1]), method="bounded", options={"xatol": 1e-4}
    )
    return float(found.x if found.fun < sizes[best] else GRID[best])


def _squares(p: Poses, t: Array, motions: Array, shift: float) -> Array:
    """Squared errors (k, 2) of positions and rotations, with the truth ``shift`` s later, where it is known.

    The motions (K, d + 1, d + 1) are between times (2, K).
    """
    ends = np.full((2, *motions.shape), np.nan)
    for T, times in zip(ends, t + shift, strict=True):
        known = truth_at(times, p.true_t, p.truth, p.manifold, p.max_dt)
        T[known.rows] = matrices(known.truth)
    fine, d = np.isfinite(ends).all(axis=(0, 2, 3)), motions.shape[-1] - 1
    error = log(inverse(motions[fine]) @ inverse(ends[0, fine]) @ ends[1, fine])
    return np.column_stack([(error[:, :d] ** 2).sum(axis=1), (error[:, d:] ** 2).sum(axis=1)])
