"""``consistency challenge``: parses, calls, prints."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from consistency.referee.cli.options import AsJson, Seed, require_word
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
    of: Annotated[
        str, typer.Option("--of", help="'pose', 'map', or 'both': a challenge each, with half of the time.")
    ] = "both",
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
    as_json: AsJson = False,
    fail_on: Annotated[
        str | None, typer.Option("--fail-on", help="'found': exit 1 if the filter is found overconfident.")
    ] = None,
) -> None:
    """Look for the world in which a filter is most overconfident, shrink it, and confirm it on fresh runs."""
    from consistency.bench.challenging.challenge import Plan, challenge_parts
    from consistency.bench.challenging.challenge import challenge as challenge_filter
    from consistency.bench.challenging.wording import as_data, lines, require_writable, write_scenario

    require_word("--fail-on", fail_on, "found")
    if of not in ("pose", "map", "both"):
        raise InputError(f"--of must be 'pose', 'map' or 'both', got '{of}'")
    if minutes is None and trials is None:
        minutes = 5.0
    plan = Plan(minutes, trials, seed, jobs, false_alarm, detect)
    out = Path(f"challenge-{filter_name}.toml") if out is None else out
    files = [out, out.with_stem(f"{out.stem}-map")] if of == "both" else [out]
    for file in files:
        require_writable(file, overwrite)
    if of == "both":
        outcomes = [o for o in challenge_parts(filter_name, scenario, plan, within or []) if o is not None]
    else:
        outcomes = [challenge_filter(filter_name, scenario, plan, within or [], "map" if of == "map" else "pose")]
    pairs = list(zip(outcomes, files, strict=False))
    for outcome, file in pairs:
        if outcome.found:
            write_scenario(outcome, file)
    if as_json:
        first, *others = (as_data(outcome, file) for outcome, file in pairs)
        print(json.dumps(first | {"map": others[0] if others else None}, indent=2))
    else:
        print("\n".join(line for outcome, file in pairs for line in lines(outcome, file)))
    if fail_on and any(outcome.found for outcome in outcomes):
        raise typer.Exit(1)
