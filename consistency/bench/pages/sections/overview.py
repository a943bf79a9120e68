"""Where several studies were made: all their verdicts as one picture and one table, before everything else."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from consistency.bench.pages.report_input import Report, Track, as_given
from consistency.referee.diagnostics import Interval
from consistency.referee.document.blocks import Block, Column, Name, Table, Text, table
from consistency.referee.document.colours import EXPECTED, SHADE, solid
from consistency.referee.document.drawing import Axis, Figure, Intervals, Key, Panel, Rule, Sheet, Span, dodge
from consistency.referee.document.verdict import BRIEF, cells, columns, factor
from consistency.referee.document.wording import written
from consistency.referee.pages.section import OPENING, Part, Section
from consistency.referee.pages.verdicts import judgement, method

TITLE = "Which filter tells the truth about its uncertainty, and where?"
LABEL = "covariance ratio (truth / stated)"
ROOM = 1.5  # factor between the outermost values and the edges of the picture
WIDTHS = ("0.9fr", "auto", "auto")
COLUMNS = (
    Column("World", width="1.6fr"),
    Column("Filter", width="1fr"),
    *(replace(column, paper="", width=width) for column, width in zip(columns(BRIEF), WIDTHS, strict=True)),
)


@dataclass(frozen=True)
class Place:
    """Where the interval of a filter in a world is drawn."""

    track: Track
    world: str
    y: float
    ratio: Interval


def read(report: Report) -> Report | None:
    """The report; None where it has one study, whose verdicts are at hand anyway."""
    return report if len(report.studies) > 1 and any(study.has_truth for study in report.studies) else None


def show(report: Report) -> tuple[Block, ...]:
    """A row of the picture for each world, a row of the table for each filter in it."""
    return _picture(report), _table(report)


def _table(report: Report) -> Table:
    rows = [
        (study.name, Name(track.name, track.look), *cells(BRIEF, track.verdict))
        for study in report.studies
        for track in study.tracks
    ]
    caption = "Every verdict of this report; a right filter has a mean ANEES of 3 for a pose in the plane."
    return table(COLUMNS, rows, "Verdicts of all studies", caption=caption, paper=caption, style="narrow", apart=True)


def _picture(report: Report) -> Figure:
    worlds = tuple(study.name for study in report.studies)
    filters = {track.name: track for study in report.studies for track in study.tracks}
    places = [
        Place(track, study.name, row + dodge(slot, len(study.tracks)), ratio)
        for row, study in enumerate(report.studies)
        for slot, track in enumerate(study.tracks)
        if (ratio := _ratio(track)) is not None
    ]
    factor = next(iter(filters.values())).verdict.settings.factor
    values = [1.0 / factor, factor, *(place.ratio[0] for place in places)]
    panel = Panel(
        Axis(LABEL, log=True, window=(min(values) / ROOM, max(values) * ROOM)),
        Axis("", rows=worlds),
        (Span("x", 1.0 / factor, factor, SHADE), Rule("x", 1.0, EXPECTED), *_intervals(places)),
        "Covariance ratio of every filter in every world, with its interval",
        height=70 + 34 * len(worlds),
    )
    shade = Key(f"tolerated: 1 / {factor:g} to {factor:g}", SHADE, "band")
    named = tuple(Key(name, solid(track.look), "points") for name, track in filters.items())
    keys = (shade, Key("right", EXPECTED), *named)
    caption = (
        "By how much the covariance of the pose must grow to match the errors, with 95 % intervals; log axis. A filter "
        "is shown to be honest where its whole interval lies in the shade and no other question found a fault; to the "
        "right of it is overconfident. An arrow goes on beyond the drawn range."
    )
    sheet = Sheet((panel,), 0.6 + 0.2 * len(worlds), keys=keys)
    return Figure(TITLE, caption, (panel,), (sheet,), keys, level=2, paper=f"{TITLE} {caption}")


def _ratio(track: Track) -> Interval | None:
    scale = track.verdict.scale
    known = scale is not None and np.isfinite(scale.inflation.value) and scale.inflation.value > 0
    return scale.inflation if known and scale is not None else None


def _intervals(places: list[Place]) -> list[Intervals]:
    """The intervals of each filter, in all worlds."""
    marks = []
    for name in dict.fromkeys(place.track.name for place in places):
        own = [place for place in places if place.track.name == name]
        value, low, high = np.array([place.ratio for place in own]).T
        columns = {
            "world": [place.world for place in own],
            "filter": [name] * len(own),
            "verdict": [place.track.verdict.status for place in own],
            "text": [written(factor(place.track.verdict)) for place in own],
        }
        tips = (("world", "@world"), ("filter", "@filter"), ("verdict", "@verdict"), ("covariance", "@text"))
        look = replace(own[0].track.look, size=5.0, width=1.3)
        y = np.array([place.y for place in own])
        marks.append(Intervals(y, value, low, high, look, None, tips, columns))
    return marks


def verdicts(report: Report) -> tuple[Block, ...]:
    """Verdicts of all filters in all studies, and how a verdict comes about."""
    if not report.studies:
        return (Text("No study was run for these findings."),)
    blocks = [block for study in report.studies for block in judgement(study)]
    return (*blocks, Text(method(report.studies), "How a verdict comes about.", "note"))


SECTION = Section(OPENING, read, show)
VERDICTS = Section(Part("verdicts", "Verdicts", "Verdicts"), as_given, verdicts)
