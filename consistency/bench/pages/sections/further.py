"""Further figures of merit of each filter, as a table."""

from __future__ import annotations

from consistency.bench.pages.report_input import Study
from consistency.referee.document.blocks import Block, Heading, Name, table
from consistency.referee.document.verdict import FILTER, FURTHER, cells, columns
from consistency.referee.pages.section import STUDY, Section

CAPTION = (
    "Noncredibility index and inclination (Li & Zhao 2006): 0 dB is credible, 10 dB a covariance wrong by a factor "
    "of 10; inclination above 0 is overconfident. The ratio that would be found: with power 0.95 by these runs."
)
LONG = 12  # rows from which the table may be broken between pages


def read(study: Study) -> Study | None:
    return study if study.has_truth else None


def show(study: Study) -> tuple[Block, ...]:
    rows = [(Name(track.name, track.look), *cells(FURTHER, track.verdict)) for track in study.tracks]
    label = f"Further figures of {study.name}"
    whole = len(rows) <= LONG
    return (
        Heading("Further figures", 4),
        table((FILTER, *columns(FURTHER)), rows, label, caption=CAPTION, apart=True, whole=whole),
    )


SECTION = Section(STUDY, read, show)
