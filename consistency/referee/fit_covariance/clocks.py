"""The time by which the clocks of estimates and truth differ, from motions of both, which need no common world."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import optimize, stats

from consistency.referee.defaults import CONFIDENCE
from consistency.referee.errors import InputError
from consistency.referee.geometry.groups import inverse, log, matrices
from consistency.referee.readers.clock_offset import MOST, REACH
from consistency.referee.readers.truth_matching import Poses, truth_at
from consistency.referee.types import Array

LONG = 1.0  # s, of the motions that are compared
KEPT = 0.9  # of the squared errors, the smallest: jumps decide nothing
PARTS = 5  # drives that show how far the offset is known; fewer ones are cut into as many parts
UNSURE = 0.1  # s, half the interval of an offset that is not used
GRID = np.concatenate([-np.geomspace(0.004, REACH, 12)[::-1], [0.0], np.geomspace(0.004, REACH, 12)])


class Motions(NamedTuple):
    """Estimated motions (k, d + 1, d + 1) between times (k,), s, beside the samples of the truth."""

    begin: Array
    end: Array
    motions: Array
    poses: Poses

    def of(self, rows: Array) -> Motions:
        return Motions(self.begin[rows], self.end[rows], self.motions[rows], self.poses)

    def squares(self, shift: float) -> Array:
        """Squared errors (k, 2) of positions and rotations with the truth ``shift`` s later; NaN where it is not known."""
        ends, p = [], self.poses
        for t in (self.begin, self.end):
            known = truth_at(t + shift, p.true_t, p.truth, p.manifold, p.max_dt)
            T = np.full(self.motions.shape, np.nan)
            T[known.rows] = matrices(known.truth)
            ends.append(T)
        out = np.full((len(self.begin), 2), np.nan)
        fine = np.isfinite(ends[0] + ends[1]).all(axis=(1, 2))
        error = log(inverse(self.motions[fine]) @ inverse(ends[0][fine]) @ ends[1][fine])
        d = self.motions.shape[-1] - 1
        out[fine] = np.column_stack([(error[:, part] ** 2).sum(axis=1) for part in (slice(0, d), slice(d, None))])
        return out


def clock_offset(drives: Sequence[tuple[Poses, Array]]) -> float:
    """Time to add to the timestamps of the estimates, s, one for all drives.

    The offset minimises the squared errors of motions over a second, of positions times rotations, so that no scale of
    either decides; the largest are left out. Its interval is that of Student for the offsets of drives or their parts.

    Parameters
    ----------
    drives : poses, and their estimates as matrices (N, d + 1, d + 1)

    Raises
    ------
    InputError
        The motions do not tell it.
    """
    found = [_motions(poses, T, MOST // len(drives)) for poses, T in drives]
    each = -(-PARTS // len(found))
    parts = [m.of(rows) for m in found for rows in np.array_split(np.arange(len(m.begin)), each) if len(rows)]
    values = np.array([_best([part]) for part in parts])
    k, value = len(values), _best(found) if found else np.nan
    reach = float(stats.t.isf(0.5 * (1 - CONFIDENCE), k - 1) * values.std(ddof=1) / np.sqrt(k)) if k > 1 else np.inf
    if not reach <= UNSURE:
        raise InputError(
            "--time-offset estimate: the motions do not tell it, because nothing moves unevenly, or the offset is more "
            f"than {REACH:g} s; give seconds"
        )
    return value


def _motions(poses: Poses, T: Array, most: int) -> Motions:
    """Motions over ``LONG`` s, at most ``most``, evenly chosen."""
    end = np.searchsorted(poses.t, poses.t + LONG)
    begin = np.flatnonzero(end < len(poses.t))
    begin = begin[np.unique(np.linspace(0, len(begin) - 1, min(most, len(begin))).astype(int))]
    end = end[begin]
    return Motions(poses.t[begin], poses.t[end], inverse(T[begin]) @ T[end], poses)


def _best(motions: Sequence[Motions]) -> float:
    """The offset of the smallest error; NaN where none is smaller than others, or it is at the end of what is tried."""

    def size(shift: float) -> float:
        squares = np.sort(np.concatenate([each.squares(shift) for each in motions]), axis=0)  # NaN last
        known = int(np.isfinite(squares[:, 0]).sum())
        return float(np.log(np.maximum(squares[: max(int(KEPT * known), 1)].mean(axis=0), 1e-300)).sum())

    sizes = np.array([size(shift) for shift in GRID])
    best = int(np.argmin(np.where(np.isfinite(sizes), sizes, np.inf)))
    if best in (0, len(GRID) - 1) or not np.ptp(sizes[np.isfinite(sizes)]) > 1e-6:
        return float("nan")
    bounds = GRID[best - 1], GRID[best + 1]
    found = optimize.minimize_scalar(size, bounds=bounds, method="bounded", options={"xatol": 1e-4})
    return float(found.x if found.fun < sizes[best] else GRID[best])
