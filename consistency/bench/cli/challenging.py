"""``consistency challenge``: parses, calls, prints."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from consistency.referee.cli.options import Seed
from consistency.referee.defaults import DETECT, FALSE_ALARM
from consistency.referee.errors import InputError


def challenge(
    filter_name: Annotated[str, typer.Argument(metavar="FILTER", help="Built-in filter (see 'list').")],
    scenario: Annotated[
        str | None,
        typer.Option("--scenario", help="World to start from: built-in name or .toml [one that fits the filter]."),
    ] = None,
    within: Annotated[
        list[str] | None,
        typer.Option(
            "--within",
            help="Bounds such as range=2:8 or path=circle, or a TOML file of them; may be repeated.",
            metavar="NAME=...",
        ),
    ] = None,
    minutes: Annotated[float | None, typer.Option("--minutes", help="Time for all of it [5].")] = None,
    trials: Annotated[
        int | None,
        typer.Option("--trials", help="Trials of the search instead of --minutes; the same result on each machine."),
    ] = None,
    seed: Seed = 0,
    jobs: Annotated[int, typer.Option("--jobs", help="Workers; -1 is one a core.")] = -1,
    false_alarm: Annotated[
        float, typer.Option("--false-alarm", help="Chance that a right filter is found overconfident.")
    ] = FALSE_ALARM,
    detect: Annotated[
        float, typer.Option("--detect", help="Ratio of true to stated covariance that the confirmation must find.")
    ] = DETECT,
    out: Annotated[
        Path | None, typer.Option("--out", help="Scenario file to write [default: challenge-FILTER.toml].")
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help="Replace the file if it exists.")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="For programs.")] = False,
    fail_on: Annotated[
        str | None, typer.Option("--fail-on", help="'found': exit 1 if the filter is found overconfident.")
    ] = None,
) -> None:
    """Look for the world in which a filter is most overconfident, shrink it, and confirm it on fresh runs."""
    from consistency.bench.challenging.challenge import Plan
    from consistency.bench.challenging.challenge import challenge as challenge_filter
    from consistency.bench.challenging.wording import as_data, lines, require_writable, write_scenario

    if fail_on not in (None, "found"):
        raise InputError(f"--fail-on must be 'found', got '{fail_on}'")
    if minutes is None and trials is None:
        minutes = 5.0
    plan = Plan(minutes, trials, seed, jobs, false_alarm, detect)
    out = Path(f"challenge-{filter_name}.toml") if out is None else out
    require_writable(out, overwrite)
    outcome = challenge_filter(filter_name, scenario, plan, within or [])
    if outcome.found:
        write_scenario(outcome, out)
    if as_json:
        print(json.dumps(as_data(outcome, out), indent=2))
    else:
        print("\n".join(lines(outcome, out)))
    if fail_on and outcome.found:
        raise typer.Exit(1)
