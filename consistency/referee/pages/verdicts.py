"""Estimators that were judged on the same runs.

Pages show their verdicts, what the referee asked of each, and the axis along the runs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from consistency.referee.diagnostics.bound_words import level_text
from consistency.referee.diagnostics.number_words import names_in_a_row, plural, short
from consistency.referee.diagnostics.verdict import Verdict
from consistency.referee.diagnostics.verdict_parts import ABOUT, MAIN, Answer, BoundScore
from consistency.referee.show import blocks
from consistency.referee.show.blocks import (
    Block,
    Cell,
    Column,
    Heading,
    Look,
    Name,
    Reasons,
    Small,
    Stack,
    Switch,
    Text,
    p_cell,
    style,
    table,
)
from consistency.referee.types import Array, Failure, Indices
from consistency.referee.verdicts.tables import FILTER, cells, columns, known_measures, page, reason

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FAILURES = (
    Column("Filter", width="1.4fr"),
    Column("Run", number=True),
    Column("Step", number=True),
    Column("Reason", width="3fr"),
)
STEP_1 = "A run that failed in step 1 has no estimates; a hang or a crash is counted there, in whatever step it was."
FOUND, TOLERATED, NOT_FOUND, NOT_ASKED = "✗", "≈", "○", "–"
MARKS = {FOUND: "found", TOLERATED: "found, within the tolerance", NOT_FOUND: "not found", NOT_ASKED: "not asked"}
OUTSIDE = "share of the steps of a run in which the error is outside, against 1 - level"
NARROW = 4  # filters beside which the questions have less room
LATE = 0.05  # of its span by which a clock may begin after zero, and be shown as it is
DECADE = 10.0  # values that span more are drawn on a log axis


def judgement(study: Judged) -> list[Block]:
    """Table and sentences of one study, and its failed runs."""
    reasons = Reasons(tuple(reason(track.verdict, track.name, track.look, verbose=False) for track in study.tracks))
    view = known_measures(page(equivalence_interval(study)), [track.verdict for track in study.tracks])
    cells_of = [(Name(track.name, track.look), *cells(view, track.verdict)) for track in study.tracks]
    label = f"Verdicts of {study.name}"
    shown = table((FILTER, *columns(view)), cells_of, label, caption=verdicts_caption(study), style="narrow")
    blocks: list[Block] = [Heading(study.name), shown, reasons]
    if study.failures:
        rows: list[tuple[Cell, ...]] = [(name, str(run), str(step), why) for name, run, step, why in study.failures]
        failed = f"Failed runs of {study.name}"
        blocks.append(table(FAILURES, rows, failed, caption=f"{failed}: {len(rows)}. {STEP_1}"))
    return blocks


SHARES = ("Inside (%)", "Above (%)", "Below (%)", "Excluded outside (%)")
BOUNDS = (
    Column("Bound", width="2fr"),
    Column("Verdict"),
    *(Column(head, number=True) for head in ("Level", *SHARES, "Factor it must grow by")),
)


def bounds_tables(study: Judged) -> list[Block]:
    """Coverage and factor of each bound and group, a table for each estimator that states bounds."""
    tables: list[Block] = []
    for track in study.tracks:
        rows = [_bound_cells(score) for score in track.verdict.bounds]
        if rows:
            label = f"Bounds of {track.name}"
            tables.append(table(BOUNDS, rows, label, caption=f"{label}: how often the error stays inside."))
    return tables


def _bound_cells(score: BoundScore) -> tuple[Cell, ...]:
    shares = (1.0 - score.rate, score.above, score.below, score.rate_limit)
    inside, above, below, limit = (blocks.Quantity(100.0 * share, digits=".3g") for share in shares)
    factor = blocks.Quantity(score.factor.value, score.factor[1:], is_factor=True)
    status = blocks.Status(score.status or "not judged")
    return score.name, status, level_text(score.level), inside, above, below, limit, factor


def equivalence_interval(study: Judged) -> str:
    """Where consistent filters are shown to have their ratio of true to stated covariance; the same for all."""
    if not study.tracks:
        return ""
    verdict = study.tracks[0].verdict
    shown = verdict.equivalence
    factor, one_sided = verdict.settings.factor, verdict.settings.one_sided
    if shown is not None:
        factor, one_sided = shown.factor, shown.one_sided
    low = "(0" if one_sided else f"[{short(1.0 / factor)}"
    return f"{low},\u00a0{short(factor)}]"


def verdicts_caption(study: Judged) -> str:
    """How large the study is, and how to read the table of verdicts."""
    text = f"{plural(study.runs, 'run')} of {plural(len(study.steps), 'step')}"
    for unit in UNITS:
        if _has(unit, study):
            text = f"{plural(study.runs, unit)}, each of which counts as a run"
    if study.single and study.has_truth:
        text += "; with one run the ANEES is the NEES of that run"
    if study.until_decided:
        when = [f"{track.name} after {plural(track.verdict.runs, 'run')}" for track in study.tracks]
        text += f", until decided: a verdict is that of the look that decided, {names_in_a_row(when)}"
    what = "the ratio of true to stated covariance"
    if study.of_bounds:
        what = "the factor by which bounds must grow"
    elif not study.has_truth:
        what = "the ratio of the NIS to its degrees of freedom"
    text += f". Shown inside {equivalence_interval(study)}: whether {what} is shown to lie there"
    innovations = [track.verdict.innovations for track in study.tracks]
    if any(own is not None and np.isfinite(own.ratio) and not own.judged for own in innovations):
        text += ". NIS in parentheses: reported and not judged, as no optimal gain is declared"
    if own := study.own_errors:
        text += f". Judged in an error of their own, but for the RMSE: {names_in_a_row(own)}; see Errors of their own"
    return f"{text}."


UNITS = {"window": "Windows of a log", "row": "Rows"}  # that stand in the place of runs


def _has(unit: str, study: Judged) -> bool:
    """Whether units of this name stand in the place of runs."""
    return any(track.verdict.unit == unit for track in study.tracks)


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
    conditions = (
        (
            any(study.has_truth and not study.of_bounds for study in studies),
            " Half of the false-alarm rate belongs to the mean NEES of whole runs, for which the number of runs is "
            "planned; the other questions share the rest. Where a fault was absent before some step, the factor and "
            "the axes are those since that step.",
        ),
        (
            any(study.of_bounds for study in studies),
            " Bounds are judged by the share of the steps of each run in which the error is outside. A fault is found "
            "by Gaffke's test (2005), whose rate is measured, and up to a false-alarm rate of .001 by a bet against "
            "the bound (Waudby-Smith & Ramdas 2024), whose rate is proved. Steps after the end of a run count as "
            "inside for 'too small' and as outside for 'too large'. The factor is that by which the bound must grow, "
            "with its 95 % interval by inversion of the test.",
        ),
        (
            any(not study.has_truth for study in studies),
            " Without truth the ratio is that of the NIS to its degrees of freedom, and only the innovations of a "
            "filter that declares an optimal gain are judged: those of any other need be neither white nor of the "
            "stated size.",
        ),
        *(
            (
                any(_has(unit, study) for study in studies),
                f" {name} count as runs of one step here, because their errors are declared to be independent.",
            )
            for unit, name in UNITS.items()
        ),
        (
            any(study.until_decided for study in studies),
            " In a run until decided the scale is judged by an e-process, a bet against the filter that may be looked "
            "at at any time (Ville 1939); the other questions are asked after 12, 24, 48, ... runs, each time at a "
            "part of their share.",
        ),
    )
    return text + "".join(sentence for applies, sentence in conditions if applies)


def _consistent(track: Estimator) -> str:
    """What consistent and undecided mean."""
    settings, shown = track.verdict.settings, track.verdict.equivalence
    factor, what = settings.factor, "the ratio of true to stated covariance"
    if track.verdict.bounds and shown is not None:
        factor, what = shown.factor, "the factor by which each bound must grow"
    upper = short(factor)
    tests, inside = "two one-sided tests, each", f"between {short(1.0 / factor)} and {upper}"
    if (settings if shown is None else shown).one_sided:
        tests, inside = "a one-sided test", f"below {upper}"
    return (
        f" Consistent is shown: no question found a fault, and {tests} at {100 * (1.0 - settings.power):.2g} %, put "
        f"{what} {inside}. With neither a fault nor that, a filter is undecided: its "
        "sentence has the ratio, its interval, and the number of runs that would probably decide."
    )


@dataclass(frozen=True)
class Question:
    """One question to all filters."""

    name: str
    about: str  # what is compared
    answers: tuple[Answer | None, ...]  # None: could not be asked


def asked(study: Judged) -> tuple[Question, ...]:
    """All questions in the referee's order, with the answers that the verdicts hold."""
    by_filter = [{a.question: a for a in track.verdict.answers} for track in study.tracks]
    known = list(ABOUT) + [q for answers in by_filter for q in answers if q not in ABOUT]
    questions = []
    for name in dict.fromkeys(known):
        given = tuple(answers.get(name) for answers in by_filter)
        if any(answer is not None for answer in given):
            questions.append(Question(name, ABOUT.get(name, OUTSIDE if study.of_bounds else ""), given))
    return tuple(questions)


def diagnosis(study: Judged) -> tuple[Block, ...]:
    """Table with a row for each question and a column for each filter."""
    heading, questions = Heading("Diagnosis"), asked(study)
    if not questions:
        return heading, Text("There was nothing to ask.")
    width = "3.2fr" if len(study.tracks) > NARROW else "2.2fr"
    filters = (Column(track.name, width="1fr", number=True) for track in study.tracks)
    columns = (Column("Question, and what is compared", width=width), *filters)
    rows: list[tuple[blocks.Cell, ...]] = [
        (Stack(q.name, (Small(q.about),), bold=True), *map(_cell, q.answers)) for q in questions
    ]
    label = f"Questions asked of the filters of {study.name}"
    return heading, table(columns, rows, label, caption=marks_caption(study), style="marks", whole=True)


def answer_cell(answer: Answer | None) -> tuple[str, str]:
    """Mark, one of MARKS, and corrected p value of one filter's answer to one question."""
    if answer is None:
        return NOT_ASKED, ""
    mark = NOT_FOUND
    if answer.tolerated:
        mark = TOLERATED
    elif answer.found:
        mark = FOUND
    return mark, p_cell(answer.adjusted)


def _cell(answer: Answer | None) -> blocks.Answer:
    mark, p = answer_cell(answer)
    emphasis = {FOUND: "found", TOLERATED: "tolerated"}.get(mark, "")
    return blocks.Answer(mark, MARKS[mark], p, emphasis)  # type: ignore[arg-type]


def marks_caption(study: Judged) -> str:
    """How to read the table."""
    tracks = study.tracks
    rate = 100 * tracks[0].verdict.settings.false_alarm if tracks else 5.0
    tolerance = next((track.verdict.settings.tolerated for track in tracks), 1.0)
    within = f"{TOLERATED} one was found, but is shown to lie within the tolerance of ×{tolerance:g}, "
    tolerated = any(answer.tolerated for track in tracks for answer in track.verdict.answers)
    text = (
        f"{FOUND} a fault was found, {within if tolerated else ''}{NOT_FOUND} none was found, "
        f"{NOT_ASKED} could not be asked. The number is the corrected p value: the false-alarm rate of the whole "
        f"verdict at which the fault would just be found ({rate:.2g} % or less is a fault)."
    )
    if study.until_decided:
        text += f" A verdict between two looks asks {MAIN} alone; the p values of the others are then 1."
    return text


@dataclass(frozen=True)
class Clock:
    """A place on the axis for each of T steps."""

    values: Array  # (T,)
    label: str
    word: str  # "s" or "step"
    note: str = ""  # where the clock begins, if not at zero

    def name(self, axes: Axes) -> None:
        """The name of the axis of time, below a panel."""
        axes.set_xlabel(self.label)

    def span(self, axes: Axes) -> None:
        """Draw the axis from zero to the last step."""
        self.name(axes)
        if len(self.values):
            axes.set_xlim(min(0.0, float(self.values[0])), float(self.values[-1]))


def time_axis_of(t: Array) -> Clock:
    """Seconds from the first step on, or steps where not all have an increasing time.

    Parameters
    ----------
    t : (T,), s; NaN where a step has none
    """
    if not len(t) or not np.isfinite(t).all() or (np.diff(t) <= 0.0).any():
        return Clock(np.arange(1.0, len(t) + 1), "step", "step")
    if 0.0 <= t[0] <= LATE * np.ptp(t):
        return Clock(t, "time (s)", "s")
    return Clock(t - t[0], "time (s)", "s", f" Time 0 is {t[0]:.2f} s.")


@dataclass(frozen=True)
class Estimator:
    """One filter or estimator in one study, with the verdict on it."""

    name: str
    style: int  # the same number for the same filter in the whole report
    tag: str  # of the filter in this study, which its checkbox has
    verdict: Verdict
    failures: tuple[Failure, ...]  # of all runs, also of those after the look that decided

    @property
    def look(self) -> Look:
        return style(self.style)

    @property
    def innovations_judged(self) -> bool:
        """Whether the filter declares an optimal gain; innovations of any other are reported only."""
        return self.verdict.innovations is not None and self.verdict.innovations.judged


@dataclass(frozen=True)
class Judged:
    """Estimators that were judged on the same runs."""

    name: str
    summary: str
    runs: int
    shown_run: int  # the one that is drawn where only one can be
    clock: Clock
    steps: Indices  # (T,), 1..T
    tracks: tuple[Estimator, ...]
    until_decided: bool  # each verdict is that of the look that decided it

    @property
    def has_truth(self) -> bool:
        return self.of_bounds or any(track.verdict.scale is not None for track in self.tracks)

    @property
    def of_bounds(self) -> bool:
        """Whether bounds are judged in place of covariances."""
        return any(track.verdict.bounds for track in self.tracks)

    @property
    def single(self) -> bool:
        """One run: the curve is a NEES, no average."""
        return self.runs == 1

    @property
    def statistic(self) -> str:
        return "NEES" if self.single else "ANEES"

    @property
    def judged(self) -> list[str]:
        """Filters whose innovations are judged."""
        return [track.name for track in self.tracks if track.innovations_judged]

    @property
    def own_errors(self) -> list[str]:
        """Filters that are judged in an error of their own, with its convention."""
        return [f"{t.name} ({t.verdict.convention})" for t in self.tracks if t.verdict.world is not None]

    @property
    def failures(self) -> list[tuple[str, int, int, str]]:
        """Filter, run, step and reason of every failed run."""
        return [
            (track.name, int(failure.run), int(failure.step), failure.reason)
            for track in self.tracks
            for failure in track.failures
        ]

    @property
    def switches(self) -> tuple[Switch, ...]:
        """Filters that a reader can hide."""
        return tuple(Switch(track.name, track.look, track.tag) for track in self.tracks)


def wide(values: list[Array]) -> bool:
    """Whether the values above zero, in arrays of any shape, span more than a decade."""
    flat = np.concatenate([v.ravel() for v in values]) if values else np.empty(0)
    flat = flat[np.isfinite(flat) & (flat > 0)]
    return bool(flat.size) and bool(flat.max() > DECADE * flat.min())
