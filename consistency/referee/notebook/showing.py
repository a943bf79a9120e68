"""How records and verdicts show themselves in a notebook; they load this module when they are asked to."""

from __future__ import annotations

from dataclasses import replace
from html import escape
from pathlib import Path
from typing import Any

from consistency.referee.diagnostics import Record, Verdict
from consistency.referee.diagnostics.records.record import numbered_axes
from consistency.referee.diagnostics.words.numbers import plural
from consistency.referee.document.blocks import Bullets, Facts
from consistency.referee.document.verdict import summary
from consistency.referee.show import as_html, text


def record_text(record: Record) -> str:
    runs, unit = plural(len(record.run_numbers), "run"), "step" if record.window is None else "window"
    size = f"{runs} x {plural(len(record.t), unit)}"
    return f"<Record {record.name}: {size}, error {record.convention or '-'} of {', '.join(record.axes)}>"


def record_html(record: Record) -> str:
    rows = (
        ("runs", str(len(record.run_numbers))), ("steps", str(len(record.t))), ("error", record.convention or "-"),
        ("components", ", ".join(record.axes)), ("failed runs", str(len(record.failures))),
    )  # fmt: skip
    table, notes = (as_html.block(each) for each in (Facts(rows), Bullets(record.notes)))
    return f"<div><strong>{escape(record.name)}</strong>{table}{notes}</div>"


def verdict_text(verdict: Verdict) -> str:
    return text.fragment(*summary(verdict))


def verdict_html(verdict: Verdict) -> str:
    """The sentence, the table, and below it the picture where the record is kept and one can be drawn."""
    from consistency.referee.pages.core_page import picture

    pictures = () if verdict.record is None else picture(verdict.record, verdict)
    return as_html.fragment(*summary(verdict)) + "".join(map(as_html.block, pictures))


def plot(record: Record, verdict: Verdict | None, path: str | Path | None) -> Any:
    """See :meth:`Record.plot`."""
    from consistency.referee.pages.files_report import record_sheet
    from consistency.referee.pages.write_pages import plotted

    if record.error is not None and not record.axes:
        record = replace(record, axes=numbered_axes(record.error.shape[-1]))
    return plotted(record_sheet(record, verdict), path)
