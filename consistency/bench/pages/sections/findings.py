"""Published claims beside what was measured."""

from __future__ import annotations

from typing import Any

from consistency.bench.pages.exhibits import findings_table
from consistency.bench.pages.report_input import Report
from consistency.referee.document.blocks import Table
from consistency.referee.pages.section import Part, Section

FINDINGS = Part("findings", "Findings: published beside measured", "Findings")
CAPTION = "Rules of acceptance are constants of the scripts, fixed before this run"


def read(report: Report) -> tuple[dict[str, Any], ...] | None:
    return report.findings or None


def show(findings: tuple[dict[str, Any], ...]) -> tuple[Table, ...]:
    return (findings_table(findings, "Findings", CAPTION),)


SECTION = Section(FINDINGS, read, show)
