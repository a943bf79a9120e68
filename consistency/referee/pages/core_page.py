"""The document of verdicts on files without the packages of [report], and the picture of a verdict."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from consistency.referee.diagnostics import Evidence, Verdict
from consistency.referee.document.blocks import Block, Bullets, Chapter, Document
from consistency.referee.document.drawing import Figure
from consistency.referee.document.verdict import summary
from consistency.referee.errors import InputError
from consistency.referee.extras import is_installed


def compose_plain(records: Sequence[Evidence], judged: Mapping[str, Verdict], title: str) -> Document:
    """Sentence and figures of each verdict, why, and what was read; pictures where Matplotlib is installed."""
    named = {record.name: record for record in records}
    chapters = []
    for name, verdict in judged.items():
        blocks: list[Block] = [
            *summary(verdict),
            Bullets(tuple(why for why in verdict.reasons[1:] if why not in verdict.causes)),
            *picture(named[name], verdict),
        ]
        chapters.append(Chapter(name, name, name, tuple(blocks)))
    notes = dict.fromkeys(note for name in judged for note in named[name].notes if note not in named[name].causes)
    if notes:
        chapters.append(Chapter("", "", "", (Bullets(tuple(notes)),)))
    return Document(f"Estimator consistency: {title}", "", tuple(chapters))


def picture(record: Evidence, verdict: Verdict) -> tuple[Figure, ...]:
    """Errors, NEES and coverage; nothing without Matplotlib or where nothing can be drawn."""
    if not is_installed("plot"):
        return ()
    from consistency.referee.pages.files_report import record_sheet

    try:
        return (Figure("errors, NEES, coverage", "", (), (record_sheet(record, verdict),)),)
    except InputError:
        return ()
