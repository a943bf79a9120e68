"""The gates of a session in rows and columns: on the terminal and in a file."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from consistency.referee.document.blocks import Cell, Column, Document, Quantity, Reason, Status, Table, table
from consistency.referee.document.wording import fragment
from consistency.referee.gating.gate_terms import Entry
from consistency.referee.gating.session_ledger import Ledger, ending, outcome_text, wanted
from consistency.referee.show import rendered
from consistency.referee.system.atomic import write_whole

NUMBERS = {"p", "false-alarm rate", "runs", "planned", "true / stated"}


def _cells(e: Entry) -> dict[str, Cell]:
    first, *rest = e.reasons
    value, *ends = e.axis_ratio or (e.inflation, *(e.inflation_interval or (None, None)))
    low, high = (float("inf") if end is None else end for end in ends)
    axis = ""
    if e.axis:
        axis = f" in {e.axis}"
    return {
        "test": e.test, "gate": e.gate, "filter": e.name, "outcome": outcome_text(e), "verdict": Status(e.status),
        "p": _p_text(e.p_value), "false-alarm rate": f"{e.false_alarm:.3g}", "runs": str(e.runs),
        "planned": str(e.needed),
        "true / stated": Quantity(
            value, (low, high), axis, digits=".3g", is_factor=True
        ),
        "why": Reason(f"{e.gate} {e.name}", first, tuple(rest), None, e.outcome == "passed" or wanted(e), e.test),
        "": Reason(e.name, first, has_passed=e.outcome != "fault found"),
    }  # fmt: skip


def _p_text(p: float | None) -> str:
    if p is None:
        return "-"
    if p < 1e-6:
        return "<1e-6"
    return f"{min(p, 1.0):.2g}"


HEADS = (
    "test", "gate", "filter", "outcome", "verdict", "p", "false-alarm rate", "runs", "planned", "true / stated", "why",
)  # fmt: skip
BRIEF = ("test", "gate", "outcome", "p", "runs", "planned", "true / stated", "")  # on a terminal


def _table(entries: Iterable[Entry], heads: tuple[str, ...]) -> Table:
    columns = tuple(Column(head, number=head in NUMBERS) for head in heads)
    gate_rows = []
    for entry in entries:
        cells = _cells(entry)
        gate_rows.append(tuple(cells[head] for head in heads))
    return table(columns, gate_rows, "Gates")


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
        "gates": [vars(entry) for entry in ledger.entries()],
    }
    return Document("Consistency gates", f"{ending(ledger)}.", (), (_table(ledger.entries(), HEADS),), data)


def write_gates(ledger: Ledger, path: Path) -> None:
    """The whole file or none: written beside its place and renamed."""
    write_whole(path, rendered(gate_document(ledger), path).encode("utf-8"))
