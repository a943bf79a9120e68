"""Components whose cross terms are not stated, as where an estimator gives standard deviations alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from consistency.referee.diagnostics.judging.record_findings import findings_of
from consistency.referee.diagnostics.judging.status import few_lost, withheld
from consistency.referee.diagnostics.questions.equivalence import worst
from consistency.referee.diagnostics.questions.lost_runs import lost_of
from consistency.referee.diagnostics.questions.sample import names_of
from consistency.referee.diagnostics.questions.scale import FEW, ratio_interval, run_means
from consistency.referee.diagnostics.records.record import Record
from consistency.referee.diagnostics.records.whitening import squared_length, whiten
from consistency.referee.diagnostics.verdict.answers import SHARES, Settings
from consistency.referee.diagnostics.verdict.parts import Answer, Lost, Scale
from consistency.referee.diagnostics.verdict.verdict import UNKNOWN_ENDS, Findings
from consistency.referee.types import Array

INNOVATIONS = "innovations"


def findings_of_parts(record: Record, settings: Settings, unshown: str = "") -> Findings:
    """Judge each part of a record by itself; see ``Record.parts``.

    A part is a component, or several whose cross terms are stated. Of two parts only the marginal covariances are
    known, and a NEES with cross terms of 0 is not chi-square unless the errors are uncorrelated. All questions are
    asked of each part, and of the innovations if these are judged, at a false-alarm rate that Holm's procedure (1979)
    divides: whatever the correlations, a right estimator is found at fault in any part with probability
    ``false_alarm`` at most. It is *consistent* if every part is, each at ``power``. The mean of the whole NEES is
    expected to be n under any correlation; it is reported and not judged.

    Parameters
    ----------
    unshown : why nothing can be shown, as for :func:`findings_of`

    Raises
    ------
    ValueError
        As :func:`consistency.diagnostics.judge`.
    """
    if unshown:
        record = replace(record, unavailable=tuple(SHARES))
    parts = _by_holm(_records_of_parts(record), settings)
    whole = findings_of(replace(record, parts=(), unavailable=tuple(SHARES), optimal_gain=False), settings)
    nees = _nees_over_n(record)
    lost = lost_of(record, nees, 1, settings)  # a mean of chi-square(1), however they depend on each other
    innovations = whole.innovations
    accuracy = whole.accuracy
    scale = whole.scale
    if INNOVATIONS in parts:
        innovations = parts[INNOVATIONS].innovations
    if accuracy is not None:
        accuracy = replace(accuracy, nci=float("nan"), inclination=float("nan"))
    if scale is not None:
        scale = _scale_of_whole(scale, parts, record, nees)
    unshown, status, scale = withheld(unshown, _status(list(parts.values()), lost, settings), scale)
    return replace(
        whole,
        status=status,
        settings=settings,
        answers=tuple(_answers(parts, settings)),
        scale=scale,
        parts=parts,
        lost=lost,
        location=None,
        by_group=None,
        shape=None,
        tails=None,
        accuracy=accuracy,
        innovations=innovations,
        unshown=unshown,
    )


def _records_of_parts(record: Record) -> dict[str, Record]:
    """A record of the errors of each part, and one of the innovations if they are judged."""
    names = names_of(record)
    axes = record.axes or names
    assert record.error is not None
    covariance = np.asarray(record.covariance, float)
    records = {}
    for index in record.parts:
        some = list(index)
        records[", ".join(names[i] for i in index)] = replace(
            record,
            error=record.error[..., some],
            covariance=covariance[..., some, :][..., some],
            dof=len(some),
            axes=tuple(axes[i] for i in index),
            parts=(),
            nis=None,
            nis_dof=None,
            innovations=None,
            innovation_covariances=None,
            optimal_gain=False,
        )
    if record.optimal_gain and record.nis is not None:
        records[INNOVATIONS] = replace(record, error=None, covariance=None, nees=None, dof=0, parts=())
    return records


def _by_holm(records: Mapping[str, Record], settings: Settings) -> dict[str, Findings]:
    """Findings of all parts; those without a fault are asked again at what the others leave of the rate."""
    found: dict[str, Findings] = {}
    left = list(records)
    while left:
        at = replace(settings, false_alarm=settings.false_alarm / len(left), subsets=None, lost=None)
        for name in left:
            found[name] = findings_of(records[name], at)
        right = [name for name in left if not found[name].faults]
        if len(right) == len(left):
            break
        left = right
    return {name: found[name] for name in records}


def _nees_over_n(record: Record) -> Array:
    """NEES by the stated variances over the number of components, (runs, steps); NaN where it does not count."""
    assert record.error is not None
    assert record.covariance is not None
    nees = squared_length(whiten(record.error, record.covariance)) / record.error.shape[-1]
    counted = np.isfinite(nees)
    if record.nees is not None:
        counted = np.isfinite(record.nees)
    return np.where(counted, nees, np.nan)


def _scale_of_whole(whole: Scale, parts: Mapping[str, Findings], record: Record, nees: Array) -> Scale:
    """The size of all errors, with what is known of it whatever the correlations."""
    scales = [part.scale for part in parts.values() if part.scale is not None]
    means, counts = run_means(nees)
    inflation = whole.inflation
    if counts.astype(bool).sum() < FEW:  # the errors of all parts may be the same
        inflation = ratio_interval(means[counts > 0], min(map(len, record.parts)))
    return replace(
        whole,
        inflation=inflation,
        band=np.full_like(whole.band, np.nan),
        accepted=UNKNOWN_ENDS,
        share_inside=float("nan"),
        within=None,
        detectable=max(scale.detectable for scale in scales),
        equivalence=worst([scale.equivalence for scale in scales]),
    )


def _answers(parts: Mapping[str, Findings], settings: Settings) -> list[Answer]:
    """Answers of all parts, corrected for their number."""
    given = []
    for name, part in parts.items():
        among = settings.false_alarm / part.settings.false_alarm  # parts that shared the rate with it
        for answer in part.answers:
            adjusted = min(1.0, answer.adjusted * among)
            question = f"{answer.question} of {name}"
            share = answer.share / len(parts)
            given.append(replace(answer, question=question, share=share, adjusted=adjusted))
    return given


def _status(parts: Sequence[Findings], lost: Lost | None, settings: Settings) -> str:
    """That of the parts at fault where they agree; a bias beside a wrong size is named in the sentence alone."""
    faults = {part.status for part in parts if part.faults}
    if faults - {"biased"}:
        faults.discard("biased")
    if len(faults) > 1:
        return "inconsistent"
    if faults:
        return faults.pop()
    statuses = {part.status for part in parts}
    if "failed" in statuses:
        return "failed"
    if statuses == {"consistent"} and few_lost(lost, settings):
        return "consistent"
    return "undecided"
