"""How much of its work arrays a trial writes to: memory that nobody touches is never taken.

A trial has arrays for all landmarks at once; it writes to the rows of what it knows and sees, and under local updating
to those of the base. What that comes to follows from which landmarks are seen when.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from consistency.bench.filters.covariance_update.local import (
    Local,
    count,
    count_settling,
    is_due,
    may_split,
    start_counting,
)
from consistency.bench.filters.covariance_update.parking import WORTH, Parking
from consistency.bench.filters.kernel.part_functions import (
    Data,
    Factors,
    Slam,
    landmark_width,
    make_factors,
    make_room,
    make_watch,
    observed_width,
)

NUMBER = 8  # bytes
PAGE = 4096 // NUMBER  # numbers of a page, the least that is taken at a time


class Reach(NamedTuple):
    """The most of a trial in one step: known landmarks seen, those that come back, and variables of each kind."""

    seen: int = 0
    back: int = 0  # of the seen ones, those that may be parked
    width: int = 0  # of the rows that are gathered for an update
    cells: int = 0  # of these rows, their number times their width
    base: int = 0
    active: int = 0

    def with_step(self, *step: int) -> Reach:
        return Reach(*map(max, self, step))


def half(n: int) -> int:
    """Numbers of the pages that hold the upper half of (n, n)."""
    return min(n * n, n * (n + PAGE) // 2)


def touched(slam: Slam, data: Data, size: int, spare: int) -> int:
    """Bytes of work arrays that are written to; the state grows to ``size`` variables and up to ``spare`` more."""
    w, s = landmark_width(slam.landmark), observed_width(slam.sensor)
    local = _tally(slam, w, size + spare)
    reach = _reach(slam, data, w, size + spare, local)
    gathered, a, b = s * reach.seen, reach.active, reach.base
    # S; A and rows; then of the active part P, Phi, Psi, and of the whole rows and owed
    numbers = half(gathered) + reach.cells * s // w + reach.cells
    numbers += a * a + a * b + half(b) + (a + b) * (size + spare)
    most = int(np.diff(data.first).max(initial=1))
    return NUMBER * numbers + _beside(slam, data, (w, s), reach.back, most, size + spare)


def _tally(slam: Slam, w: int, size: int) -> Factors:
    """What local updating counts with, and the active part for which there is room, as its ``make_local`` has it."""
    is_local = isinstance(slam.covariance, Local | Parking) and size >= slam.covariance.start
    return make_factors(3, 3, 1)._replace(x=np.empty(max(size // (2 * w), 1) * w if is_local else 3))


def _beside(slam: Slam, data: Data, widths: tuple[int, int], back: int, most: int, size: int) -> int:
    """Bytes of what the update alone needs for ``back`` landmarks, and the guard for ``most``."""
    w, s = widths
    try:
        room = make_room(slam.update, w, s, back, size)
        watch = make_watch(slam.guard, s, most, len(data.landmark), data.n_landmarks)
    except MemoryError:  # which takes by the square of these
        return 16 * _beside(slam, data, widths, back // 4, most // 4, size // 4)
    return sum(np.asarray(array).nbytes for array in (*room, *watch))


def _reach(slam: Slam, data: Data, w: int, size: int, local: Factors) -> Reach:
    """As the trial keeps its state, step by step."""
    if isinstance(slam.covariance, Parking):
        return _parked(slam.covariance, data, size, local)
    reach, known, active, n, b = Reach(), set[int](), set[int](), 0, 0
    for k in range(len(data.controls)):
        labels = data.landmark[data.first[k] : data.first[k + 1]].tolist()
        whole, seen = 3 + w * len(known), sum(label in known for label in labels)
        if isinstance(slam.covariance, Local):
            if b > 0 and is_due(whole, n, b, w * len(labels), local):
                count_settling(whole, n, b, local)
                b = 0
            if b == 0 and whole >= slam.covariance.start and may_split(w, len(labels), local):
                active = known.intersection(labels)
                n = b = 3 + w * len(active)
                start_counting(b, local)
            if b > 0:
                more = w * len(known.intersection(labels) - active)
                active.update(labels)
                n, b = n + more, b + more
                count(whole, n, b, more, w * len(labels), local)
        width = n + b if b > 0 else whole
        reach = reach.with_step(seen, seen, width, (3 + w * seen) * width if seen else 0, b, n if b > 0 else 0)
        n += w * len(set(labels) - known)
        known.update(labels)
    return reach


def _parked(parking: Parking, data: Data, size: int, factors: Factors) -> Reach:
    """Active is what was seen since it could last be parked, if that is little beside the whole."""
    reach, last, kept = Reach(), np.full(data.n_landmarks, -1), parking.unseen + parking.every
    for k in range(len(data.controls)):
        labels = np.unique(data.landmark[data.first[k] : data.first[k + 1]])
        clones = 3 * (k // parking.every) if parking.every else 0
        whole = min(3 + 3 * int((last >= 0).sum()) + clones, size)
        n, seen = 3 + 3 * int((last >= k - kept).sum()), int((last[labels] >= 0).sum())
        back = int(((last[labels] >= 0) & (last[labels] < k - 1 - parking.unseen)).sum()) if parking.every > 0 else 0
        is_split = parking.every > 0 and n <= len(factors.x) and 2.0 * WORTH * n <= whole and whole >= parking.start
        b, width = (n, 2 * n) if is_split else (0, whole)
        reach = reach.with_step(seen, back, width, (3 + 3 * seen) * width if seen else 0, b, b)
        last[labels] = k
    return reach
