"""What a gate found, as an entry of the record of a session, and all of them in rows and columns."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from consistency.referee.diagnostics.comparison import Comparison
from consistency.referee.diagnostics.record import Record
from consistency.referee.diagnostics.verdict import Verdict, plain
from consistency.referee.gating.checked_input import planned_detect, planned_dof, rate_shares
from consistency.referee.gating.session import (
    DEFAULTS,
    Entry,
    Ledger,
    Terms,
    current,
    ending,
    is_shown,
    outcome_text,
    wanted,
)
from consistency.referee.show import rendered
from consistency.referee.show.blocks import (
    Cell,
    Column,
    Document,
    Quantity,
    Reason,
    Status,
    Table,
    badges,
    fragment,
    table,
)
from consistency.referee.system import write_whole

NUMBERS = {"p", "false-alarm rate", "runs", "planned", "true / stated"}
HEADS = (
    "test", "gate", "filter", "outcome", "verdict", "p", "false-alarm rate", "runs", "planned", "true / stated", "why",
)  # fmt: skip
BRIEF = ("test", "gate", "outcome", "p", "runs", "planned", "true / stated", "")  # on a terminal


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
    gate: str, record: Record, demand: Terms, result: GateResult, late: GateResult | None, outcome: str, least: int,
    page: Path | None = None,
) -> Entry:  # fmt: skip
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
        planned_detect=planned_detect(record, demand.detect),
        detect=demand.detect, power=demand.power, allow=demand.allow, lost=demand.lost, page=str(page or ""),
        **fields,
    )  # fmt: skip


def write_page(record: Record, verdict: Verdict) -> Path | None:
    """The page of a gate with pictures, where its session asks for pages: its file."""
    path = current().page()
    if path is not None:
        from consistency.referee.pages.write_pages import write_file_pages

        write_file_pages([record], {record.name: verdict}, path, None, record.name)
    return path


def summary_of(result: GateResult) -> dict[str, Any]:
    summary: dict[str, Any] = {"status": result.status, "reasons": result.reasons}
    if result.comparison is not None:
        return summary | {"statistic": plain(result.comparison.differences[0].a)}
    assert result.verdict is not None
    verdict = result.verdict
    axis, ratio = verdict.axis or (None, ())
    if verdict.bounds:
        from consistency.referee.diagnostics.bound_words import deciding

        bound = deciding(verdict.bounds)
        axis, ratio = bound.name, bound.factor
    rest: dict[str, Any] = plain({
        "statistic": verdict.statistic, "threshold": verdict.threshold, "inflation": verdict.inflation,
        "inflation_interval": verdict.inflation_interval, "axis": axis, "axis_ratio": ratio,
        "first_step": verdict.first_step, "subset": verdict.subset, "faults": verdict.faults,
    })  # fmt: skip
    return summary | rest


def _cells(e: Entry) -> dict[str, Cell]:
    first, *rest = e.reasons
    value, *ends = e.axis_ratio or (e.inflation, *(e.inflation_interval or (None, None)))
    low, high = (float("inf") if end is None else end for end in ends)
    axis, p = "", "-"
    page = [f"page: {e.page}"] * is_shown(e)
    if e.axis:
        axis = f" in {e.axis}"
    if e.p_value is not None:
        p = f"{min(e.p_value, 1.0):.2g}"
        if e.p_value < 1e-6:
            p = "<1e-6"
    return {
        "test": e.test, "gate": e.gate, "filter": e.name, "outcome": outcome_text(e), "verdict": Status(e.status),
        "p": p, "false-alarm rate": f"{e.false_alarm:.3g}", "runs": str(e.runs), "planned": str(e.needed),
        "true / stated": Quantity(value, (low, high), axis, digits=".3g", is_factor=True),
        "why": Reason(f"{e.gate} {e.name}", first, (*rest, *page), None, e.outcome == "passed" or wanted(e), e.test),
        "": Reason(e.name, first, has_passed=e.outcome != "fault found"),
    }  # fmt: skip


def _table(entries: Iterable[Entry], heads: tuple[str, ...]) -> Table:
    columns = tuple(Column(head, number=head in NUMBERS) for head in heads)
    gate_rows = []
    for entry in entries:
        cells = _cells(entry)
        gate_rows.append(tuple(cells[head] for head in heads))
    return table(columns, gate_rows, "Gates", style="narrow")


def gate_lines(ledger: Ledger) -> list[str]:
    """The summary for a terminal: a row a gate, and under it why it did not pass."""
    return [*fragment(_table(ledger.entries(), BRIEF)).split("\n"), ending(ledger)]


def gate_document(ledger: Ledger) -> Document:
    data = {
        "schema_version": 1,
        "kind": "gates",
        "budget": ledger.budget,
        "false_alarm_each": ledger.rate,
        "false_alarm_bound": ledger.bound(),
        "gates": [{**vars(entry), "page": entry.page * is_shown(entry)} for entry in ledger.entries()],
    }
    words = badges([(entry.test or entry.name, entry.status) for entry in ledger.entries()])
    shown = _table(ledger.entries(), HEADS)
    return Document("Consistency gates", f"{ending(ledger)}.", (), (shown,), data, badges=words)


def write_gates(ledger: Ledger, path: Path) -> None:
    """The whole file or none: written beside its place and renamed."""
    write_whole(path, rendered(gate_document(ledger), path).encode("utf-8"))
