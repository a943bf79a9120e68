"""How much memory a trial takes, from the shapes that the kernels allocate, and how much there is."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]

from consistency.bench.filters.compiled import Compiled
from consistency.bench.filters.kernel.part_functions import Data, Slam, observed_width, spare_width
from consistency.bench.runs.memory_touched import NUMBER, touched
from consistency.bench.scenario import Belief
from consistency.bench.types import Trial
from consistency.referee.errors import InputError
from consistency.referee.system.progress import say

COPIES = 2  # of the joint covariance where a map is scored: as it is, and in the filter's own error
FACTORS = 2  # its Cholesky factor, and LAPACK's copy; of the plane alone where that is all that is seen
WORTH_SAYING = 0.1  # of the memory that there is
GIB = 2**30
NO_LIMIT = 2**60  # version 1 of control groups has no word for it


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
