"""Filters with an error of their own: what is judged in it, and beside it in the additive error of the world."""

from __future__ import annotations

from consistency.bench.pages.report_input import Study, Track
from consistency.referee.document.blocks import Block, Cell, Column, Heading, Name, table
from consistency.referee.document.verdict import BRIEF, FILTER, cells, columns
from consistency.referee.geometry.conventions import ADDITIVE, PLANAR
from consistency.referee.pages.section import STUDY, Section

COLUMNS = (FILTER, Column("Error", width="2.4fr"), *columns(BRIEF))


def read(study: Study) -> Study | None:
    """The study; None where every filter has the additive error."""
    return study if any(track.verdict.world is not None for track in study.tracks) else None


def show(study: Study) -> tuple[Block, ...]:
    rows = [row for track in study.tracks for row in _rows(track)]
    return (
        Heading("Errors of their own", 4, "Errors of their own"),
        table(COLUMNS, rows, f"Own errors of {study.name}", caption=caption(study), apart=True, whole=True),
    )


def _rows(track: Track) -> list[tuple[Cell, ...]]:
    own, world = track.verdict, track.verdict.world
    if world is None:
        return []
    return [
        (Name(track.name, track.look), f"{own.convention}, its own", *cells(BRIEF, own)),
        ("", f"{ADDITIVE}, additive", *cells(BRIEF, world)),
    ]


def caption(study: Study) -> str:
    """Which errors these are, and which of them the rest of the report is about."""
    own = dict.fromkeys(t.verdict.convention for t in study.tracks if t.verdict.world is not None)
    errors = "; ".join(f"{error}: {PLANAR[error]}" for error in (*filter(None, own), ADDITIVE))
    return (
        f"{errors}. The covariance of such a filter is that of its own error, so its verdict and every NEES, ratio, "
        "bias and coverage in this report are in that one. Pose errors with their sigma, and RMSE, are those of the "
        "pose in the world."
    )


SECTION = Section(STUDY, read, show)
