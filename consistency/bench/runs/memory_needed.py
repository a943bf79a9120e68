"""How much memory a trial takes, from the shapes that the kernels allocate, and how much there is."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

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

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]

from consistency.bench.filters.compiled import Compiled
from consistency.bench.filters.kernel.part_functions import spare_width
from consistency.bench.scenario import Belief
from consistency.bench.types import Trial
from consistency.referee.errors import InputError
from consistency.referee.system.progress import say

COPIES = 2  # of the joint covariance where a map is scored: as it is, and in the filter's own error
FACTORS = 2  # its Cholesky factor, and LAPACK's copy; of the plane alone where that is all that is seen
WORTH_SAYING = 0.1  # of the memory that there is
GIB = 2**30
NO_LIMIT = 2**60  # version 1 of control groups has no word for it
NUMBER = 8  # bytes
PAGE = 4096 // NUMBER  # numbers of a page, the least that is taken at a time


class Footprint(NamedTuple):
    """Bytes of a filter in a trial: while it runs, of the joint covariance that it leaves, and to score its map."""

    working: int
    joint: int
    scoring: int


def footprint(filter_: Compiled, trial: Trial, belief: Belief) -> Footprint:
    """Memory of a compiled filter on a trial, if every landmark that is observed gets into the state."""
    slam, data, size = filter_._arguments(trial, belief)
    landmarks = len(np.unique(trial.landmark))
    joint, is_flat = NUMBER * (3 * (1 + landmarks)) ** 2, observed_width(slam.sensor) == 2
    factor = NUMBER * (3 + 2 * landmarks) ** 2 if is_flat else joint
    scoring = (COPIES - 1) * joint + (FACTORS + is_flat) * factor
    known = trial.truth is not None and trial.landmarks is not None
    return Footprint(_working(slam, data, size) + _size_of(data) + joint, joint, scoring * known)


def trial_bytes(filters: Sequence[Compiled], trial: Trial, belief: Belief) -> int:
    """The most memory that a trial through all ``filters``, one after the other, takes at a time."""
    held, most, scoring = 0, 0, 0
    for each in (footprint(filter_, trial, belief) for filter_ in filters):
        most, held, scoring = max(most, held + each.working), held + each.joint, max(scoring, each.scoring)
    return max(most, held + scoring) + _size_of(tuple(vars(trial).values()))


def _working(slam: Slam, data: Data, size: int) -> int:
    """What ``run_trial`` writes to: covariance and outcome, which it fills, and a part of what it works with."""
    T, labels = len(data.controls), data.n_landmarks
    spare = spare_width(slam.covariance, T, labels)
    outcome = T * (3 + 2 * 9 + 3) + 12 * labels
    return touched(slam, data, size, spare) + NUMBER * ((size + spare) ** 2 + outcome)


def _size_of(value: Any) -> int:
    if isinstance(value, np.ndarray):
        return int(value.nbytes)
    return sum(map(_size_of, value)) if isinstance(value, tuple) else 0


# --- what there is -------------------------------------------------------------------------------


def memory_here() -> int:
    """Bytes that this process may use: of the machine, its control group (Linux) and what ``ulimit`` leaves."""
    limits = [NO_LIMIT, *_of_groups()]
    if hasattr(os, "sysconf") and "SC_PHYS_PAGES" in os.sysconf_names:
        limits.append(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    if resource is not None:
        for kind, name in ((resource.RLIMIT_AS, "VmSize"), (resource.RLIMIT_DATA, "VmData")):
            soft, _ = resource.getrlimit(kind)
            if soft != resource.RLIM_INFINITY:
                limits.append(max(soft - _taken(name), 0))
    return min(limits)


def _taken(name: str, status: Path = Path("/proc/self/status")) -> int:
    """Bytes that this process has already, as Linux counts them for a limit; 0 where it is not known."""
    try:
        lines = status.read_text(encoding="ascii", errors="replace").splitlines()
        return next(1024 * int(line.split()[1]) for line in lines if line.startswith(name))
    except (OSError, StopIteration):
        return 0


def _of_groups(proc: Path = Path("/proc/self/cgroup"), root: Path = Path("/sys/fs/cgroup")) -> list[int]:
    """Limits of the control groups that this process is in, version 1 or 2, up to the root."""
    try:
        lines = [line.split(":", 2) for line in proc.read_text(encoding="utf-8").splitlines()]
    except OSError:
        return []
    limits = []
    for _, controllers, path in lines:
        if controllers and "memory" not in controllers.split(","):
            continue
        top, name = (root / "memory", "memory.limit_in_bytes") if controllers else (root, "memory.max")
        group = top / path.lstrip("/")
        for folder in (group, *group.parents):
            if folder == top or top in folder.parents:
                limits += _limit_in(folder / name)
    return limits


def _limit_in(path: Path) -> list[int]:
    try:
        return [int(path.read_text(encoding="ascii"))]
    except (OSError, ValueError):  # "max", or not mounted
        return []


def workers_that_fit(filters: Sequence[Compiled], trials: Sequence[Trial], belief: Belief, workers: int) -> int:
    """As many of ``workers`` as have memory for the largest of ``trials``; says so where that is worth a word.

    Raises
    ------
    InputError
        A trial takes more memory than there is.
    """
    if not filters or not trials:
        return workers
    largest = max(trials, key=lambda trial: len(np.unique(trial.landmark)))
    needed, here = trial_bytes(filters, largest, belief), memory_here()
    landmarks = len(np.unique(largest.landmark))
    takes = f"a run of {landmarks} landmarks and {largest.steps} steps takes about {needed / GIB:.1f} GiB"
    if needed > here:
        raise InputError(
            f"{takes}, and there are {here / GIB:.1f} GiB; take fewer landmarks or steps, or a machine with more memory"
        )
    fitting = max(1, min(workers, here // needed))
    if needed > WORTH_SAYING * here:
        fewer = f"; {fitting} of {workers} workers have room" if fitting < workers else ""
        say(f"consistency: {takes} of {here / GIB:.1f} GiB{fewer}")
    return fitting


# --- how much of its work arrays a trial writes to: memory that nobody touches is never taken -------------------
# A trial has arrays for all landmarks at once; it writes to the rows of what it knows and sees, and under local
# updating to those of the base. What that comes to follows from which landmarks are seen when.


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
