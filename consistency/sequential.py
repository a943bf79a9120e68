"""Run until the verdict is clear: a few trials, a look, more trials where it is still open."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from consistency.diagnostics import Design, sequential_design
from consistency.errors import InputError
from consistency.judge import curves, refused, verdict_of
from consistency.montecarlo import Interrupted, run_trials
from consistency.protocols import Filter
from consistency.results import POSE, Results, Tables
from consistency.scenario import Scenario
from consistency.types import Verdict


def run_until_decided(
    scenario: Scenario,
    filters: Sequence[str | Filter],
    *,
    detect: float = 1.5,
    false_alarm: float = 0.05,
    power: float = 0.95,
    max_runs: int | None = None,
    seed: int = 0,
    jobs: int = -1,
    timeout: float | None = None,
    previous: Tables | None = None,
) -> tuple[Results, dict[str, Verdict]]:
    """Simulate and judge at the looks of :func:`sequential_design` until every filter is decided.

    A filter is decided at the first look that finds a fault, or at the last. With ``max_runs`` below what
    ``detect`` needs, a filter without a fault ends undecided. Which runs are drawn does not depend on the looks.

    Returns
    -------
    Results of all runs, with the plan in their manifest, and the verdict of each filter at the look that decided it

    Raises
    ------
    InputError, Interrupted
        As :func:`run_trials`; a plan that cannot be.
    """
    plan: dict[str, Any] = {
        "dof": len(POSE), "detect": detect, "false_alarm": false_alarm, "power": power, "max_runs": max_runs,
    }  # fmt: skip
    design = plan_of(plan)
    done = 0 if previous is None else 1 + max(previous.finished_runs(previous.filters), default=-1)
    looks = [n for n in design.looks if n > done]
    if not looks:
        raise InputError(
            f"the results to resume have {done} runs; the plan looks for the last time at {design.looks[-1]}"
        )
    decided: dict[str, Verdict] = {}
    results: Results | None = None
    for look in looks:
        try:
            results = run_trials(scenario, filters, look, seed, jobs, timeout, results or previous)
        except Interrupted as stop:
            manifest = stop.results.manifest | {"until_decided": plan}
            raise Interrupted(replace(stop.results, manifest=manifest)) from None
        results = replace(results, manifest=results.manifest | {"until_decided": plan})
        verdicts = {n: design.settle(verdict_of(curves(results, n), design.look_false_alarm)) for n in results.filters}
        final = look == looks[-1]
        decided |= {n: v for n, v in verdicts.items() if n not in decided and (final or settled(v))}
        open_ = [name for name in results.filters if name not in decided]
        print(f"{look} runs: {said(decided, open_)}", file=sys.stderr, flush=True)
        if not open_:
            break
    assert results is not None
    return results, {name: decided[name] for name in results.filters}


def plan_of(plan: dict[str, Any]) -> Design:
    """The design of a plan; raises InputError where it cannot be."""
    try:
        return sequential_design(**plan)
    except ValueError as error:
        raise refused(error) from None


def settled(verdict: Verdict) -> bool:
    """No further run changes what this look says."""
    return verdict.status != "undecided"


def said(decided: dict[str, Verdict], open_: list[str]) -> str:
    """One line of progress."""
    parts = [f"{name} {verdict.status}" for name, verdict in decided.items()]
    return ", ".join(parts + [f"{name} open" for name in open_])
