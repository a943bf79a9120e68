"""Doing a sweep: every filter in every cell of a share, beside other processes that do the same."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path

from consistency.bench.filters import get_filter
from consistency.bench.runs.backends.local import worker_count
from consistency.bench.runs.compiling import compile_all, first_trials
from consistency.bench.store.journal import Busy, Journal
from consistency.bench.sweeps.cell import CellResult, run_cell
from consistency.bench.sweeps.plan import Sweep
from consistency.bench.sweeps.sweep_folder import CellWork, SweepFolder
from consistency.referee.errors import InputError
from consistency.referee.system.folders import unfinished_of
from consistency.referee.system.progress import say

LOOKED_AT = 400  # cells whose kernels are compiled ahead, 10 ms each; cells of one grid differ little
PAUSE = 1.0  # s, between looks at whether another process has done what is left


def run_sweep(
    sweep: Sweep,
    out: Path,
    part: int = 1,
    parts: int = 1,
    jobs: int = -1,
    overwrite: bool = False,
    executor: Executor | None = None,
) -> tuple[SweepFolder, int]:
    """Do what is not done yet of a share, each filter in each cell by itself.

    Finished runs of a cell are kept in a journal until the cell is done, so that the same call goes on within it.

    Parameters
    ----------
    out : folder, which may hold a part of the same sweep; several processes may write into it, and do no cell twice
    part, parts : this share, 1 to ``parts``
    overwrite : run cells again that were made with other inputs
    executor : does the runs, in place of ``jobs`` threads of this process

    Returns
    -------
    The folder, and how much of the whole sweep is missing

    Raises
    ------
    InputError
        The folder is something else's, or holds cells that were made with other inputs; a number out of range.
    KeyboardInterrupt
        Ctrl-C; what is finished is kept.
    """
    if not 1 <= part <= parts:
        raise InputError(f"--share {part}/{parts}: must be I/N with I from 1 to N")
    worker_count(jobs)
    folder = SweepFolder(sweep, Path(out))
    folder.require_usable(overwrite)
    share = folder.all_work(part, parts)
    folder.begin()
    # unfinished work is of a process at work, or of one that was killed as it ended
    todo = [work for work in share if folder.fresh(work) is None or unfinished_of(folder.place(work)).exists()]
    if len(todo) < len(share):
        say(f"{len(share) - len(todo)} of {len(share)} are there already")
    if executor is None:
        with suppress(Exception):  # what breaks a cell is said of it
            _compile(sweep, todo, jobs)
    for count, (work, seconds) in enumerate(_in_turn(folder, todo, partial(_do, jobs, executor)), 1):
        left = _left(seconds * (len(todo) - count))
        say(f"{count} of {len(todo)}: {work.text}: {_said(folder.done(work))}{left}")
    missing = sum(folder.fresh(work) is None for work in folder.all_work())
    return folder, missing


def _compile(sweep: Sweep, todo: Sequence[CellWork], jobs: int) -> None:
    """Compile what the cells need before the first, so that the time left is that of cells."""
    some = todo[:: len(todo) // LOOKED_AT + 1]
    names = ((name, work.cell.scenario) for work in some for name in (work.filter, sweep.reference))
    compile_all(first_trials((get_filter(name), world) for name, world in names), worker_count(jobs))


def _in_turn(
    folder: SweepFolder, todo: Sequence[CellWork], do: Callable[[SweepFolder, CellWork, Journal], None]
) -> Iterator[tuple[CellWork, float]]:
    """Do all of it, and give each when it is there, with the mean time of those that were done here.

    What another process is at work on is come back to.
    """
    waiting, is_said, count, started = deque(todo), False, 0, time.monotonic()
    while waiting:
        busy: deque[CellWork] = deque()
        for work in waiting:
            try:
                with _refusals(folder), folder.at_work(work) as journal:
                    if folder.fresh(work) is None:  # nobody has done it meanwhile
                        do(folder, work, journal)
                        count += 1
            except Busy:
                busy.append(work)
            else:
                yield work, (time.monotonic() - started) / max(count, 1)
        if len(busy) == len(waiting):
            if not is_said:
                say(f"waiting for another process, which is at work on the last {len(busy)}")
            is_said = True
            time.sleep(PAUSE)
        waiting = busy


def _do(jobs: int, executor: Executor | None, folder: SweepFolder, work: CellWork, journal: Journal) -> None:
    begun = time.monotonic()
    outcome = run_cell(folder.sweep, work.cell, work.filter, jobs, executor, journal)
    folder.write(work, outcome, time.monotonic() - begun)


@contextmanager
def _refusals(folder: SweepFolder) -> Iterator[None]:
    """What the system refuses, in one sentence."""
    try:
        yield
    except OSError as error:
        raise InputError(
            f"--out {folder.path}: {error.strerror or error}; what is finished is there, and the same command goes on"
        ) from error


def _said(result: CellResult | None) -> str:
    if result is None:
        return "removed meanwhile"
    return f"{result.status} after {result.runs} runs" if result.runs else result.diagnosis


def _left(seconds: float) -> str:
    return (
        f"; {seconds / 60.0:.0f} min left" if seconds >= 90.0 else f"; {seconds:.0f} s left" if seconds >= 1.0 else ""
    )
