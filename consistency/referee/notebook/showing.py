"""How records and verdicts show themselves in a notebook; they load this module when they are asked to."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from html import escape
from pathlib import Path
from typing import Any

from consistency.referee.diagnostics.records.record import Record, numbered_axes
from consistency.referee.diagnostics.verdict.verdict import Verdict
from consistency.referee.diagnostics.words.numbers import plural
from consistency.referee.document.blocks import Bullets, Facts, Figure
from consistency.referee.document.judged_filters import summary
from consistency.referee.document.wording import fragment
from consistency.referee.errors import InputError
from consistency.referee.show import as_html


def record_text(record: Record) -> str:
    runs, unit = plural(len(record.run_numbers), "run"), "step" if record.window is None else "window"
    size = f"{runs} x {plural(len(record.t), unit)}"
    return f"<Record {record.name}: {size}, error {record.convention or '-'} of {', '.join(record.names)}>"


def record_html(record: Record) -> str:
    rows = (
        ("runs", str(len(record.run_numbers))), ("steps", str(len(record.t))), ("error", record.convention or "-"),
        ("components", ", ".join(record.names)), ("failed runs", str(len(record.failures))),
    )  # fmt: skip
    return f"<div><strong>{escape(record.name)}</strong>{as_html.fragment(Facts(rows), Bullets(record.notes))}</div>"


def verdict_text(verdict: Verdict) -> str:
    return fragment(*summary(verdict))


def verdict_html(verdict: Verdict) -> str:
    """The sentence, the table, and below it the picture where the record is kept and one can be drawn."""
    from consistency.referee.pages.record_figures import overview

    blocks = list(summary(verdict))
    if verdict.record is not None:
        with suppress(InputError):  # neither errors nor NEES
            blocks.append(Figure("Errors, NEES, coverage", "", (overview(verdict.record, verdict),)))
    return as_html.fragment(*blocks)


def plot(record: Record, verdict: Verdict | None, path: str | Path | None) -> Any:
    """See :meth:`Record.plot`."""
    from consistency.referee.pages.record_figures import overview
    from consistency.referee.pages.write_pages import plotted

    if record.error is not None and not record.axes:
        record = replace(record, axes=numbered_axes(record.error.shape[-1]))
    return plotted(overview(record, verdict), path)
