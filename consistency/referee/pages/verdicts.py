"""Verdicts on estimators that were judged on the same runs, and how a verdict comes about."""

from __future__ import annotations

from collections.abc import Sequence

from consistency.referee.diagnostics.words.numbers import names_in_a_row, plural, short
from consistency.referee.document.blocks import Block, Cell, Column, Heading, Name, Reasons, table
from consistency.referee.document.judged_filters import FILTER, cells, columns, page, reason, with_values
from consistency.referee.pages.judged_estimators import Estimator, Judged

FAILURES = (
    Column("Filter", width="1.4fr"),
    Column("Run", number=True),
    Column("Step", number=True),
    Column("Reason", width="3fr"),
)
STEP_1 = "A run that failed in step 1 has no estimates; a hang or a crash is counted there, in whatever step it was."


def judgement(study: Judged) -> list[Block]:
    """Table and sentences of one study, and its failed runs."""
    reasons = Reasons(tuple(reason(track.verdict, track.name, track.look, verbose=False) for track in study.tracks))
    view = with_values(page(equivalence_interval(study)), [track.verdict for track in study.tracks])
    cells_of = [(Name(track.name, track.look), *cells(view, track.verdict)) for track in study.tracks]
    label = f"Verdicts of {study.name}"
    shown = table((FILTER, *columns(view)), cells_of, label, caption=verdicts_caption(study), style="narrow")
    blocks: list[Block] = [Heading(study.name), shown, reasons]
    if study.failures:
        rows: list[tuple[Cell, ...]] = [(name, str(run), str(step), why) for name, run, step, why in study.failures]
        failed = f"Failed runs of {study.name}"
        blocks.append(table(FAILURES, rows, failed, caption=f"{failed}: {len(rows)}. {STEP_1}"))
    return blocks


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
    if _windows(study):
        text = f"{plural(study.runs, 'window')}, each of which counts as a run"
    if study.single and study.has_truth:
        text += "; with one run the ANEES is the NEES of that run"
    if study.until_decided:
        when = [f"{track.name} after {plural(track.verdict.runs, 'run')}" for track in study.tracks]
        text += f", until decided: a verdict is that of the look that decided, {names_in_a_row(when)}"
    what = "of true to stated covariance" if study.has_truth else "of the NIS to its degrees of freedom"
    text += f". Shown inside {equivalence_interval(study)}: whether the ratio {what} is shown to lie there"
    if len(study.judged) < len(study.tracks):
        text += ". NIS in parentheses: reported and not judged, as no optimal gain is declared"
    if own := study.own_errors:
        text += f". Judged in an error of their own, but for the RMSE: {names_in_a_row(own)}; see Errors of their own"
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
    conditions = (
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
    return text + "".join(sentence for applies, sentence in conditions if applies)


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
