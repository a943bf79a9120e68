"""Doing a sweep: every filter in every cell, beside other processes that do the same."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from consistency.bench.runs.local_workers import worker_count
from consistency.bench.store.journal import Busy
from consistency.bench.sweeps.run_cell import CellResult, run_cell
from consistency.bench.sweeps.sweep_file import Sweep
from consistency.bench.sweeps.sweep_folder import CellWork, SweepFolder
from consistency.referee.errors import InputError
from consistency.referee.system.folders import unfinished_of
from consistency.referee.system.progress import say

PAUSE = 1.0  # s, between looks at whether another process has done what is left


def run_sweep(sweep: Sweep, out: Path, overwrite: bool = False, jobs: int = -1, **how: Any) -> SweepFolder:
    """Do what is not done yet, each filter in each cell by itself.

    Finished runs of a cell are kept in a journal until the cell is done, so that the same call continues within it.
    Several processes may write into one folder; no cell is done twice.

    Parameters
    ----------
    out : folder, which may hold a part of the same sweep
    overwrite : run cells again that were made with other inputs
    jobs, how : who does the runs, as for :func:`consistency.bench.runs.run_until_decided.run_until_decided`

    Raises
    ------
    InputError
        The folder is something else's, or holds cells that were made with other inputs; a number out of range.
    """
    worker_count(jobs)
    folder = SweepFolder(sweep, Path(out))
    folder.require_usable(overwrite)
    folder.begin()
    work = folder.all_work()
    # unfinished work is of a process at work, or of one that was killed as it ended
    todo = [
        cell_work
        for cell_work in work
        if folder.result(cell_work) is None or unfinished_of(folder.place(cell_work)).exists()
    ]
    if len(todo) < len(work):
        say(f"{len(work) - len(todo)} of {len(work)} are there already")
    started = time.monotonic()
    for count, done in enumerate(_in_turn(folder, todo, {"jobs": jobs, **how}), 1):
        seconds_left = (time.monotonic() - started) / count * (len(todo) - count)
        say(f"{count} of {len(todo)}: {done.text}: {_outcome_text(folder.result(done))}{_time_left(seconds_left)}")
    return folder


def _in_turn(folder: SweepFolder, todo: list[CellWork], how: dict[str, Any]) -> Iterator[CellWork]:
    """Do each, and yield it when it is there; what another process is at work on is tried again after the others."""
    is_told = False
    while todo:
        busy_cells = []
        for work in todo:
            try:
                with _system_refusals(folder), folder.at_work(work) as journal:
                    if folder.result(work) is None:  # nobody has done it meanwhile
                        begun = time.monotonic()
                        outcome = run_cell(folder.sweep, work.cell, work.filter, journal=journal, **how)
                        folder.write(work, outcome, time.monotonic() - begun)
            except Busy:
                busy_cells.append(work)
            else:
                yield work
        if len(busy_cells) == len(todo):
            if not is_told:
                say(f"waiting for another process, which is at work on the last {len(busy_cells)}")
            is_told = True
            time.sleep(PAUSE)
        todo = busy_cells


@contextmanager
def _system_refusals(folder: SweepFolder) -> Iterator[None]:
    """Say what the system refuses in one sentence."""
    try:
        yield
    except OSError as error:
        raise InputError(
            f"--out {folder.path}: {error.strerror or error}; what is finished is there, and the same command continues"
        ) from error


def _outcome_text(result: CellResult | None) -> str:
    if result is None:
        return "removed meanwhile"
    return f"{result.status} after {result.runs} runs" if result.runs else result.diagnosis


def _time_left(seconds: float) -> str:
    if seconds >= 90.0:
        return f"; {seconds / 60.0:.0f} min left"
    return f"; {seconds:.0f} s left" if seconds >= 1.0 else ""
