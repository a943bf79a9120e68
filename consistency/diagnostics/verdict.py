"""The verdict on one filter, from its errors over independent runs."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from consistency.diagnostics import wording
from consistency.diagnostics.asking import Tests, ask
from consistency.diagnostics.band import simultaneous_band
from consistency.diagnostics.equivalence import equivalence, equivalence_by_betting, equivalence_of_innovations
from consistency.diagnostics.innovations import NisTest, nis_test, nis_whiteness, whiteness
from consistency.diagnostics.intervals import chi2_mean_interval
from consistency.diagnostics.joint import JointTest, joint_test, near
from consistency.diagnostics.location import accuracy_of, axes_of, bias_of, location_of, shape_of, tails_of
from consistency.diagnostics.nees import anees
from consistency.diagnostics.questions import (
    AXIS,
    BIAS,
    DIRECTION,
    INNOVATIONS,
    JOINT,
    MAIN,
    SCALE,
    SHARES,
    STEP,
    answers,
)
from consistency.diagnostics.records import Answer, Equivalence, Evidence, Innovations, Settings, Verdict
from consistency.diagnostics.sample import Sample, impossible, innovations_of, sample_of
from consistency.diagnostics.sample import shape_of as shape_of_arrays
from consistency.diagnostics.scale import scale_test, spreads_more, spreads_more_in_steps
from consistency.diagnostics.scaling import INTERVAL, scale_of
from consistency.diagnostics.whitening import entries
from consistency.types import Array

DEFAULT = Settings()
CERTAIN = 0.999  # false-alarm rate, at most
SURE = 1.5  # standard errors by which the runs of a single step have to differ more than Gaussian ones


@dataclass(frozen=True)
class Look:
    """One of several looks at growing evidence; see :mod:`consistency.diagnostics.sequential`."""

    spent: float | None  # part of the false-alarm rate of every question but the scale that this look may cost;
    # None where nothing but the scale is asked
    scale: float  # p value of the scale, valid at any time


def judge(evidence: Evidence, settings: Settings = DEFAULT, look: Look | None = None) -> Verdict:
    """Say what a filter is, with reasons; see ``records.STATUSES``.

    Runs are independent, steps are not: every test takes a run as one observation, or holds under any
    dependence between steps. A filter whose errors are Gaussian with the stated covariance is found at fault in
    any of the questions (``consistency.diagnostics.questions``) with probability ``false_alarm`` at most;
    half of that belongs to the mean NEES, for which :func:`gate_runs` plans. *Consistent* is shown: no question found a
    fault, and two one-sided tests put the ratio of true to stated covariance inside [1 / detect, detect]. With
    neither a fault nor that the filter is undecided. A filter with failed runs is never consistent.

    Innovations are judged where an optimal gain is declared, otherwise they are reported: only those of an optimal gain
    are white. Without truth they are judged alone.

    Where a fit to the truth took of the errors (``Evidence.reduced``) what is not known, a covariance that is too large
    is no fault, as with ``allow="conservative"``; but consistent is shown on both sides, with the share of the NEES
    added that it may have taken at most (``Evidence.unseen``). Questions that it leaves no answer to
    (``Evidence.spoilt``) are not asked.

    A map is judged likewise, with its landmarks in the place of steps (``Evidence.landmarks``) and with the NEES of
    pose and map together, where it is given.

    Raises
    ------
    ValueError
        Nothing to judge is given, or shapes or options do not fit.
    """
    runs, steps = shape_of_arrays(evidence)
    both_sides = settings
    settings = replace(settings, allow="conservative") if evidence.reduced else settings
    innovations, p_values = _innovations(evidence, settings)
    sample = sample_of(evidence, settings)
    joint = None
    if evidence.joint is not None:
        joint = joint_test(evidence.joint, settings, evidence.run_numbers, evidence.landmarks)
    p_values |= {} if joint is None else joint.p_values
    tests = None
    if sample is not None:
        tests = ask(sample, settings, p_values, look.scale if look else None)
        p_values |= {q: p for q, p in tests.p_values.items() if q not in evidence.spoilt}
    if look is not None:
        p_values = _at(look, p_values)
    by_question = answers(p_values, settings.false_alarm)
    excused = {"innovation scale"} if innovations is not None and _near(innovations, settings) else set()
    excused |= {JOINT} if joint is not None and near(joint, settings) else set()
    verdict = Verdict(
        evidence.name, "failed", (), runs, steps, settings, _excused(by_question.values(), excused), evidence.failures,
        innovations=innovations, landmarks=evidence.landmarks, joint=None if joint is None else joint.score,
        unit=evidence.unit,
    )  # fmt: skip
    if sample is not None and tests is not None:
        verdict = _with_records(verdict, evidence, sample, tests, _equivalence(sample, both_sides, look, evidence))
    verdict = replace(verdict, status=_status(verdict, sample, tests, joint))
    return replace(verdict, reasons=tuple(wording.reasons(verdict)))


def _at(look: Look, p_values: dict[str, float]) -> dict[str, float]:
    """p values corrected for the number of looks; the share of the scale stays what it is if it is asked alone."""
    if look.spent is None:
        return {q: p if q == MAIN else 1.0 for q, p in p_values.items() if np.isfinite(p)}
    return {q: p if q == MAIN or not np.isfinite(p) else min(1.0, p / look.spent) for q, p in p_values.items()}


# --- innovations -------------------------------------------------------------------------------------


def _innovations(evidence: Evidence, settings: Settings) -> tuple[Innovations | None, dict[str, float]]:
    nis_and_dof = innovations_of(evidence)
    if nis_and_dof is None:
        return None, {}
    test = nis_test(*nis_and_dof)
    low_high = chi2_mean_interval(test.dof, INTERVAL) if test.dof else (float("nan"), float("nan"))
    if evidence.innovations is not None and evidence.innovation_covariances is not None:
        white = whiteness(evidence.innovations, evidence.innovation_covariances)
    else:
        white = nis_whiteness(*nis_and_dof)
    judged = evidence.optimal_gain
    shown = equivalence_of_innovations(test, settings, max(settings.factor, settings.tolerated)) if judged else None
    record = Innovations(test.ratio, low_high, test.dof, judged, white.correlation, white.bound, shown)
    if not judged:
        return record, {}
    if settings.one_sided:
        return record, {"innovation scale": test.above}
    return record, {"innovation scale": test.p_value, "innovation whiteness": white.p_value}


# --- what is known beside the p values -----------------------------------------------------------------


def _with_records(verdict: Verdict, evidence: Evidence, sample: Sample, tests: Tests, shown: Equivalence) -> Verdict:
    settings = verdict.settings
    if settings.tolerance is not None:
        verdict = replace(verdict, answers=_excused(verdict.answers, _tolerated(sample, tests, settings)))
    by_question = {a.question: a for a in verdict.answers if not a.tolerated}
    band = tests.band
    step = by_question.get(STEP)
    if step is not None and step.found and not band.outside.any():  # found by what Holm's correction left over
        rate = np.nextafter(tests.band.p_value, 1.0) * (1 + 1e-6)
        band = simultaneous_band(sample.nees, sample.dof, rate, settings.method, settings.allow)
    location = location_of(sample, band, by_question, ordered=evidence.landmarks is None)
    scale = scale_of(sample, tests, _at_share(verdict), location, shown)
    if sample.errors is None or evidence.error is None or evidence.covariance is None:
        return replace(verdict, scale=scale, location=location, tails=tails_of(tests, None))
    odd = impossible(evidence, sample.counted)
    there = entries(evidence.covariance).where_all(np.isfinite)
    return replace(
        verdict,
        scale=scale,
        location=location,
        impossible=tuple((int(run), int(k) + 1) for run, k in np.argwhere(odd)),
        left_out_steps=tuple(int(k) + 1 for k in np.flatnonzero((there & ~sample.counted).any(axis=0))),
        axes=axes_of(sample, tests, location),
        bias=bias_of(sample, tests, location, by_question),
        shape=shape_of(sample, tests, by_question),
        tails=tails_of(tests, evidence.run_numbers),
        accuracy=accuracy_of(sample),
    )


def _equivalence(sample: Sample, settings: Settings, look: Look | None, evidence: Evidence) -> Equivalence:
    if look is not None:
        return equivalence_by_betting(sample.means(), sample.dof, settings)
    factor = max(settings.factor, settings.tolerated)
    return equivalence(
        sample.means(), sample.dof, sample.longest, settings, factor, not evidence.reduced, evidence.unseen
    )


def _excused(all_answers: Iterable[Answer], questions: set[str]) -> tuple[Answer, ...]:
    """Answers with the faults in these questions marked as tolerated."""
    return tuple(replace(a, tolerated=True) if a.found and a.question in questions else a for a in all_answers)


def _near(innovations: Innovations, settings: Settings) -> bool:
    """Is the scale of the innovations shown to lie within the tolerance?"""
    if settings.tolerance is None or not innovations.judged:
        return False
    test = NisTest(innovations.ratio, innovations.dof, float("nan"), float("nan"))
    return equivalence_of_innovations(test, settings, settings.tolerated).shown


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


# --- status ------------------------------------------------------------------------------------------


def _status(verdict: Verdict, sample: Sample | None, tests: Tests | None, joint: JointTest | None) -> str:
    if verdict.scale is not None and verdict.scale.judged_steps == 0:
        return "failed"
    if verdict.scale is None and not (verdict.innovations is not None and verdict.innovations.dof):
        return "failed"
    faults = set(verdict.faults)
    if not faults:
        if verdict.failures or verdict.impossible or (joint is not None and joint.score.not_definite):
            return "failed"
        shown = verdict.equivalence
        return "consistent" if shown is not None and shown.shown else "undecided"
    if sample is None or tests is None:
        return _by_innovations(verdict, faults)
    if not faults & set(BIAS):
        return _with_joint(_at_share(verdict), faults, sample, tests, joint)
    sample, tests, rest = _without_bias(verdict, sample)
    status = _by_errors(_at_share(verdict), rest, sample, tests) if rest else "biased"
    return "biased" if status == "heavy-tailed" else status  # a few errors explain less than the mean of all


def _at_share(verdict: Verdict) -> Settings:
    """Settings at whose usual share the scale is asked as it was: at the whole rate where nothing else is asked."""
    share = next((a.share for a in verdict.answers if a.question == MAIN), SHARES[MAIN])
    return replace(verdict.settings, false_alarm=min(verdict.settings.false_alarm * share / SHARES[MAIN], CERTAIN))


def _with_joint(settings: Settings, faults: set[str], sample: Sample, tests: Tests, joint: JointTest | None) -> str:
    """Which headline: that of the landmarks, of pose and map together, or neither where they contradict each other."""
    if joint is None or JOINT not in faults:
        return _by_errors(settings, faults, sample, tests)
    together = "overconfident" if joint.score.both.value > 1.0 else "conservative"
    if not _robust(joint.means, joint.dof, 1, settings, 1):
        together = "heavy-tailed"
    if not faults & set(SCALE):
        return together
    apart = _by_errors(settings, faults, sample, tests)
    return "inconsistent" if {apart, together} == {"overconfident", "conservative"} else apart


def _by_innovations(verdict: Verdict, faults: set[str]) -> str:
    assert verdict.innovations is not None
    if "innovation scale" not in faults:
        return "inconsistent"
    return "overconfident" if verdict.innovations.ratio > 1.0 else "conservative"


def _without_bias(verdict: Verdict, sample: Sample) -> tuple[Sample, Tests, set[str]]:
    """Errors less their mean over runs, what they are asked, and the faults that remain."""
    others = {a.question: a.p_value for a in verdict.answers if a.question in INNOVATIONS}
    centred = sample.centred()  # nobody asks the sample again
    again = ask(centred, verdict.settings, others)
    p_values = {q: p for q, p in again.p_values.items() if q not in BIAS} | others
    faults = {q for q, a in answers(p_values, verdict.settings.false_alarm).items() if a.found}
    return centred, again, faults & set(verdict.faults)


def _by_errors(settings: Settings, faults: set[str], sample: Sample, tests: Tests) -> str:
    """Which headline: of the scale only where it is no matter of a few large errors."""
    if MAIN in faults:
        if not _robust(sample.means(), sample.dof, sample.longest, settings, 1):
            return "heavy-tailed"
        return "overconfident" if tests.main.ratio > 1.0 else "conservative"
    heavy = "outliers" in faults or (STEP in faults and _heavy_steps(sample, tests))
    if STEP in faults and not heavy:
        opposite = AXIS in faults and _by_axis(settings, tests) == "inconsistent"
        return "inconsistent" if opposite else _by_step(sample, tests)
    if AXIS in faults or DIRECTION in faults:
        if sample.errors is not None and (DIRECTION in faults or _robust_axis(sample, tests, settings)):
            return _by_axis(settings, tests)
        heavy = True
    return "heavy-tailed" if heavy else "inconsistent"


def _by_step(sample: Sample, tests: Tests) -> str:
    """The side on which the ANEES is farthest from its band."""
    curve, band = anees(sample.nees), tests.band
    with np.errstate(divide="ignore", invalid="ignore"):
        above, below = np.nanmax(curve / band.high), np.nanmax(band.low / curve)
    return "overconfident" if above >= below else "conservative"


def _heavy_steps(sample: Sample, tests: Tests) -> bool:
    """Do the runs differ more than Gaussian errors can, in most steps, or in all of those outside the band?"""
    if spreads_more_in_steps(sample.nees, sample.dof):
        return True
    outside = np.flatnonzero(tests.band.outside)
    values = (sample.nees[sample.counted[:, k], k] / sample.dof for k in outside)
    return bool(len(outside)) and all(spreads_more(value, sample.dof, SURE) for value in values)


def _robust(means: Array, dof: int, steps: int, settings: Settings, questions: int) -> bool:
    """Is the scale found at fault too where the runs differ more than Gaussian errors can?"""
    test = scale_test(means, dof, steps, gaussian=not spreads_more(means, dof))
    p = test.above if settings.one_sided else test.p_value
    return bool(p * questions <= SHARES[MAIN] * settings.false_alarm)


def _robust_axis(sample: Sample, tests: Tests, settings: Settings) -> bool:
    assert sample.errors is not None
    groups = sample.errors.groups
    return any(
        _robust(sample.group_means(groups[key]), len(groups[key]), sample.longest, settings, len(groups))
        for key, test in tests.axes.items()
        if (test.above if settings.one_sided else test.p_value) * len(groups) <= settings.false_alarm
    )


def _by_axis(settings: Settings, tests: Tests) -> str:
    """Axes that err in one direction name the verdict, those that err in both do not."""
    if settings.one_sided:
        return "overconfident"
    wrong = [t for t in tests.axes.values() if t.p_value * len(tests.axes) <= settings.false_alarm]
    sides = {test.ratio > 1.0 for test in wrong}
    if len(sides) != 1:
        return "inconsistent"
    return "overconfident" if sides.pop() else "conservative"
