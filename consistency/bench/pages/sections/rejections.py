"""Which observations guards kept from their filters."""

from __future__ import annotations

from consistency.bench.pages.report_input import Study
from consistency.referee.document.blocks import Block, Heading, Name, table
from consistency.referee.document.guard import COLUMNS, rejection_cells
from consistency.referee.document.verdict import FILTER
from consistency.referee.pages.section import STUDY, Section

CAPTION = (
    "Observations offered to filters with a guard, over all runs. Precision: the share of the rejected ones that are "
    "spurious; recall: the share of the spurious ones that are rejected, the first sighting of a landmark included, "
    "which no guard can judge. 95 % intervals by Clopper and Pearson at the effective number of observations, with "
    "runs as clusters. A dash where nothing is spurious, or where a log does not say what is."
)


def read(study: Study) -> Study | None:
    return study if any(track.verdict.rejection is not None for track in study.tracks) else None


def show(study: Study) -> tuple[Block, ...]:
    scores = [(track, track.verdict.rejection) for track in study.tracks]
    rows = [(Name(track.name, track.look), *rejection_cells(r)) for track, r in scores if r is not None]
    return (
        Heading("Rejected observations", 4, "Rejected observations"),
        table(
            (FILTER, *COLUMNS), rows, f"Rejected observations of {study.name}", caption=CAPTION, apart=True, whole=True
        ),
    )


SECTION = Section(STUDY, read, show)
