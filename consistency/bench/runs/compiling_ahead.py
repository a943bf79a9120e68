"""Kernels compiled ahead, for an image or a machine on which nobody should wait for them."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from consistency.bench.filters import get_filter, usable_names
from consistency.bench.filters.compiled import Compiled
from consistency.bench.filters.compiler import disk_cache
from consistency.bench.filters.stepping import name_of
from consistency.bench.protocols import Filter
from consistency.bench.runs.backends.local import worker_count
from consistency.bench.runs.compiling import Wanted, compile_all, first_trials
from consistency.bench.runs.montecarlo import resolve_filters
from consistency.bench.scenario import Belief, load_scenario, scenario_names
from consistency.referee.errors import InputError

FIRST_STEPS = "herath2007-stereo"  # the world of the README's first commands


@dataclass(frozen=True)
class Ahead:
    kernels: int
    compiled: int  # of them; the others were there
    filters: int
    folder: Path  # to be named by NUMBA_CACHE_DIR


def compile_ahead(names: Sequence[str], scenario: str | None, into: Path | None = None, jobs: int = -1) -> Ahead:
    """Compile the kernels that filters need in a scenario, so that runs begin at once.

    Parameters
    ----------
    names : filters; none for all that fit
    scenario : built-in name or path; None for all built-in ones that fit a filter, or the one of :data:`FIRST_STEPS`
        where no filter is named either
    into : folder in place of the user's cache; what is in it can be read by all users of the machine
    jobs : processes that compile side by side, -1 for one a core

    Raises
    ------
    InputError
        An unknown filter or scenario, a filter that does not fit or has no kernel, a folder that cannot be written.
    """
    worker_count(jobs)
    wanted = _wanted(names, scenario if scenario or names else FIRST_STEPS)
    if into is not None:
        os.environ["NUMBA_CACHE_DIR"] = str(into.absolute())
    _require_folder(into)
    needs = compile_all(wanted, worker_count(jobs))
    _require_folder(into)
    if lost := [name_of(need.filter) for need in needs if not disk_cache.place(need.outlook.key).exists()]:
        raise InputError(f"{disk_cache.folder()}: does not hold the kernel of {lost[0]}; is there room on the disk?")
    if into is not None:
        disk_cache.open_to_readers()
    compiled = sum(not need.outlook.is_ready for need in needs)
    return Ahead(len(needs), compiled, len({name_of(filter_) for filter_, _, _ in wanted}), disk_cache.folder().parent)


def _require_folder(into: Path | None) -> None:
    if refusal := disk_cache.refusal():
        named = "" if into is None else f"--into {into}: "
        raise InputError(f"{named}{disk_cache.folder()} takes no compiled code ({refusal}); name a folder by --into")


def _wanted(names: Sequence[str], scenario: str | None) -> list[Wanted]:
    """Each filter on the first trial of each scenario that it fits."""
    worlds = [load_scenario(name) for name in ([scenario] if scenario else scenario_names())]
    filters = [get_filter(name) for name in (names or usable_names())]
    if names:
        for filter_ in filters:
            if not isinstance(filter_, Compiled):
                raise InputError(f"filter '{name_of(filter_)}' has no kernel: nothing is to be compiled, leave it out")
        if scenario:
            resolve_filters(filters, worlds[0].belief)
    own = [filter_ for filter_ in filters if isinstance(filter_, Compiled)]
    return list(first_trials((f, world) for world in worlds for f in own if _fits(f, world.belief)))


def _fits(filter_: Filter, belief: Belief) -> bool:
    try:
        resolve_filters([filter_], belief)
    except InputError:
        return False
    return True
