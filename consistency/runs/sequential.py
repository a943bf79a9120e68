"""Run until the verdict is clear: a few trials, a look, more trials where it is still open."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from consistency.diagnostics import Design, Verdict, look, sequential_design, speaks
from consistency.errors import InputError
from consistency.protocols import Filter
from consistency.runs.montecarlo import Interrupted, run_trials
from consistency.scenario import Scenario
from consistency.store.results import POSE, Results, Tables
from consistency.terminal.progress import say
from consistency.verdicts.curves import curves
from consistency.verdicts.judge import beside, evidence_of, refused


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
    memory: float | None = None,
) -> tuple[Results, dict[str, Verdict]]:
    """Simulate and judge at the inspections of a :class:`Design` until every filter is decided.

    A filter is decided at the first inspection that finds a fault, or shows the ratio of true to stated covariance to
    lie in [1 / detect, detect]; what is said then stands, however many runs other filters take. With ``max_runs``
    what is open after so many runs ends undecided. Which runs are drawn does not depend on the looks.

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
    if max_runs is not None and done >= max_runs:
        raise InputError(f"the results to resume have {done} runs; the plan looks for the last time at {max_runs}")
    decided: dict[str, Verdict] = {}
    results: Results | None = None
    for runs, spent in design.inspections():
        if runs > done:
            results = _more(scenario, filters, runs, seed, jobs, timeout, memory, results or previous, plan)
        source = results or previous
        assert source is not None
        open_ = [name for name in source.filters if name not in decided]
        for name in open_:
            c = curves(source, name)
            evidence = evidence_of(c, runs)
            if runs == max_runs or speaks(design, evidence, spent):
                verdict = beside(look(design, evidence, spent), c, design, runs)
                decided |= {name: verdict} if settled(verdict) or runs == max_runs else {}
        open_ = [name for name in open_ if name not in decided]
        if runs > done:
            say(f"{runs} runs: {progress_text(decided, open_)}")
        if not open_:
            break
    if results is None:
        raise InputError(f"the {done} runs of the results to resume have decided every filter")
    return results, {name: decided[name] for name in results.filters}


def _more(
    scenario: Scenario,
    filters: Sequence[str | Filter],
    runs: int,
    seed: int,
    jobs: int,
    timeout: float | None,
    memory: float | None,
    previous: Tables | None,
    plan: dict[str, Any],
) -> Results:
    """Results of ``runs`` runs, with the plan in their manifest."""
    try:
        results = run_trials(scenario, filters, runs, seed, jobs, timeout, previous, memory=memory)
    except Interrupted as stop:
        manifest = stop.results.manifest | {"until_decided": plan}
        raise Interrupted(replace(stop.results, manifest=manifest), stop.status) from None
    return replace(results, manifest=results.manifest | {"until_decided": plan})


def plan_of(plan: dict[str, Any]) -> Design:
    """The design of a plan; raises InputError where it cannot be."""
    try:
        return sequential_design(**plan)
    except ValueError as error:
        raise refused(error) from None


def settled(verdict: Verdict) -> bool:
    """No further run changes what this look says."""
    return verdict.status != "undecided"


def progress_text(decided: dict[str, Verdict], open_: list[str]) -> str:
    """One line of progress."""
    parts = [f"{name} {verdict.status}" for name, verdict in decided.items()]
    return ", ".join(parts + [f"{name} open" for name in open_])
