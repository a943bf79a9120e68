"""The command ``compile``; it parses, calls and prints."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from consistency.referee.cli.options import SCENARIO, Jobs


def compile_(
    filters: Annotated[
        list[str] | None,
        typer.Argument(metavar="FILTER", hidden=True),  # typer would name its type in its own words
    ] = None,
    scenario: Annotated[
        str | None,
        typer.Option("--scenario", help=f"{SCENARIO[:-1]} [every built-in one that the filters fit]."),
    ] = None,
    into: Annotated[
        Path | None, typer.Option("--into", metavar="DIR", help="Folder for all users in place of your own cache.")
    ] = None,
    cpu: Annotated[
        str | None,
        typer.Option("--cpu", metavar="NAME", help="Processor by LLVM's name, as x86-64-v3 [that of this machine]."),
    ] = None,
    jobs: Jobs = -1,
) -> None:
    """Compile the kernels of filters ahead, so that their first run begins at once; also for images and CI.

    FILTER is a name, or FILTER+gate; without one, every filter that fits the scenario.
    """
    from consistency.bench.filters.compiler.processor import aim_at

    environment = {} if cpu is None else aim_at(cpu)
    from consistency.bench.runs.compiling_ahead import compile_ahead

    ahead = compile_ahead(filters or (), scenario, into, jobs)
    count, of = (f"{n} {what}{'s' * (n != 1)}" for n, what in ((ahead.kernels, "kernel"), (ahead.filters, "filter")))
    print(f"{count} of {of} in {ahead.folder}, {ahead.compiled} compiled now")
    if into is not None:
        environment = {"NUMBA_CACHE_DIR": str(ahead.folder)} | environment
    if environment:
        print("to use them: " + " ".join(f"{name}={value}" for name, value in environment.items()))
