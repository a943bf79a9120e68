"""``consistency tune``: parses, calls, prints."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from consistency.referee.cli.options import SCENARIO, AsJson, FalseAlarm, Jobs, require_word
from consistency.referee.defaults import DETECT, FALSE_ALARM
from consistency.referee.errors import InputError


def tune(
    filter_name: Annotated[str, typer.Option("--filter", help="Filter name (see 'list').")],
    scenario: Annotated[str | None, typer.Argument(metavar="SCENARIO", help=SCENARIO)] = None,
    log: Annotated[Path | None, typer.Option("--log", help="Recorded log folder instead of a scenario.")] = None,
    by: Annotated[
        str, typer.Option("--by", help="innovations: their likelihood, without truth; nees: the errors.")
    ] = "innovations",
    groups: Annotated[
        str,
        typer.Option("--groups", metavar="A,B", help="Noises with one factor each, as Q.v,Q.omega,R; '+' joins."),
    ] = "Q,R",
    runs: Annotated[
        int | None, typer.Option("--runs", help="Runs to fit on, and as many fresh ones to judge on [50].")
    ] = None,
    seed: Annotated[int | None, typer.Option("--seed", help="Seed of the noise [0].")] = None,
    jobs: Jobs = -1,
    timeout: Annotated[
        float | None, typer.Option("--timeout", help="Seconds a run of a filter that is not compiled.")
    ] = None,
    false_alarm: FalseAlarm = FALSE_ALARM,
    detect: Annotated[
        float, typer.Option("--detect", help="Consistent is a covariance ratio shown inside [1/R, R].", metavar="R")
    ] = DETECT,
    out: Annotated[
        Path | None, typer.Option("--out", help="Folder for the tuned scenario or sensor.toml, and tuning.json.")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace an output folder of 'tune'.")] = False,
    as_json: AsJson = False,
    fail_on: Annotated[
        str | None, typer.Option("--fail-on", help="'inconsistent': exit 1 unless the tuned filter is consistent.")
    ] = None,
) -> None:
    """Fit the process and measurement noise of a filter, and judge it before and after on data the fit has not seen."""
    from consistency.bench.scenario import load_scenario
    from consistency.bench.store.log import read_log
    from consistency.bench.tuning.result import KIND, as_data, lines, verdicts, write
    from consistency.bench.tuning.tune import tune as tune_filter
    from consistency.referee.document.verdict import document
    from consistency.referee.show import terminal
    from consistency.referee.system.folders import require_free
    from consistency.referee.verdicts.options import settings_of

    require_word("--fail-on", fail_on, "inconsistent")
    if (scenario is None) == (log is None):
        raise InputError("give either a SCENARIO or --log DIR")
    if log is not None and (runs is not None or seed is not None):
        raise InputError("--runs and --seed do not go with --log: a log has the runs it has")
    settings = settings_of(false_alarm=false_alarm, detect=detect)
    if out is not None:
        require_free(out, overwrite, KIND)
    tuning = tune_filter(
        load_scenario(str(scenario)) if log is None else read_log(log), filter_name, by=by, groups=groups,
        runs=50 if runs is None else runs, seed=0 if seed is None else seed, jobs=jobs, timeout=timeout,
        settings=settings,
    )  # fmt: skip
    if out is not None:
        write(tuning, out, overwrite)
    if as_json:
        print(json.dumps(as_data(tuning, out), indent=2, allow_nan=False))
    else:
        terminal.show(*document(verdicts(tuning), reasons=False).opening)
        print("\n" + "\n".join(lines(tuning, out)))
    if fail_on and not tuning.consistent:
        raise typer.Exit(1)
