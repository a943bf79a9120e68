"""Result of a challenge in words, for programs, and as a scenario file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from consistency.bench.challenging.challenge import Challenge
from consistency.bench.scenario import scenario_text
from consistency.referee.diagnostics.verdict.as_dictionary import plain
from consistency.referee.diagnostics.words.numbers import p_text
from consistency.referee.errors import InputError
from consistency.referee.system.atomic import write_whole
from consistency.referee.system.folders import writing


def challenge_lines(outcome: Challenge, out: Path) -> list[str]:
    """What to print; ``out`` is the file that was written, if the filter was found overconfident."""
    plan, verdict = outcome.plan, outcome.verdict
    name = outcome.filter
    duration = f"{outcome.seconds / 60:.1f} minutes" if outcome.seconds >= 90 else f"{outcome.seconds:.0f} s"
    searched = f"{outcome.worlds} worlds and {outcome.trials} trials in {duration}"
    tested = f"ANEES {verdict.statistic:.3g} (3 is right), {verdict.status}, on {verdict.runs} fresh runs"
    if verdict.failures:
        tested += f", of which {len(verdict.failures)} broke down"
    world = f"{outcome.space.text(outcome.point)}: ratio {outcome.ratio:.3g} in a typical run of the search"
    if not outcome.found:
        given = f"{plan.minutes:g} minutes" if plan.minutes is not None else f"{plan.trials} trials"
        return [
            f"{name}: no world found within {given} in which it is overconfident",
            f"  most overconfident: {world}",
            f"  that world: {tested}",
            f"  searched: {searched}; no proof that there is no such world",
        ]
    p = f", p {p_text(outcome.p_value)}" if np.isfinite(outcome.p_value) else ""
    rate = f"a right filter is found so in at most {plan.false_alarm:.3g} of challenges"
    return [
        f"{name} is overconfident in {world}",
        f"  confirmed: {tested}{p}; {rate}",
        f"  searched: {searched}",
        f"  {out} has the world; again: {command(outcome, out)}",
    ]


def command(outcome: Challenge, out: Path) -> str:
    """The command that repeats the confirmation."""
    seed = outcome.plan.seeds[-1]
    return f"consistency run {out} --filter {outcome.filter} --runs {outcome.plan.runs} --seed {seed} --out results"


def challenge_data(outcome: Challenge, out: Path) -> dict[str, Any]:
    plan, verdict, space = outcome.plan, outcome.verdict, outcome.space
    search_seed, confirm_seed = plan.seeds
    return {
        "filter": outcome.filter,
        "base": space.base.name,
        "found": outcome.found,
        "world": space.values(outcome.point),
        "plain": space.values(space.plain),
        "scenario_hash": outcome.world.hash,
        "status": verdict.status,
        "anees": plain(verdict.statistic),
        "p_value": plain(outcome.p_value),
        "runs": verdict.runs,
        "failures": len(verdict.failures),
        "false_alarm": plan.false_alarm,
        "detect": plan.detect,
        "ratio": outcome.ratio,
        "worlds": outcome.worlds,
        "unusable": outcome.unusable,
        "trials": outcome.trials,
        "seconds": outcome.seconds,
        "seed": plan.seed,
        "seeds": {"search": search_seed, "confirmation": confirm_seed},
        "file": str(out) if outcome.found else None,
    }


def require_writable(out: Path, overwrite: bool) -> None:
    """Refuse a file that cannot be written, before the search.

    Raises
    ------
    InputError
        Another ending than .toml, a file that is there already, or no folder to put it in.
    """
    if out.suffix != ".toml":
        raise InputError(f"--out {out}: must end in .toml")
    if out.is_dir() or (out.exists() and not overwrite):
        raise InputError(f"--out {out}: exists already; name another file or add --overwrite")
    if not out.parent.is_dir():
        raise InputError(f"--out {out}: there is no folder {out.parent}; make it first")


def write_scenario(outcome: Challenge, out: Path) -> None:
    """Write the world of a filter that was found overconfident, whole or not at all."""
    verdict = outcome.verdict
    summary = (
        f"{outcome.filter} is {verdict.status} here, ANEES {verdict.statistic:.3g} in {verdict.runs} runs: "
        f"{outcome.space.text(outcome.point)}"
    )
    text = scenario_text(
        outcome.world.variant(out.stem, summary=summary), f"Found by a challenge; again: {command(outcome, out)}"
    )
    with writing(out):
        write_whole(out, text.encode("utf-8"))
