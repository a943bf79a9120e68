"""Fewer points for a line on a screen or a page, its extremes kept."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from consistency.referee.types import Array, Indices

LIMIT = 2000  # points a line: more than a chart is wide in pixels


def thin(*lines: Array, limit: int = LIMIT) -> Indices:
    """Rows to keep of lines (T,) on one axis, at most about ``limit``; all where there are fewer.

    The rows are cut into equal pieces, and each piece keeps where every line has its least and its
    greatest value, so that no peak is lost. The first and the last row stay.
    """
    steps = len(lines[0])
    if steps <= limit:
        return np.arange(steps)
    pieces = max(1, (limit - 2) // (2 * len(lines)))
    edges = np.linspace(0, steps, pieces + 1).astype(np.int64)
    keep = {0, steps - 1}
    for start, end in pairwise(edges):
        for line in lines:
            piece = line[start:end]
            if np.isfinite(piece).any():
                keep |= {start + int(np.nanargmin(piece)), start + int(np.nanargmax(piece))}
            else:
                keep.add(int(start))
    return np.array(sorted(keep), dtype=np.int64)
