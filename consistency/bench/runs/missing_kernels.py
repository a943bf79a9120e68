"""Kernels compiled before they are needed: which are missing, and several side by side."""

from __future__ import annotations

import contextlib
import os
import pickle
import signal
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import wait
from multiprocessing.connection import Connection
from typing import NamedTuple

from joblib.externals.loky import ProcessPoolExecutor
from joblib.externals.loky.backend import get_context
from joblib.externals.loky.backend.reduction import dumps

from consistency.bench.filters.compiled import Compiled
from consistency.bench.filters.compiler import disk_cache
from consistency.bench.filters.compiler.jit import Outlook
from consistency.bench.filters.filter_declarations import name_of
from consistency.bench.protocols import Filter, WholeTrial
from consistency.bench.scenario import Belief, Scenario
from consistency.bench.simulation import require_landmarks_in_view
from consistency.bench.types import Trial
from consistency.referee.errors import InputError
from consistency.referee.system import progress
from consistency.referee.system.stopping import away_from_signals, end_with_parent, link_to_parent

NAMED = 3  # filters that are named where several are compiled
EACH = "10 to 60 s for each"
Wanted = tuple[Filter, Trial, Belief]  # a filter, and a trial that it is to run on


class Need(NamedTuple):
    """A kernel, and a filter that compiles it for a trial."""

    filter: Compiled
    trial: Trial
    belief: Belief
    outlook: Outlook


def compile_all(wanted: Iterable[Wanted], jobs: int = 1) -> list[Need]:
    """Compile each kernel that is not yet compiled, once, and say so before.

    Parameters
    ----------
    jobs : processes that compile side by side, at most; whatever they leave undone is compiled here

    Returns
    -------
    The kernels, those that were ready too
    """
    needs: dict[str, Need] = {}
    for filter_, trial, belief in wanted:
        if isinstance(filter_, Compiled):
            need = Need(filter_, trial, belief, filter_.outlook(trial, belief))
            needs.setdefault(need.outlook.key, need)
        elif isinstance(filter_, WholeTrial) and not filter_.is_ready(trial, belief):
            progress.say(f"compiling {name_of(filter_)}")
            filter_.compile(trial, belief)
    missing = [need for need in needs.values() if not need.outlook.is_ready]
    if missing:
        _compile(missing, jobs)
    return list(needs.values())


def first_trials(worlds: Iterable[tuple[Filter, Scenario]]) -> Iterator[Wanted]:
    """Filters and a trial of the scenario that each is for; nothing where no landmark comes into view."""
    trials: dict[str, Trial | None] = {}
    for filter_, world in worlds:
        if world.hash not in trials:
            trials[world.hash] = None
            with contextlib.suppress(InputError):
                trials[world.hash] = require_landmarks_in_view(world).trial(0, 0)
        if (trial := trials[world.hash]) is not None:
            yield filter_, trial, world.belief


def _compile(missing: Sequence[Need], jobs: int) -> None:
    shared_kernels = [need for need in missing if need.outlook.is_shared]
    workers = min(jobs, len(shared_kernels))
    if disk_cache.folder_fault():
        workers = 1
    progress.announce(f"{_label(missing)}, once: {EACH}")
    if workers > 1:
        _compile_side_by_side(shared_kernels, workers)
    away_from_signals(_compile_here, missing)


def _compile_here(needs: Sequence[Need]) -> None:
    """Compile kernels one after the other; those that a process has kept on disk are loaded."""
    for need in needs:
        need.filter.compile(need.trial, need.belief)


def _label(missing: Sequence[Need]) -> str:
    filter_names = list(dict.fromkeys(name_of(need.filter) for need in missing))
    if len(missing) == 1:
        return f"compiling the kernel of {filter_names[0]}"
    further_filters = f" and {len(filter_names) - NAMED} more" if len(filter_names) > NAMED else ""
    return f"compiling {len(missing)} kernels of {', '.join(filter_names[:NAMED])}{further_filters}"


# --- side by side ---------------------------------------------------------------------------------


def _compile_side_by_side(needs: Sequence[Need], workers: int) -> None:
    """Compile in processes, which keep kernels on disk; what they fail at is said where it is compiled again."""
    context = get_context("loky")
    largest_first = sorted(needs, key=lambda need: need.outlook.size, reverse=True)
    initargs = link_to_parent(context)
    pool = ProcessPoolExecutor(workers, context=context, initializer=_begin_compiler, initargs=initargs)
    try:
        with contextlib.suppress(Exception):  # no more processes, or a filter that cannot be sent
            wait([pool.submit(_compile_one, _pickled(need)) for need in largest_first])
    finally:
        pool.shutdown(kill_workers=True)


def _pickled(need: Need) -> bytes:
    return bytes(dumps((need.filter, need.trial, need.belief)))


def _begin_compiler(parent: int, alive: Connection) -> None:
    """In a process of its own: end with the parent, leave Ctrl-C to it, and say nothing."""
    end_with_parent(parent, alive)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        os.dup2(nowhere, stream)


def _compile_one(pickled: bytes) -> None:
    filter_, trial, belief = pickle.loads(pickled)
    filter_.compile(trial, belief)
