"""The verdict on components whose cross terms are not stated, as where an estimator gives standard deviations alone."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np

from consistency.referee.diagnostics.questions.equivalence import worst
from consistency.referee.diagnostics.questions.lost_runs import lost_of
from consistency.referee.diagnostics.questions.scale import FEW, ratio_interval, run_means
from consistency.referee.diagnostics.records.large_arrays import Symmetric
from consistency.referee.diagnostics.records.record import Record
from consistency.referee.diagnostics.questions.sample import names_of
from consistency.referee.diagnostics.records.whitening import squared_length, whiten
from consistency.referee.diagnostics.verdict.answers import SCALE, SHARES
from consistency.referee.diagnostics.verdict.parts import Answer, Settings, Verdict
from consistency.referee.diagnostics.judging.decide import judge_alone
from consistency.referee.diagnostics.words import sentences
from consistency.referee.diagnostics.judging.status import clear, few_lost

INNOVATIONS = "innovations"


def judge_parts(record: Record, settings: Settings) -> Verdict:
    """Judge each part of a record by itself; see ``Record.parts``.

    A part is a component, or several whose cross terms are stated. Of two parts only the marginal covariances are
    known, and a NEES with cross terms of 0 is not chi-square unless the errors are uncorrelated. All questions are
    asked of each part, and of the innovations if these are judged, at a false-alarm rate that Holm's procedure (1979)
    divides: whatever the correlations, a right estimator is found at fault in any part with probability
    ``false_alarm`` at most. It is *consistent* if every part is, each at ``power``. The mean of the whole NEES is
    expected to be n under any correlation; it is reported and not judged.

    Raises
    ------
    ValueError
        As :func:`consistency.diagnostics.judge`.
    """
    names = names_of(record)
    assert record.error is not None
    assert record.covariance is not None
    records = {}
    for index in record.parts:
        axes = tuple(names[i] for i in index)
        records[", ".join(axes)] = replace(
            record, error=record.error[..., list(index)], covariance=Symmetric.of(record.covariance).part(index),
            dof=len(index), axes=axes, parts=(), nis=None, nis_dof=None, innovations=None,
            innovation_covariances=None, optimal_gain=False,
        )  # fmt: skip
    if record.optimal_gain and record.nis is not None:
        records[INNOVATIONS] = replace(record, error=None, covariance=None, nees=None, dof=0, parts=())
    parts = _by_holm(records, settings)
    whole = judge_alone(replace(record, parts=(), unavailable=tuple(SHARES), optimal_gain=False), settings)
    verdict = _with_parts(whole, parts, record, settings)
    verdict = replace(verdict, status=_status(verdict))
    if any(question in SCALE for part in parts.values() for question in part.faults):
        verdict = replace(verdict, axis=clear(verdict.worst_axis))
    return replace(verdict, reasons=tuple(sentences.reasons(verdict)))


def _by_holm(records: Mapping[str, Record], settings: Settings) -> dict[str, Verdict]:
    """Verdicts of all parts; those without a fault are judged again at what the others leave of the rate."""
    found: dict[str, Verdict] = {}
    left = list(records)
    while left:
        at = replace(settings, false_alarm=settings.false_alarm / len(left), subsets=None, lost=None)
        found |= {name: judge_alone(records[name], at) for name in left}
        right = [name for name in left if not found[name].faults]
        left = right if len(right) < len(left) else []
    return {name: found[name] for name in records}


def _with_parts(whole: Verdict, parts: Mapping[str, Verdict], record: Record, settings: Settings) -> Verdict:
    """The whole with what is known of it whatever the correlations, and the answers of its parts."""
    assert record.error is not None
    assert record.covariance is not None
    nees = squared_length(whiten(record.error, record.covariance)) / record.error.shape[-1]
    nees[~np.isfinite(nees if record.nees is None else record.nees)] = np.nan
    scale, scales = whole.scale, [part.scale for part in parts.values() if part.scale is not None]
    if scale is not None:
        nothing = (float("nan"), float("nan"))
        means, counts = run_means(nees)
        if counts.astype(bool).sum() < FEW:  # the errors of all parts may be the same
            interval = ratio_interval(means[counts > 0], min(map(len, record.parts)))
            scale = replace(scale, inflation=interval)
        scale = replace(
            scale, band=np.full_like(scale.band, np.nan), accepted=nothing, share_inside=float("nan"), within=None,
            detectable=max(s.detectable for s in scales), equivalence=worst([s.equivalence for s in scales]),
        )  # fmt: skip
    lost = lost_of(record, nees, 1, settings)  # a mean of chi-square(1), however they depend on each other
    innovations = parts[INNOVATIONS].innovations if INNOVATIONS in parts else whole.innovations
    accuracy = whole.accuracy and replace(whole.accuracy, nci=float("nan"), inclination=float("nan"))
    return replace(
        whole, settings=settings, answers=tuple(_answers(parts, settings)), scale=scale, parts=parts, lost=lost,
        location=None, shape=None, tails=None, accuracy=accuracy, innovations=innovations,
    )  # fmt: skip


def _answers(parts: Mapping[str, Verdict], settings: Settings) -> Iterator[Answer]:
    """Answers of all parts, corrected for their number."""
    for name, part in parts.items():
        among = settings.false_alarm / part.settings.false_alarm  # parts that shared the rate with it
        for a in part.answers:
            adjusted = min(1.0, a.adjusted * among)
            yield replace(a, question=f"{a.question} of {name}", share=a.share / len(parts), adjusted=adjusted)


def _status(v: Verdict) -> str:
    """That of the parts at fault where they agree; a bias beside a wrong size is named in the sentence alone."""
    faults = {part.status for part in v.parts.values() if part.faults}
    if faults:
        faults = faults - {"biased"} or faults
        return faults.pop() if len(faults) == 1 else "inconsistent"
    statuses = {part.status for part in v.parts.values()}
    if "failed" in statuses:
        return "failed"
    return "consistent" if statuses == {"consistent"} and few_lost(v) else "undecided"
