"""Verdicts of all filters in all studies, and how a verdict comes about."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from consistency.bench.pages.blocks import (
    Block,
    Cell,
    Column,
    Heading,
    Name,
    Reason,
    Reasons,
    Status,
    Table,
    Text,
    table,
)
from consistency.bench.pages.model import Estimator, Judged, Report
from consistency.bench.pages.section import Part, Section
from consistency.bench.pages.wording import brief, listed, number, p_cell
from consistency.referee.diagnostics.wording import UNCERTAIN, plain, plural, short

VERDICTS = Part("verdicts", "Verdicts", "Verdicts")
FAILURES = (
    Column("Filter", width="1.4fr"),
    Column("Run", number=True),
    Column("Step", number=True),
    Column("Reason", width="3fr"),
)


def read(report: Report) -> Report:
    """The whole report: every study has verdicts."""
    return report


def show(report: Report) -> tuple[Block, ...]:
    """Tables and sentences of each study, then the method."""
    if not report.studies:
        return (Text("No study was run for these findings."),)
    blocks = [block for study in report.studies for block in judgement(study)]
    return (*blocks, Text(method(report.studies), "How a verdict comes about.", "note"))


def judgement(study: Judged) -> list[Block]:
    """Table and sentences of one study, and its failed runs."""
    blocks: list[Block] = [Heading(study.name), _table(study), Reasons(tuple(_reason(t) for t in study.tracks))]
    if study.failures:
        rows: list[tuple[Cell, ...]] = [(name, str(run), str(step), why) for name, run, step, why in study.failures]
        caption = f"Failed runs of {study.name}: {len(rows)}"
        blocks.append(table(FAILURES, rows, f"Failed runs of {study.name}", caption=caption))
    return blocks


def _table(study: Judged) -> Table:
    every = [_cells(track) for track in study.tracks]
    shown = [i for i in range(len(every[0])) if any(cells[i] != "–" for cells in every)] if every else []
    heads = tuple(columns(study)[i] for i in shown)
    rows = [tuple(cells[i] for i in shown) for cells in every]
    text = caption(study)
    label, paper = f"Verdicts of {study.name}", f"{study.name}: {text}"
    return table(heads, rows, label, caption=text, paper=paper, style="narrow", apart=True)


def _cells(track: Estimator) -> tuple[Cell, ...]:
    name, status, *others = row(track)
    return Name(name, track.look), Status(status), *others


def _reason(track: Estimator) -> Reason:
    sentence, *others = track.verdict.reasons
    return Reason(track.name, track.look, sentence, tuple(others))


def columns(study: Judged) -> tuple[Column, ...]:
    """Heads of the verdict table."""
    inside = equivalence_interval(study)
    return (
        Column("Filter", width="1.3fr"),
        Column("Verdict"),
        Column("Mean ANEES", "Mean\nANEES", number=True),
        Column("Covariance to multiply by", "Covariance to\nmultiply by", number=True),
        Column(f"Shown inside {inside}", f"Shown inside\n{inside}", number=True),
        Column("Worst axis", "Worst\naxis", number=True),
        Column("Mainly", number=True),
        Column("Since step", "Since\nstep", number=True),
        Column("RMSE position (m)", "RMSE\n(m)", number=True),
        Column("RMSE heading (deg)", "RMSE\n(deg)", number=True),
        Column("NIS / dof", "NIS\n/ dof", number=True),
        Column("Failed runs", "Failed\nruns", number=True),
    )


def row(track: Estimator) -> tuple[str, ...]:
    """Cells of the verdict table, as :func:`columns`."""
    v, location, accuracy = track.verdict, track.verdict.location, track.verdict.in_world.accuracy
    since = None if location is None else location.since
    return (
        track.name,
        v.status,
        "–" if v.scale is None else brief(v.scale.mean_anees),
        inflation(track),
        shown_inside(track),
        worst_axis(track),
        (location.subset if location is not None else None) or "–",
        "–" if since is None else str(since),
        number(None if accuracy is None else accuracy.rmse_position, ".3f"),
        number(None if accuracy is None else np.rad2deg(accuracy.rmse_heading), ".2f"),
        nis(track),
        f"{len(v.failures)} of {v.runs}",
    )


def equivalence_interval(study: Judged) -> str:
    """Where consistent filters are shown to have their ratio of true to stated covariance; the same for all."""
    if not study.tracks:
        return ""
    verdict = study.tracks[0].verdict
    shown = verdict.equivalence
    factor = verdict.settings.factor if shown is None else shown.factor
    low = "(0" if (verdict.settings if shown is None else shown).one_sided else f"[{short(1.0 / factor)}"
    return f"{low},\u00a0{short(factor)}]"


def inflation(track: Estimator) -> str:
    """Factor that makes the stated covariance that of the errors, with its interval."""
    scale = track.verdict.scale
    if scale is None or not np.isfinite(scale.inflation.value):
        return "–"
    ratio, low, high = scale.inflation
    known = np.isfinite(high) and high < UNCERTAIN * low
    return f"×{brief(ratio)} [{f'{brief(low)}, {brief(high)}' if known else 'unknown'}]"


def worst_axis(track: Estimator) -> str:
    """Axis whose ratio of true to stated covariance is farthest from 1, and that ratio."""
    worst = track.verdict.worst_axis
    return "–" if worst is None else f"{worst[0]}, {plain(worst[1])}"


def shown_inside(track: Estimator) -> str:
    """Whether the ratio of true to stated covariance was shown to lie where it should, and the p value."""
    shown = track.verdict.equivalence
    if shown is None or not np.isfinite(shown.p_value):
        return "–"
    return f"{'yes' if shown.shown else 'no'}, p {p_cell(shown.p_value)}"


def nis(track: Estimator) -> str:
    """NIS per degree of freedom, in parentheses where it is not judged."""
    found = track.verdict.innovations
    ratio = number(None if found is None else found.ratio, ".3f")
    return ratio if track.innovations_judged or ratio == "–" else f"({ratio})"


def caption(study: Judged) -> str:
    """How large the study is, and how to read the table of verdicts."""
    text = f"{plural(study.runs, 'run')} of {plural(len(study.steps), 'step')}"
    if _windows(study):
        text = f"{plural(study.runs, 'window')}, each of which counts as a run"
    if study.single and study.has_truth:
        text += "; with one run the ANEES is the NEES of that run"
    if study.until_decided:
        when = [f"{track.name} after {plural(track.verdict.runs, 'run')}" for track in study.tracks]
        text += f", until decided: a verdict is that of the look that decided, {listed(when)}"
    what = "of true to stated covariance" if study.has_truth else "of the NIS to its degrees of freedom"
    text += f". Shown inside {equivalence_interval(study)}: whether the ratio {what} is shown to lie there"
    if len(study.judged) < len(study.tracks):
        text += ". NIS in parentheses: reported and not judged, as no optimal gain is declared"
    if own := study.own_errors:
        text += f". Judged in an error of their own, but for the RMSE: {listed(own)}; see Errors of their own"
    return f"{text}."


def _windows(study: Judged) -> bool:
    """Do independent windows of logs stand in the place of runs?"""
    return any(track.verdict.unit == "window" for track in study.tracks)


def method(studies: Sequence[Judged]) -> str:
    """How a verdict comes about, in one paragraph."""
    tracks = [track for study in studies for track in study.tracks]
    rates = [track.verdict.settings.false_alarm for track in tracks]
    rate = f"{100 * rates[0]:.2g} %" if rates else "the false-alarm rate"
    text = (
        "A run is one observation: runs are independent, steps are not. The questions of a verdict together find a "
        f"fault in a right filter with probability {rate} at most, whatever they have to do with each other "
        "(Holm 1979, weighted)."
    )
    if tracks:
        text += _consistent(tracks[0])
    return text + "".join(sentence for applies, sentence in _conditions(studies) if applies)


def _conditions(studies: Sequence[Judged]) -> tuple[tuple[bool, str], ...]:
    """Sentences of the method, and whether the report needs them."""
    return (
        (
            any(study.has_truth for study in studies),
            " Half of the false-alarm rate belongs to the mean NEES of whole runs, for which the number of runs is "
            "planned; the other questions share the rest. Where a fault was absent before some step, the factor and "
            "the axes are those since that step.",
        ),
        (
            any(not study.has_truth for study in studies),
            " Without truth the ratio is that of the NIS to its degrees of freedom, and only the innovations of a "
            "filter that declares an optimal gain are judged: those of any other need be neither white nor of the "
            "stated size.",
        ),
        (
            any(_windows(study) for study in studies),
            " Windows of a log count as runs of one step here, because their errors are declared to be independent.",
        ),
        (
            any(study.until_decided for study in studies),
            " In a run until decided the scale is judged by an e-process, a bet against the filter that may be looked "
            "at at any time (Ville 1939); the other questions are asked after 12, 24, 48, ... runs, each time at a "
            "part of their share.",
        ),
    )


def _consistent(track: Estimator) -> str:
    """What consistent and undecided mean."""
    settings, shown = track.verdict.settings, track.verdict.equivalence
    upper = short(settings.factor)
    tests, inside = "two one-sided tests, each", f"between {short(1.0 / settings.factor)} and {upper}"
    if (settings if shown is None else shown).one_sided:
        tests, inside = "a one-sided test", f"below {upper}"
    return (
        f" Consistent is shown: no question found a fault, and {tests} at {100 * (1.0 - settings.power):.2g} %, put "
        f"the ratio of true to stated covariance {inside}. With neither a fault nor that, a filter is undecided: its "
        "sentence has the ratio, its interval, and the number of runs that would probably decide."
    )


SECTION = Section(VERDICTS, read, show)
