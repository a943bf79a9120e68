"""NEES of the landmarks that filters have in their maps after the last step."""

from __future__ import annotations

from consistency.reporting.blocks import Block, Cell, Column, Heading, Name, table
from consistency.reporting.model import Study, Track
from consistency.reporting.section import STUDY, Section
from consistency.reporting.wording import brief

COLUMNS = (
    Column("Filter", width="1.3fr"),
    Column("Mean NEES / 3 of the map", "Mean NEES / 3\nof the map", number=True),
    Column("95 % interval", "95 %\ninterval", number=True),
    Column("Runs", number=True),
    Column("Landmarks", number=True),
    Column("Landmarks left out", "Landmarks\nleft out", number=True),
)
CAPTION = (
    "Landmarks in the map after the last step of runs that did not fail, each with 3 degrees of freedom: 1 is right, "
    "above is overconfident. Landmarks of one run share the error of its pose, so each run counts once, and the "
    "interval is from the spread between runs. It is not judged: no verdict depends on it. Left out: what is no "
    "landmark of the world, or has no covariance that is positive definite."
)


def read(study: Study) -> Study | None:
    """The study; None where no landmark has a NEES."""
    return study if any(_has_map(track) for track in study.tracks) else None


def _has_map(track: Track) -> bool:
    return track.verdict.map is not None and track.verdict.map.landmarks > 0


def show(study: Study) -> tuple[Block, ...]:
    """One row for each filter that has a map."""
    rows = [_cells(track) for track in study.tracks if track.verdict.map is not None]
    return (
        Heading("Map", 4, "Map"),
        table(COLUMNS, rows, f"Maps of {study.name}", caption=CAPTION, apart=True, whole=True),
    )


def _cells(track: Track) -> tuple[Cell, ...]:
    name, *others = row(track)
    return Name(name, track.look), *others


def row(track: Track) -> tuple[str, ...]:
    """Cells of one filter with a map, as COLUMNS."""
    score = track.verdict.map
    assert score is not None
    value, low, high = score.ratio
    interval = f"[{brief(low)}, {brief(high)}]" if score.landmarks else "–"
    return track.name, brief(value), interval, str(score.runs), str(score.landmarks), str(score.left_out)


SECTION = Section(STUDY, read, show)
