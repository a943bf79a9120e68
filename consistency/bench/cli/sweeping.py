"""Commands over many scenarios: ``sweep`` and ``recommend``; they parse, call and print."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Annotated

import typer

from consistency.referee.cli.options import (
    SCENARIO,
    AsJson,
    BackendName,
    Jobs,
    Scheduler,
    SchedulerWait,
    Seed,
    SlurmOptions,
)
from consistency.referee.errors import InputError


def sweep(
    source: Annotated[
        str,
        typer.Argument(
            metavar="SWEEP", help="Built-in name (see 'list'), a .toml file, or a folder of 'sweep' to report again."
        ),
    ],
    out: Annotated[
        Path | None, typer.Option("--out", help="Folder to write; one with a part of the same sweep goes on.")
    ] = None,
    filters: Annotated[
        list[str] | None,
        typer.Option("--filter", metavar="NAME", help="In place of the file's filters; may be repeated."),
    ] = None,
    share: Annotated[
        str | None,
        typer.Option("--share", metavar="I/N", help="Only this share of the cells, I from 1 to N; for job arrays."),
    ] = None,
    jobs: Jobs = -1,
    backend: BackendName = "local",
    scheduler: Scheduler = None,
    scheduler_wait: SchedulerWait = None,
    slurm: SlurmOptions = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Run cells again that were made with other settings or code.")
    ] = False,
) -> None:
    """A grid of scenarios, each filter in each until decided; then a map of where which filter is consistent."""
    from consistency.bench.runs.backends.choosing import backend_for, require_scheduler
    from consistency.bench.sweeps.folder import open_sweep
    from consistency.bench.sweeps.plan import load_sweep
    from consistency.bench.sweeps.regime import regime_of, write_regime
    from consistency.bench.sweeps.running import run_sweep
    from consistency.referee.system.progress import say
    from consistency.referee.system.stopping import stoppable

    if out is None and Path(source).is_dir():
        if filters or share or overwrite:
            raise InputError(f"{source}: a folder is only reported again; give the sweep and --out to run cells")
        folder = open_sweep(Path(source))
    else:
        if out is None:
            raise InputError(f"--out: missing; give a folder for the cells of {source}")
        plan = load_sweep(source, filters)
        place = backend_for(backend, jobs, scheduler, slurm or (), scheduler_wait, out)
        require_scheduler(backend, scheduler, "a sweep")
        with stoppable() as stop:
            try:
                folder, missing = run_sweep(plan, out, *_share(share), jobs, overwrite, place)
            except KeyboardInterrupt:
                say(f"stopped: what is finished is in {out}; the same command goes on")
                sys.exit(stop.status)
        if missing:
            print(f"this share is done; {missing} of the whole sweep are missing in {out}")
            return
    from consistency.bench.pages import write_regime_reports
    from consistency.bench.sweeps.printing import regime_blocks
    from consistency.referee.show import terminal

    regime = regime_of(folder)
    terminal.show(*regime_blocks(regime))
    for path in (*write_regime(regime, folder.path), *write_regime_reports(regime, folder.path)):
        print(path)


def _share(text: str | None) -> tuple[int, int]:
    """Part and number of parts of ``I/N``."""
    if text is None:
        return 1, 1
    part, slash, parts = text.partition("/")
    if not (slash and part.isdecimal() and parts.isdecimal()):
        raise InputError(f"--share {text}: must be I/N, as 2/8")
    return int(part), int(parts)


def recommend(
    rig: Annotated[str, typer.Argument(metavar="RIG", help=f"{SCENARIO[:-1]}, or sensor.toml of a log.")],
    range_: Annotated[float | None, typer.Option("--range", help="Metres up to which landmarks are used.")] = None,
    speed: Annotated[float | None, typer.Option("--speed", help="Metres a second that the robot drives.")] = None,
    density: Annotated[
        float | None, typer.Option("--density", help="Landmarks on a square metre, as seen from above.")
    ] = None,
    dt: Annotated[float | None, typer.Option("--dt", help="Seconds from step to step.")] = None,
    map_: Annotated[
        list[Path] | None,
        typer.Option(
            "--map",
            metavar="MAP",
            help="Folder of 'sweep', or its map.json; a second one may have axes that vary alone [the shipped maps].",
        ),
    ] = None,
    runs: Annotated[
        int | None,
        typer.Option("--runs", help="Runs that confirm a filter; 0: the map alone [as many as the map's rule needs]."),
    ] = None,
    confirm: Annotated[int, typer.Option("--confirm", help="Filters to confirm, at most, one after another.")] = 4,
    seed: Seed = 0,
    jobs: Jobs = -1,
    as_json: AsJson = False,
) -> None:
    """Which filter to trust on one rig: looked up in a map, and confirmed by runs of that rig."""
    from consistency.bench.sweeps.printing import advice_blocks, advice_json
    from consistency.bench.sweeps.recommend import recommend_for
    from consistency.bench.sweeps.regime import read_maps
    from consistency.bench.sweeps.rig import Request
    from consistency.referee.show import terminal

    request = Request(rig, range_, speed, density, dt)
    regime, alone = read_maps(map_ or ())
    advice = recommend_for(request, regime, runs, confirm, seed, jobs, alone)
    if as_json:
        print(json.dumps(advice_json(advice), indent=2, allow_nan=False))
    else:
        terminal.show(*advice_blocks(advice))
