"""What the referee asked of each filter, and what it found."""

from __future__ import annotations

from dataclasses import dataclass

from consistency.referee.diagnostics.verdict.answers import ABOUT, MAIN
from consistency.referee.diagnostics.verdict.parts import Answer
from consistency.referee.document import blocks
from consistency.referee.document.blocks import Block, Column, Heading, Small, Stack, Text, table
from consistency.referee.document.wording import p_cell
from consistency.referee.pages.judged_estimators import Judged

FOUND, TOLERATED, NOT_FOUND, NOT_ASKED = "✗", "≈", "○", "–"
MARKS = {FOUND: "found", TOLERATED: "found, within the tolerance", NOT_FOUND: "not found", NOT_ASKED: "not asked"}
NARROW = 4  # filters beside which the questions have less room


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
            questions.append(Question(name, ABOUT.get(name, ""), given))
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
