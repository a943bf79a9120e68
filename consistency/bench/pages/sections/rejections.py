"""Which observations guards kept from their filters."""

from __future__ import annotations

from consistency.bench.pages.blocks import Block, Cell, Column, Heading, Name, table
from consistency.bench.pages.model import Study, Track
from consistency.bench.pages.section import STUDY, Section
from consistency.bench.pages.wording import brief
from consistency.referee.diagnostics import Interval

COLUMNS = (
    Column("Filter", width="1.3fr"),
    Column("Observations", number=True),
    Column("Spurious", number=True),
    Column("Rejected", number=True),
    Column("Precision, %", number=True),
    Column("Recall, %", number=True),
    Column("Right ones rejected, %", "Right ones\nrejected, %", number=True),
)
CAPTION = (
    "Observations offered to filters with a guard, over all runs. Precision: the share of the rejected ones that are "
    "spurious; recall: the share of the spurious ones that are rejected, the first sighting of a landmark included, "
    "which no guard can judge. 95 % intervals by Clopper and Pearson at the effective number of observations, with "
    "runs as clusters. A dash where nothing is spurious, or where a log does not say what is."
)


def read(study: Study) -> Study | None:
    """The study; None where no filter has a guard."""
    return study if any(track.verdict.rejection is not None for track in study.tracks) else None


def show(study: Study) -> tuple[Block, ...]:
    """One row for each filter that has a guard."""
    tracks = [track for track in study.tracks if track.verdict.rejection is not None]
    rows: list[tuple[Cell, ...]] = [(Name(track.name, track.look), *row(track)) for track in tracks]
    return (
        Heading("Rejected observations", 4, "Rejected observations"),
        table(COLUMNS, rows, f"Rejected observations of {study.name}", caption=CAPTION, apart=True, whole=True),
    )


def row(track: Track) -> tuple[str, ...]:
    """Cells of one filter with a guard, as COLUMNS after the first."""
    score = track.verdict.rejection
    assert score is not None
    known = score.spurious > 0
    shares = (score.precision, score.recall) if known else (None, None)
    return (
        str(score.offered), str(score.spurious) if known else "–", str(score.rejected),
        *(_percent(share) for share in (*shares, score.false_alarms)),
    )  # fmt: skip


def _percent(share: Interval | None) -> str:
    if share is None or share.value != share.value:
        return "–"
    value, low, high = (brief(100 * end) for end in share)
    return f"{value} [{low}, {high}]"


SECTION = Section(STUDY, read, show)
