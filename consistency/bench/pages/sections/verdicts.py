"""Verdicts of all filters in all studies, and how a verdict comes about."""

from __future__ import annotations

from consistency.bench.pages.report_input import Report
from consistency.referee.document.blocks import Block, Text
from consistency.referee.pages.section import Part, Section
from consistency.referee.pages.verdicts import judgement, method

VERDICTS = Part("verdicts", "Verdicts", "Verdicts")


def read(report: Report) -> Report:
    """The whole report: every study has verdicts."""
    return report


def show(report: Report) -> tuple[Block, ...]:
    if not report.studies:
        return (Text("No study was run for these findings."),)
    blocks = [block for study in report.studies for block in judgement(study)]
    return (*blocks, Text(method(report.studies), "How a verdict comes about.", "note"))


SECTION = Section(VERDICTS, read, show)
