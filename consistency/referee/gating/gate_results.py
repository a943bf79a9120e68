"""What a gate of one estimator or of two found, as an entry of the session's record, and advice on numbers of runs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from consistency.referee.diagnostics.comparison import Comparison
from consistency.referee.diagnostics.records.record import Record
from consistency.referee.diagnostics.verdict.as_dictionary import plain
from consistency.referee.diagnostics.verdict.verdict import Verdict
from consistency.referee.gating.checked_arrays import planned_dof, rate_shares
from consistency.referee.gating.gate_terms import DEFAULTS, Entry, Terms, current


@dataclass(frozen=True)
class GateResult:
    """A verdict or a comparison at one false-alarm rate."""

    bad: bool
    sure: bool  # bad at any rate
    p_value: float
    status: str
    reasons: list[str]
    verdict: Verdict | None
    comparison: Comparison | None = None


def marker_text(dof: int, runs: int) -> str:
    """Advice to add a marker, where the fixture has planned for more dimensions than the error has."""
    plan = current().plan
    if plan is None or dof >= DEFAULTS["dof"] or (planned := plan(dof)) <= runs:
        return ""
    return (
        f". The fixture consistency_runs has planned for an error of {DEFAULTS['dof']} dimensions: with "
        f"@pytest.mark.consistency(dof={dof}) at this test it gives {planned} runs"
    )


def runs_to_decide(result: GateResult, runs: int) -> int:
    """Number of runs that would probably decide, above the present one; 0 for a comparison, which gives its own."""
    if result.verdict is None:
        return 0
    shown = result.verdict.equivalence
    lost = result.verdict.lost
    least = runs + 1
    if shown is not None and not shown.shown:
        least = max(least, shown.runs or 0)
    if lost is not None:
        least = max(least, lost.needed or 0)
    return least


def entry_of(
    gate: str, record: Record, demand: Terms, result: GateResult, late: GateResult | None, outcome: str, least: int
) -> Entry:
    """The entry of a gate; ``late`` is its result at the whole budget, and ``least`` the runs that it asks for."""
    fields = summary_of(result)
    if result.verdict is not None:
        fields["statistics"] = result.verdict.statistics
    if (c := result.comparison) is not None:
        fields |= plain({"distance": c.distance, "standard_error": c.standard_error})
        spread = {"at_most": c.at_most, "sum_error": c.sum_error, "reference": c.reference}
        fields["spread"] = {key: value for key, value in spread.items() if np.isfinite(value)}
        fields["statistics"] = {"differences": [vars(d) for d in c.differences]}
    if late is not None:
        fields["late"] = summary_of(late)
    in_place = 0.0
    if demand.budget is not None and demand.may_fail:
        in_place = demand.false_alarm
    return Entry(
        gate=gate, name=record.name, outcome=outcome, p_value=plain(result.p_value),
        false_alarm=demand.false_alarm, in_budget=demand.budget is not None,
        in_place=in_place,
        runs=len(record.run_numbers), needed=least, dof=planned_dof(record), parts=rate_shares(record),
        detect=demand.detect, power=demand.power, allow=demand.allow, lost=demand.lost,
        **fields,
    )  # fmt: skip


def summary_of(result: GateResult) -> dict[str, Any]:
    summary: dict[str, Any] = {"status": result.status, "reasons": result.reasons}
    if result.comparison is not None:
        return summary | {"statistic": plain(result.comparison.differences[0].a)}
    assert result.verdict is not None
    verdict = result.verdict
    axis, ratio = verdict.axis or (None, ())
    rest: dict[str, Any] = plain({
        "statistic": verdict.statistic, "threshold": verdict.threshold, "inflation": verdict.inflation,
        "inflation_interval": verdict.inflation_interval, "axis": axis, "axis_ratio": ratio,
        "first_step": verdict.first_step, "subset": verdict.subset, "faults": verdict.faults,
    })  # fmt: skip
    return summary | rest
