"""Kernels compiled before they are needed: which are missing, how long that will take, several side by side."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Iterable, Iterator, Sequence
from multiprocessing.connection import Connection, wait
from typing import NamedTuple

from consistency.bench.filters.compiled import Compiled
from consistency.bench.filters.compiler import disk_cache
from consistency.bench.filters.compiler.jit import Outlook
from consistency.bench.filters.stepping import name_of
from consistency.bench.protocols import Filter, WholeTrial
from consistency.bench.scenario import Belief, Scenario
from consistency.bench.simulation import require_landmarks_in_view
from consistency.bench.types import Trial
from consistency.referee.errors import InputError
from consistency.referee.system import progress
from consistency.referee.system.stopping import STOPS, die_with_parent, undisturbed

GLANCE = 0.1  # s between looks, for a signal that another thread was given
NAMED = 3  # filters that are named where several are compiled
Wanted = tuple[Filter, Trial, Belief]  # a filter, and a trial that it is to run on


class Need(NamedTuple):
    """A kernel, and a filter that compiles it for a trial."""

    filter: Compiled
    trial: Trial
    belief: Belief
    outlook: Outlook


def compile_all(wanted: Iterable[Wanted], jobs: int = 1) -> list[Need]:
    """Compile each kernel that is not yet compiled, once, and say how long it will take.

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
    shared = sorted(
        (need for need in missing if need.outlook.is_shared), key=lambda need: need.outlook.seconds, reverse=True
    )
    # processes start as copies of this one: in a thread beside others a lock may be held for ever
    may_fork = sys.platform == "linux" and threading.active_count() == 1
    workers = min(jobs, len(shared)) if len(shared) > 1 and may_fork and not disk_cache.folder_fault() else 1
    seconds = _wall([need.outlook.seconds for need in missing], workers)
    with _processes(shared, workers if workers > 1 else 0) as links, progress.foreseen(_label(missing), seconds):
        _side_by_side(len(shared), links)
        for need in missing:
            need.filter.compile(need.trial, need.belief)


def _label(missing: Sequence[Need]) -> str:
    names = list(dict.fromkeys(name_of(need.filter) for need in missing))
    if len(missing) == 1:
        return f"compiling the kernel of {names[0]}"
    more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
    return f"compiling {len(missing)} kernels of {', '.join(names[:NAMED])}{more}"


def _wall(seconds: Sequence[float], workers: int) -> float:
    """Seconds for all of them: the first of each process in full, as later ones share functions with it."""
    longest = sorted(seconds, reverse=True)
    total = sum(longest[:workers]) + disk_cache.AGAIN * sum(longest[workers:])
    return max(longest[0], total / workers)


# --- side by side ---------------------------------------------------------------------------------


@contextlib.contextmanager
def _processes(needs: Sequence[Need], count: int) -> Iterator[list[Connection]]:
    """Links to processes that compile the kernels whose numbers they are sent; none is left at the end."""
    links, processes = [], []
    try:
        if count:
            context, before = multiprocessing.get_context("fork"), signal.pthread_sigmask(signal.SIG_BLOCK, STOPS)
            try:
                for _ in range(count):
                    link, end = context.Pipe()
                    links.append(link)
                    processes.append(context.Process(target=_compiler, args=(needs, end, os.getpid()), daemon=True))
                    processes[-1].start()
                    end.close()
            except OSError:  # no more processes: those that there are do it, or this one
                links = links[: sum(process.pid is not None for process in processes)]
            finally:
                signal.pthread_sigmask(signal.SIG_SETMASK, before)
        yield links
    finally:
        with undisturbed():
            started = [process for process in processes if process.pid is not None]
            for process in started:
                process.kill()
            for process in started:
                process.join()


def _side_by_side(count: int, links: Sequence[Connection]) -> None:
    """Have kernels 0 to ``count`` - 1 compiled by the processes; who dies compiles no more."""
    waiting, idle, busy = list(range(count))[::-1], list(links), list[Connection]()
    while busy or (waiting and idle):
        while waiting and idle:
            link = idle.pop()
            with contextlib.suppress(OSError):
                link.send(waiting.pop())
                busy.append(link)
        for ready in wait(busy, GLANCE):
            link = busy.pop(busy.index(ready))  # type: ignore[arg-type]
            with contextlib.suppress(EOFError, OSError):
                link.recv()
                idle.append(link)


def _compiler(needs: Sequence[Need], link: Connection, parent: int) -> None:
    """In a process of its own: compile what ``link`` says, and keep it on disk."""
    for number in STOPS:
        signal.signal(number, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, STOPS)
    die_with_parent()
    nowhere = os.open(os.devnull, os.O_WRONLY)  # what is wrong is said where it is compiled again
    for stream in (1, 2):
        os.dup2(nowhere, stream)
    while os.getppid() == parent:
        need = needs[number := link.recv()]
        need.filter.compile(need.trial, need.belief)
        link.send(number)
