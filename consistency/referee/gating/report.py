"""The gates of a session in rows and columns: on the terminal and in a file."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from consistency.referee.gating.session import Ledger, ending, outcome, wanted
from consistency.referee.gating.watch import Entry
from consistency.referee.show import FORMATS, rendered
from consistency.referee.system.atomic import write_whole

if TYPE_CHECKING:
    from consistency.referee.document.blocks import Cell, Document, Table


class Field(NamedTuple):
    """A column of the gates."""

    head: str
    cell: Callable[[Entry], Cell]
    is_number: bool = False
    is_brief: bool = True  # also on the terminal


def _fields() -> tuple[Field, ...]:
    from consistency.referee.document.blocks import Quantity, Reason, Status

    def inflation(e: Entry) -> Quantity:
        low, high = (float("inf") if end is None else end for end in e.inflation_interval or (None, None))
        return Quantity(e.inflation, (low, high), digits=".3g", is_factor=True)

    def why(e: Entry) -> Reason:
        first, *rest = e.reasons
        return Reason(f"{e.gate} {e.name}", first, tuple(rest), None, e.outcome == "passed" or wanted(e), e.test)

    return (
        Field("test", lambda e: e.test),
        Field("gate", lambda e: e.gate),
        Field("filter", lambda e: e.name, is_brief=False),
        Field("outcome", outcome),
        Field("verdict", lambda e: Status(e.status), is_brief=False),
        Field("p", lambda e: _p(e.p_value), is_number=True),
        Field("false-alarm rate", lambda e: f"{e.false_alarm:.3g}", is_number=True, is_brief=False),
        Field("runs", lambda e: str(e.runs), is_number=True),
        Field("planned", lambda e: str(e.needed), is_number=True),
        Field("inflation", inflation, is_number=True),
        Field("why", why, is_brief=False),
    )


def _p(value: float | None) -> str:
    """A p value, or a dash."""
    return "-" if value is None else f"{min(value, 1.0):.2g}" if value >= 1e-6 else "<1e-6"


def _table(ledger: Ledger, fields: tuple[Field, ...]) -> Table:
    from consistency.referee.document.blocks import Column, table

    columns = tuple(Column(field.head, number=field.is_number) for field in fields)
    return table(columns, [tuple(field.cell(e) for field in fields) for e in ledger.entries()], "Gates")


def lines(ledger: Ledger) -> list[str]:
    """The summary for a terminal: a row a gate, and under it why it did not pass."""
    from consistency.referee.document.blocks import Reason
    from consistency.referee.show.text import fragment

    fault = Field("", lambda e: Reason(e.name, e.reasons[0], has_passed=e.outcome != "fault found"))
    brief = tuple(field for field in _fields() if field.is_brief)
    return [*fragment(_table(ledger, (*brief, fault))).split("\n"), ending(ledger)]


def document(ledger: Ledger) -> Document:
    """All gates in one table, and the statistics of their verdicts as data."""
    from consistency.referee.document.blocks import Document

    data = {
        "schema_version": 1,
        "kind": "gates",
        "budget": ledger.budget,
        "false_alarm_each": ledger.rate,
        "false_alarm_bound": ledger.bound(),
        "gates": [vars(entry) for entry in ledger.entries()],
    }
    return Document("Consistency gates", f"{ending(ledger)}.", (), (_table(ledger, _fields()),), data)


def refusal(path: Path) -> str:
    """Why a report cannot be written there, and what to do; '' if it can."""
    if path.suffix.lower() not in FORMATS:
        return f"--consistency-report {path}: must end in {' or '.join(FORMATS)}"
    if path.is_dir():
        return f"--consistency-report {path}: is a folder; name a file in it"
    if not path.parent.is_dir():
        return f"--consistency-report {path}: the folder {path.parent} does not exist; make it first"
    try:
        with tempfile.TemporaryFile(dir=path.parent):
            pass
        if path.exists() and not os.access(path, os.W_OK):
            raise PermissionError(13, "Permission denied")
    except OSError as error:
        return f"--consistency-report {path}: cannot be written ({error.strerror}); name another file"
    return ""


def write(ledger: Ledger, path: Path) -> None:
    """The whole file or none: written beside its place and renamed."""
    write_whole(path, rendered(document(ledger), path).encode("utf-8"))
