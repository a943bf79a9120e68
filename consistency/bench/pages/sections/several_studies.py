"""Where several studies were made: all their verdicts as one picture and one table, before everything else."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from consistency.bench.pages.sections.nees import anees_curves
from consistency.bench.pages.sections.report_input import STEREO, Report, Study, Track
from consistency.referee.diagnostics.number_words import is_or_are, names_in_a_row, short
from consistency.referee.diagnostics.verdict_parts import STATUSES, Interval
from consistency.referee.pages.verdicts import judgement, method
from consistency.referee.pages.write_pages import facts
from consistency.referee.show.blocks import (
    BAND,
    EXPECTED,
    Block,
    Column,
    Details,
    Facts,
    Figure,
    Heading,
    Name,
    Quantity,
    Reasons,
    Settings,
    Table,
    Text,
    solid,
    table,
)
from consistency.referee.show.figures import add_legend, canvas, dodge, intervals, log_axis, name_rows, stroke
from consistency.referee.verdicts.tables import BRIEF, Measure, cells, columns

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Drawing

TITLE = "Which filter tells the truth about its uncertainty, and where?"
QUESTION = (
    "Herath, Kodagoda and Dissanayake (2007), Stereo Vision Based SLAM: Issues and Solutions, ask whether EKF and UKF "
    "SLAM by a small stereo pair are consistent: whether their errors are as large as their covariances state. They "
    "find that no filter they tried is at a baseline of 9 cm. Valencia and Andrade-Cetto (2018), SLAM Front-End, "
    "propagate the covariance of stereo visual odometry in closed form and check it by its NEES."
)
ORIGIN = ("Command", "Date", "Git commit", "Runs", "Seed")  # facts on the first page
ON_PAPER = ("ANEES of the pose", "NEES of the pose")  # figures of a study
LABEL = "covariance ratio (truth / stated)"
ROOM = 1.5  # factor between the outermost values and the edges of the picture
WIDTHS = ("0.9fr", "auto", "auto", "auto")
VERDICT, ANEES, RATIO = BRIEF
MEDIAN = Measure(Column("Median run", number=True), lambda v: Quantity(None if v.scale is None else v.scale.median_run))
MEASURES = (VERDICT, ANEES, MEDIAN, RATIO)
COLUMNS = (
    Column("World", width="1.6fr"),
    Column("Filter", width="1fr"),
    *(replace(column, paper="", width=width) for column, width in zip(columns(MEASURES), WIDTHS, strict=True)),
)


@dataclass(frozen=True)
class Place:
    """Where the interval of a filter in a world is drawn."""

    track: Track
    y: float  # row of its world, and beside the others in it
    ratio: Interval


def opening(report: Report) -> tuple[Block, ...]:
    """A row of the picture for each world, a row of the table for each filter in it.

    Before them, where the stereo sensor of the paper is one of the worlds, the papers' question and the NEES of all
    filters there. Nothing where there is one study, whose verdicts are at hand anyway.
    """
    if len(report.studies) < 2 or not any(study.has_truth for study in report.studies):
        return ()
    main = report.main
    question: tuple[Block, ...] = ()
    if main is not None:
        (curves,) = anees_curves(main)
        question = Text(QUESTION), replace(curves, title=f"NEES over time at a baseline of {_baseline(main)}", level=2)
    stated = dict(facts(report.manifest))
    origin = [f"{name.lower()}: {stated[name]}" for name in ORIGIN if name in stated]
    origin_line = Text(f"{'; '.join(origin)}.", lead="Origin.")
    return *question, origin_line, _picture(report), _table(report)


def main_sentence(studies: Sequence[Study]) -> str:
    """Who is honest on the paper's stereo sensor, and who is not; empty where it was not run."""
    main = next((study for study in studies if study.name == STEREO), None)
    if main is None:
        return ""
    parts = []
    for status in STATUSES:
        ratios = {track.name: _ratio(track) for track in main.tracks if track.verdict.status == status}
        if not ratios:
            continue
        known = sorted(ratio.value for ratio in ratios.values() if ratio is not None)
        size = ""
        if known:
            size = f" (x{short(known[0])})" if len(known) == 1 else f" (by x{short(known[0])} to x{short(known[-1])})"
        parts.append(f"{names_in_a_row(list(ratios))} {is_or_are(len(ratios))} {status}{size}")
    return f"At a baseline of {_baseline(main)}, {'; '.join(parts)}."


def on_paper(study: Study, blocks: Sequence[Block]) -> tuple[Block, ...]:
    """What the PDF shows of one of several studies: its verdicts, their first sentences, and its first figures."""
    figures = [block for block in blocks if isinstance(block, Figure) and block.title in ON_PAPER]
    return *(_brief(block) for block in judgement(study) if not isinstance(block, Heading)), *figures


def _brief(block: Block) -> Block:
    if not isinstance(block, Reasons):
        return block
    return Reasons(tuple(replace(entry, others=()) for entry in block.entries))


def _baseline(study: Study) -> str:
    scenario = study.results.scenario
    assert scenario is not None
    rig = scenario.truth.sensor.rig
    assert rig is not None
    return f"{100.0 * rig[1]:.3g} cm"


def _table(report: Report) -> Table:
    rows = [
        (study.name, Name(track.name, track.look), *cells(MEASURES, track.verdict))
        for study in report.studies
        for track in study.tracks
    ]
    caption = (
        "Every verdict of this report; a right filter has a mean ANEES of 3 for a pose in the plane. Where that is far "
        "above the mean NEES of the median run, few runs decide it."
    )
    return table(COLUMNS, rows, "Verdicts of all studies", caption=caption, style="narrow")


def places(report: Report) -> list[Place]:
    """Of every ratio that is known."""
    return [
        Place(track, row + dodge(slot, len(study.tracks)), ratio)
        for row, study in enumerate(report.studies)
        for slot, track in enumerate(study.tracks)
        if (ratio := _ratio(track)) is not None
    ]


def window_of(intervals: list[Place], factor: float) -> tuple[float, float]:
    """Drawn range of the ratios; ends of intervals are not reason for a wider one."""
    values = [1.0 / factor, factor, *(place.ratio.value for place in intervals)]
    return min(values) / ROOM, max(values) * ROOM


def _picture(report: Report) -> Figure:
    found = places(report)
    factor = next(track for study in report.studies for track in study.tracks).verdict.settings.factor

    def draw() -> Drawing:
        figure, (axes,) = canvas(0.5 + 0.22 * len(report.studies))
        axes.set(xlabel=LABEL, xlim=window_of(found, factor))
        name_rows(axes, [study.name for study in report.studies])
        axes.axvspan(1.0 / factor, factor, color=BAND, linewidth=0, zorder=0.4, label="consistent if shown inside")
        axes.axvline(1.0, **stroke(EXPECTED), label="expected")
        for name in dict.fromkeys(place.track.name for place in found):
            own = [place for place in found if place.track.name == name]
            look = replace(solid(own[0].track.look), size=3.6, width=1.1)
            intervals(axes, np.array([p.y for p in own]), np.array([p.ratio for p in own]), look, name)
        log_axis(axes, "x")
        return add_legend(figure)

    caption = (
        "By how much the covariance of the pose must grow to match the errors, with 95 % intervals; log axis. A filter "
        "is shown to be honest where its whole interval lies in the shade and no other question found a fault; to the "
        "right of it is overconfident. An arrow continues beyond the drawn range."
    )
    return Figure(TITLE, caption, (draw,), level=2)


def _ratio(track: Track) -> Interval | None:
    scale = track.verdict.scale
    known = scale is not None and np.isfinite(scale.inflation.value) and scale.inflation.value > 0
    return scale.inflation if known and scale is not None else None


def verdicts(report: Report) -> tuple[Block, ...]:
    """Verdicts of all filters in all studies, and how a verdict comes about."""
    if not report.studies:
        return (Text("No study was run for these findings."),)
    blocks = [block for study in report.studies for block in judgement(study)]
    return (*blocks, Text(method(report.studies), "How a verdict comes about.", "note"))


SHORT = 4000  # characters of settings that surely fit on one page


def provenance(report: Report) -> tuple[Block, ...]:
    """What the manifest says, and of each study what it adds."""
    rows = facts(report.manifest)
    return Facts(rows), *(_study(study, rows, len(report.studies) > 1) for study in report.studies)


def _study(study: Study, stated: tuple[tuple[str, str], ...], several: bool) -> Details:
    """Facts of one study that the report does not state already, and its settings."""
    rows = tuple(row for row in facts(study.results.manifest) if row not in stated)
    settings = resolved(study)
    what = "resolved belief" if study.is_log else "resolved scenario"
    if several:
        what = f"provenance and {what}"
    blocks = (Facts(rows), Settings(settings)) if rows else (Settings(settings),)
    return Details(f"{study.name}: {what}", blocks, whole=len(settings) < SHORT)


def resolved(study: Study) -> str:
    """The scenario, or the log's belief, as JSON."""
    manifest = study.results.manifest
    return json.dumps(_rounded(manifest.get("scenario") or manifest.get("belief") or {}), indent=2, ensure_ascii=False)


def _rounded(value: Any) -> Any:
    """Six digits of every number, to read; the manifest has them all."""
    if isinstance(value, dict):
        return {key: _rounded(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_rounded(item) for item in value]
    return float(f"{value:.6g}") if isinstance(value, float) else value
