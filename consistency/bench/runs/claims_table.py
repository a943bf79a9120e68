"""Published claims beside what was measured, in rows and columns."""

from __future__ import annotations

from collections.abc import Sequence

from consistency.bench.types import Finding, outcome
from consistency.referee.document.blocks import Cell, Column, Status, Table, table


def findings_table(findings: Sequence[Finding]) -> Table:
    columns = tuple(map(Column, ("finding", "published", "measured", "verdict")))
    rows: list[tuple[Cell, ...]] = [
        (f.id, f.published, f.measured, Status(outcome(f.source, f.verdict))) for f in findings
    ]
    return table(columns, rows, "Findings", style="prose")
