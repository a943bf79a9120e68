"""The verdict on one filter, from its errors over independent runs."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from consistency.referee.defaults import CONFIDENCE
from consistency.referee.diagnostics.statistics.number_of_runs import detectable_ratio
from consistency.referee.diagnostics.questions.band import simultaneous_band
from consistency.referee.diagnostics.questions.equivalence import (
    equivalence,
    equivalence_by_betting,
    equivalence_of_total,
    is_tolerated,
)
from consistency.referee.diagnostics.questions.lost_runs import early_ends, lost_of
from consistency.referee.diagnostics.questions.scale import acceptance, pointwise_band, ratio_interval
from consistency.referee.diagnostics.records.large_arrays import Symmetric
from consistency.referee.diagnostics.records.record import Record
from consistency.referee.diagnostics.questions.sample import Sample, impossible, innovations_of, sample_of
from consistency.referee.diagnostics.questions.sample import shape_of as shape_of_arrays
from consistency.referee.diagnostics.statistics.nees import anees, chi2_mean_interval
from consistency.referee.diagnostics.verdict.answers import (
    AXIS,
    DIRECTION,
    JOINT,
    MAIN,
    SHARES,
    STEP,
    Tests,
    answers,
    ask,
)
from consistency.referee.diagnostics.judging.fault_location import (
    accuracy_of,
    axes_of,
    bias_of,
    location_of,
    shape_of,
    tails_of,
)
from consistency.referee.diagnostics.verdict.parts import (
    Answer,
    Equivalence,
    Innovations,
    Location,
    Scale,
    Settings,
    Verdict,
)
from consistency.referee.diagnostics.words import sentences
from consistency.referee.diagnostics.judging.status import at_share, deciding_axis, status_of

if TYPE_CHECKING:
    from consistency.referee.diagnostics.imperfect_truth.uncertain_truth import UncertainTruth
    from consistency.referee.diagnostics.maps.map_nees import JointTest

DEFAULT = Settings()


@dataclass(frozen=True)
class Look:
    """One of several looks at growing evidence; see :mod:`consistency.referee.diagnostics.planning.early_stopping`."""

    spent: float | None  # part of the false-alarm rate of every question but the scale that this look may cost;
    # None where nothing but the scale is asked
    scale: float  # p value of the scale, valid at any time


def judge_alone(
    evidence: Record, settings: Settings = DEFAULT, look: Look | None = None, truth: UncertainTruth | None = None
) -> Verdict:
    """Judge the errors and innovations of a record, and nothing beside them; see :func:`judging.judge`.

    With a ``truth`` that is uncertain ``evidence`` is :attr:`UncertainTruth.evidence`.
    """
    runs, steps = shape_of_arrays(evidence)
    both_sides = settings
    settings = replace(settings, allow="conservative") if evidence.reduced else settings
    innovations, p_values = _innovations(evidence, settings)
    sample = sample_of(evidence, settings)
    joint: JointTest | None = None
    excused, tests = set[str](), None
    if evidence.joint is not None:
        from consistency.referee.diagnostics.maps.map_nees import joint_test

        joint = joint_test(evidence.joint, settings, evidence.run_numbers, evidence.landmarks)
        p_values |= joint.p_values
        excused = {JOINT} if is_tolerated(joint.nees, joint.score.dof, settings) else excused
    if sample is not None:
        tests = ask(sample, settings, p_values, look.scale if look else None)
        asked = tests.p_values if truth is None else truth.p_values(tests.p_values, settings)
        p_values |= {q: p for q, p in asked.items() if q not in evidence.unavailable}
    if look is not None:
        p_values = _at(look, p_values)
    by_question = answers(p_values, settings.false_alarm)
    i = innovations
    if i is not None and i.judged and not i.outliers and is_tolerated(i.ratio * i.dof, i.dof, settings):
        excused |= {"innovation scale"}
    verdict = Verdict(
        evidence.name, "failed", (), runs, steps, settings, _excused(by_question.values(), excused), evidence.failures,
        innovations=innovations, landmarks=evidence.landmarks, joint=None if joint is None else joint.score,
        unit=evidence.unit, skipped=evidence.skipped,
    )  # fmt: skip
    if sample is not None and evidence.landmarks is None:
        ends = early_ends(sample.nees)
        verdict = replace(verdict, ends=ends if ends.runs else None)
    if sample is not None and tests is not None:
        shown = _equivalence(sample, both_sides, look, evidence, truth)
        lost = lost_of(evidence, sample.nees, sample.dof, settings, any_time=look is not None)
        verdict = _with_records(replace(verdict, lost=lost), evidence, sample, tests, shown)
    verdict = replace(verdict, status=status_of(verdict, sample, tests, joint))
    verdict = verdict if truth is None else truth.of_estimate(verdict)
    verdict = replace(verdict, axis=deciding_axis(verdict))
    return replace(verdict, reasons=tuple(sentences.reasons(verdict)))


def _at(look: Look, p_values: dict[str, float]) -> dict[str, float]:
    """p values corrected for the number of looks; the share of the scale stays what it is if it is asked alone."""
    if look.spent is None:
        return {q: p if q == MAIN else 1.0 for q, p in p_values.items() if np.isfinite(p)}
    return {q: p if q == MAIN or not np.isfinite(p) else min(1.0, p / look.spent) for q, p in p_values.items()}


# --- innovations -------------------------------------------------------------------------------------


def _innovations(evidence: Record, settings: Settings) -> tuple[Innovations | None, dict[str, float]]:
    nis_and_dof = innovations_of(evidence)
    if nis_and_dof is None:
        return None, {}
    from consistency.referee.diagnostics.questions.innovations import nis_test, nis_whiteness, outliers_of, whiteness

    test = nis_test(*nis_and_dof)
    low_high = chi2_mean_interval(test.dof, CONFIDENCE) if test.dof else (float("nan"), float("nan"))
    if evidence.innovations is not None and evidence.innovation_covariances is not None:
        white = whiteness(evidence.innovations, evidence.innovation_covariances)
    else:
        white = nis_whiteness(*nis_and_dof)
    judged = evidence.optimal_gain
    factor = max(settings.factor, settings.tolerated)
    shown = equivalence_of_total(test.ratio * test.dof, test.dof, settings, factor) if judged else None
    record = Innovations(test.ratio, low_high, test.dof, judged, white.correlation, white.bound, shown)
    if not judged:
        return record, {}
    p = {"innovation scale": test.above if settings.one_sided else test.p_value}
    if (far := outliers_of(*nis_and_dof)) is not None:
        p["innovation scale"] = min(p["innovation scale"], far.p_value)
        far = replace(far, run=int(evidence.run_numbers[far.run]), step=far.step + 1)
        record = replace(record, outliers=far)
    return record, p if settings.one_sided else p | {"innovation whiteness": white.p_value}


# --- results beside the p values -----------------------------------------------------------------


def _with_records(verdict: Verdict, evidence: Record, sample: Sample, tests: Tests, shown: Equivalence) -> Verdict:
    settings = verdict.settings
    if settings.tolerance is not None:
        verdict = replace(verdict, answers=_excused(verdict.answers, _tolerated(sample, tests, settings)))
    by_question = {a.question: a for a in verdict.answers if not a.tolerated}
    band = tests.band
    step = by_question.get(STEP)
    if step is not None and step.found and not band.outside.any():  # found by what Holm's correction left over
        rate = np.nextafter(tests.band.p_value, 1.0) * (1 + 1e-6)
        band = simultaneous_band(sample.nees, sample.dof, rate, settings.method, settings.allow)
    location = location_of(sample, band, by_question, ordered=evidence.landmarks is None, detect=settings.factor)
    scale = _scale_of(sample, tests, at_share(verdict), location, shown)
    if sample.errors is None or evidence.error is None or evidence.covariance is None:
        return replace(verdict, scale=scale, location=location, tails=tails_of(tests, evidence.run_numbers))
    odd = impossible(evidence, sample.counted)
    there = Symmetric.of(evidence.covariance).where_all(np.isfinite)
    return replace(
        verdict,
        scale=scale,
        location=location,
        impossible=tuple((int(run), int(k) + 1) for run, k in np.argwhere(odd)),
        left_out_steps=tuple(int(k) + 1 for k in np.flatnonzero((there & ~sample.counted).any(axis=0))),
        axes=axes_of(sample, tests, location),
        bias=bias_of(sample, tests.bias_step, location, by_question),
        shape=shape_of(sample, tests, by_question, at_share(verdict).false_alarm),
        tails=tails_of(tests, evidence.run_numbers),
        accuracy=accuracy_of(sample),
    )


def _equivalence(
    sample: Sample, settings: Settings, look: Look | None, evidence: Record, truth: UncertainTruth | None
) -> Equivalence:
    if look is not None:
        return equivalence_by_betting(sample.means(), sample.dof, settings)
    factor = max(settings.factor, settings.tolerated)
    if truth is not None:
        return truth.equivalence(sample, settings, factor)
    return equivalence(
        sample.means(), sample.dof, sample.longest, settings, factor, not evidence.reduced, evidence.unseen
    )


def _excused(all_answers: Iterable[Answer], questions: set[str]) -> tuple[Answer, ...]:
    """Answers with the faults in these questions marked as tolerated."""
    return tuple(replace(a, tolerated=True) if a.found and a.question in questions else a for a in all_answers)


def _tolerated(sample: Sample, tests: Tests, settings: Settings) -> set[str]:
    """Questions about the scale whose ratio is shown to lie within the tolerance, whatever they found."""
    R, steps = settings.tolerated, sample.longest
    if not equivalence(sample.means(), sample.dof, steps, settings, R).shown:
        return set()
    tolerated = {MAIN}
    if sample.errors is not None:
        groups = sample.errors.groups.values()
        if all(equivalence(sample.group_means(g), len(g), steps, settings, R).shown for g in groups):
            tolerated |= {AXIS}
    if tests.largest is not None and tests.largest.ratio.high <= R:
        tolerated |= {DIRECTION}
    band = tests.band
    curve = anees(sample.nees)
    outside = (curve > band.high * R) | (curve < band.low / R)
    return tolerated if outside.any() else tolerated | {STEP}


def _scale_of(sample: Sample, tests: Tests, settings: Settings, location: Location, shown: Equivalence) -> Scale:
    """Assemble the record of the scale; the inflation is that since the fault began, if it began late."""
    dof, means = sample.dof, sample.means()
    alive = sample.counted.sum(axis=0)
    curve, band = anees(sample.nees), pointwise_band(alive, dof)
    judged = alive > 0
    some = bool(judged.any())
    rate = SHARES[MAIN] * settings.false_alarm
    inside = (curve >= band[:, 0]) & (curve <= band[:, 1])
    of_log = None
    if len(sample.nees) == 1:
        from consistency.referee.diagnostics.planning.single_log import within

        of_log = within(sample.nees[0], dof, settings, shown.factor)
    late = means if location.since is None else sample.means(slice(location.since - 1, None))
    return Scale(
        dof=dof,
        anees=curve,
        alive=alive,
        band=band,
        mean_anees=tests.main.ratio * dof,
        accepted=acceptance(tests.main, dof, rate, settings.allow),
        effective_dof=tests.main.effective_dof,
        inflation=ratio_interval(late, dof, CONFIDENCE),
        detectable=detectable_ratio(dof, len(means), rate, two_sided=not settings.one_sided) if some else np.nan,
        median_run=float(np.median(means)) * dof if some else np.nan,
        worst_run=float(means.max()) * dof if some else np.nan,
        share_inside=float(inside[judged].mean()) if some else np.nan,
        equivalence=shown,
        within=of_log,
    )
