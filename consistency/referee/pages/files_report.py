"""The report of another estimator: the verdict, its figures, and what was read."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from consistency.referee.diagnostics.records.record import Record
from consistency.referee.diagnostics.verdict.verdict import Verdict
from consistency.referee.diagnostics.words.numbers import plural, with_subject
from consistency.referee.document.blocks import Chapter, Document, Facts, Text
from consistency.referee.pages import questions_table, verdicts
from consistency.referee.pages.judged_estimators import Estimator, Judged, time_axis_of
from consistency.referee.pages.manifest_facts import facts
from consistency.referee.pages.ratio_figures import by_axis, ratio_by_group_figure
from consistency.referee.pages.record_figures import record_figures


def compose_files(
    records: Sequence[Record], judged: Mapping[str, Verdict], title: str, manifest: Mapping[str, Any]
) -> Document:
    """The document that HTML and PDF show; a chapter for each of the records that has a verdict."""
    named = {record.name: record for record in records}
    study = _study(tuple(judged.values()), title)
    several = len(judged) > 1
    chapters = [
        Chapter(
            f"estimator-{i}",
            name,
            name,
            (
                *[Text(with_subject(name, _ended(verdict.reasons[0])))] * several,
                *record_figures(named[name], verdict),
                *ratio_by_group_figure(verdict),
            ),
            _counts(named[name], verdict),
        )
        for i, (name, verdict) in enumerate(judged.items())
    ]
    blocks = (
        *verdicts.judgement(study), *questions_table.diagnosis(study), *by_axis(study),
        Text(verdicts.method((study,)), "How a verdict comes about.", "note"),
    )  # fmt: skip
    notes = list(dict.fromkeys(note for name in judged for note in named[name].notes))
    read = tuple(Text(_begun(note)) for note in notes)
    chapters += [
        Chapter("verdicts", "Verdict in figures", "Figures", blocks),
        Chapter("provenance", "What was read", "Files", (*read, Facts(facts(dict(manifest))))),
    ]
    return Document(f"Estimator consistency: {title}", answer(judged), tuple(chapters))


def answer(judged: Mapping[str, Verdict]) -> str:
    """The sentence of each verdict."""
    return " ".join(with_subject(name, _ended(verdict.reasons[0])) for name, verdict in judged.items())


def _begun(note: str) -> str:
    """A note as a sentence; a path at its beginning stays as it is."""
    if "/" in note.split(maxsplit=1)[0]:
        return _ended(note)
    return _ended(note[:1].upper() + note[1:])


def _ended(sentence: str) -> str:
    return sentence if sentence.endswith((".", "?")) else f"{sentence}."


def _study(judged: tuple[Verdict, ...], title: str) -> Judged:
    tracks = tuple(Estimator(v.filter, i, f"0-{i}", v, v.failures) for i, v in enumerate(judged))
    runs, steps = max(v.runs for v in judged), max(v.steps for v in judged)
    return Judged(title, "", runs, 0, time_axis_of(np.full(steps, np.nan)), np.arange(1, steps + 1), tracks, False)


def _counts(record: Record, verdict: Verdict) -> str:
    clock = time_axis_of(record.t)
    length = plural(verdict.steps, "step" if record.window is None else "window")
    size = f"{plural(verdict.runs, verdict.unit)} of {record.window if record.independent else length}"
    return f"{size}, {np.ptp(clock.values):.4g} s" if clock.word == "s" and len(record.t) > 1 else size
