"""Matching of estimates to the truth, and to the steps of other runs, by step or by time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from consistency.referee.types import Array, Indices


def common_steps(steps: Sequence[Array]) -> tuple[list[Indices], Array]:
    """Columns of every run and the step number of every column: the different steps, in order.

    (k,) step numbers for each run -> (k,) columns for each run, and (steps,) numbers.
    """
    numbers = np.unique(np.concatenate(steps))
    return [np.searchsorted(numbers, own).astype(np.int64) for own in steps], numbers


def common_times(times: Sequence[Array], tolerance: float = 1e-6) -> tuple[list[Indices], Array]:
    """Columns of every run and the time of every column, from timestamps in s.

    (k,) times for each run -> (k,) columns for each run, and (steps,) times. Where every run keeps to the timestamps of
    the longest one the columns are its timestamps. Otherwise, as with recordings of different days, estimates are
    counted from the first on, and no column has a time.
    """
    longest = max(times, key=len)
    columns = []
    for own in times:
        near = np.clip(np.searchsorted(longest, own - tolerance), 0, len(longest) - 1)
        if (np.abs(longest[near] - own) > tolerance).any():
            return [np.arange(len(each)) for each in times], np.full(len(longest), np.nan)
        columns.append(near.astype(np.int64))
    return columns, longest


def associate(times: Array, reference: Array, max_dt: float) -> tuple[Indices, Indices]:
    """Indices (k,) of ``times`` (N,) and of their nearest neighbours in ``reference`` (M,), both increasing, in s.

    Pairs further apart than ``max_dt`` are left out. Where two timestamps have the same neighbour the nearer one
    keeps it.
    """
    right = np.clip(np.searchsorted(reference, times), 1, max(len(reference) - 1, 1))
    left = right - 1
    right = np.minimum(right, len(reference) - 1)
    nearest = np.where(np.abs(reference[left] - times) <= np.abs(reference[right] - times), left, right)
    distance = np.abs(reference[nearest] - times)
    order = np.lexsort((distance, nearest))
    order = order[distance[order] <= max_dt + 1e-6]  # a double holds the seconds since 1970 to a quarter of that
    _, first = np.unique(nearest[order], return_index=True)
    own = np.sort(order[first])
    return own, nearest[own]
