"""Published claims beside what was measured."""

from __future__ import annotations

from typing import Any

from consistency.reporting.blocks import Cell, Column, Small, Stack, Status, Table, table
from consistency.reporting.model import Report
from consistency.reporting.section import Part, Section

FINDINGS = Part("findings", "Findings: published beside measured", "Findings")
COLUMNS = (
    Column("Finding", width="2.5cm"),
    Column("Claim and rule", "Claim, rule and source", "2.5fr"),
    Column("Published", width="1.1fr"),
    Column("Measured", width="1.9fr"),
    Column("Verdict", width="1.75cm"),
)
CAPTION = "Rules of acceptance are constants of the scripts, fixed before this run"


def read(report: Report) -> tuple[dict[str, Any], ...] | None:
    """Findings of the folder; None where there are none."""
    return report.findings or None


def show(findings: tuple[dict[str, Any], ...]) -> tuple[Table, ...]:
    """One row a finding."""
    rows = [_row(finding) for finding in findings]
    return (table(COLUMNS, rows, "Findings", caption=CAPTION, paper=f"{CAPTION}.", style="prose"),)


def _row(finding: dict[str, Any]) -> tuple[Cell, ...]:
    below = []
    if finding["accept"]:
        below.append(Small(f"Accepted if: {finding['accept']}", italic=True))
    source, run = str(finding["source"] or ""), _run(finding)
    if source or run:
        below.append(Small(f"{f'{source}. ' if source else ''}{run}", paper=source))
    return (
        Stack(str(finding["id"]), (), bold=True),
        Stack(str(finding["claim"]), tuple(below)),
        str(finding["published"]),
        str(finding["measured"]),
        Status(str(finding["verdict"])),
    )


def _run(finding: dict[str, Any]) -> str:
    scenario = finding["scenario"]
    if not scenario or scenario == "none":
        return ""
    return f"Scenario {scenario}, {finding['runs']} runs, seed {finding['seed']}."


SECTION = Section(FINDINGS, read, show)
