"""How records and verdicts show themselves in a notebook; they load this module when they are asked to."""

from __future__ import annotations

from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

from consistency.referee.diagnostics import Record, Verdict
from consistency.referee.diagnostics.wording import plural
from consistency.referee.document.blocks import Bullets, Facts
from consistency.referee.extras import require
from consistency.referee.show.static import block
from consistency.referee.system.atomic import write_whole

if TYPE_CHECKING:
    from consistency.referee.show.paper import Drawn


def record_text(record: Record) -> str:
    """One line."""
    runs, unit = plural(len(record.run_numbers), "run"), "step" if record.window is None else "window"
    size = f"{runs} x {plural(len(record.t), unit)}"
    return f"<Record {record.name}: {size}, error {record.convention or '-'} of {', '.join(record.axes)}>"


def record_html(record: Record) -> str:
    """Table of its size and origin, and its notes."""
    rows = (
        ("runs", str(len(record.run_numbers))), ("steps", str(len(record.t))), ("error", record.convention or "-"),
        ("components", ", ".join(record.axes)), ("failed runs", str(len(record.failures))),
    )  # fmt: skip
    return f"<div><strong>{escape(record.name)}</strong>{block(Facts(rows))}{block(Bullets(record.notes))}</div>"


def picture_html(record: Record, verdict: Verdict) -> str:
    """Picture below the table of a verdict; "" where none can be drawn."""
    from consistency.referee.pages.plain import picture

    return "".join(map(block, picture(record, verdict)))


def plot(record: Record, verdict: Verdict | None, path: str | Path | None) -> Drawn:
    """See :meth:`Record.plot`."""
    from consistency.referee.pages.files import record_sheet

    sheet = record_sheet(record, verdict)
    require("a plot", "plot")
    from consistency.referee.show.paper import drawn, picture

    figure = drawn(sheet)
    if path is not None:
        from consistency.referee.pages import require_plot

        path = Path(path)
        require_plot(path, overwrite=True)
        write_whole(path, picture(figure, path.suffix.lower().removeprefix(".")), 0o644)
    return figure
