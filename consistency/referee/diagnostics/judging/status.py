"""The headline of a verdict: one word for the result of its questions."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from consistency.referee.diagnostics.questions.scale import scale_test, spreads_more, spreads_more_in_steps
from consistency.referee.diagnostics.questions.sample import Sample
from consistency.referee.diagnostics.statistics.nees import anees
from consistency.referee.diagnostics.verdict.answers import (
    AXIS,
    BIAS,
    DIRECTION,
    INNOVATIONS,
    JOINT,
    MAIN,
    SCALE,
    SHARES,
    STEP,
    Tests,
    answers,
    ask,
)
from consistency.referee.diagnostics.verdict.parts import TINY, Interval, Settings, Verdict
from consistency.referee.types import Array

if TYPE_CHECKING:
    from consistency.referee.diagnostics.maps.map_nees import JointTest

CERTAIN = 0.999  # false-alarm rate, at most
SURE = 1.5  # standard errors by which the runs of a single step have to differ more than Gaussian ones


def status_of(verdict: Verdict, sample: Sample | None, tests: Tests | None, joint: JointTest | None) -> str:
    if verdict.scale is not None and verdict.scale.judged_steps == 0:
        return "failed"
    if verdict.scale is None and not (verdict.innovations is not None and verdict.innovations.dof):
        return "failed"
    faults = set(verdict.faults)
    if not faults:
        if verdict.failures or verdict.impossible or (joint is not None and joint.score.not_definite):
            return "failed"
        shown = verdict.equivalence
        return "consistent" if shown is not None and shown.shown and few_lost(verdict) else "undecided"
    if sample is None or tests is None:
        return _by_innovations(verdict) if "innovation scale" in faults else "inconsistent"
    if not faults & set(BIAS):
        status = _with_joint(at_share(verdict), faults, sample, tests, joint)
    else:
        sample, tests, rest = _without_bias(verdict, sample)
        status = _by_errors(at_share(verdict), rest, sample, tests) if rest else "biased"
        status = "biased" if status == "heavy-tailed" else status  # a few errors explain less than the mean of all
    by_sign = status == "overconfident" and verdict.shape is not None and verdict.shape.alone and JOINT not in faults
    return "inconsistent" if by_sign or (status == "heavy-tailed" and smaller(verdict)) else status


def _by_innovations(v: Verdict) -> str:
    """Which headline where the size of innovations alone is at fault: of the rest where outliers are among them."""
    i, rate = v.innovations, v.settings.false_alarm
    assert i is not None
    if i.outliers is None or i.outliers.rest.above <= rate:
        return "overconfident" if i.ratio > 1.0 else "conservative"
    return "inconsistent" if i.outliers.rest.below <= rate and not v.settings.one_sided else "heavy-tailed"


def smaller(v: Verdict) -> bool:
    """Are the errors found to be smaller than stated in the mean? Then few large ones are not all that is wrong."""
    return v.scale is not None and MAIN in v.faults and v.scale.inflation.high < 1.0


def deciding_axis(v: Verdict) -> tuple[str, Interval] | None:
    """The component that decides the status, with its ratio; None where the whole does.

    It is the worst one where an axis is found at fault and the whole is not, or errs in the other direction, or looks
    right: its ratio lies in [1 / detect, detect], and the interval of the axis outside.
    """
    axis, R = clear(v.worst_axis), v.settings.factor
    if axis is None or v.scale is None or AXIS not in v.faults:
        return None
    hidden = 1.0 / R <= v.scale.inflation.value <= R and (axis[1].low > R or axis[1].high < 1.0 / R)
    return axis if hidden or MAIN not in v.faults or v.status == "inconsistent" else None


def clear(axis: tuple[str, Interval] | None) -> tuple[str, Interval] | None:
    """An axis whose interval does not hold 1, or None."""
    return None if axis is None or axis[1].holds(1.0) else axis


def few_lost(verdict: Verdict) -> bool:
    """Is the share of lost runs shown to be what was asked for, if it was?"""
    asked = verdict.settings.lost
    return asked is None or (verdict.lost is not None and verdict.lost.upper <= asked)


def at_share(verdict: Verdict) -> Settings:
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
        side = "overconfident" if tests.main.ratio > 1.0 else "conservative"
        return "inconsistent" if AXIS in faults and _contradicted(settings, sample, tests) else side
    heavy = "outliers" in faults or (STEP in faults and _heavy_steps(sample, tests))
    if STEP in faults and not heavy:
        if AXIS in faults and _by_axis(settings, tests) == "inconsistent":
            return "inconsistent"
        curve = anees(sample.nees)
        with np.errstate(divide="ignore", invalid="ignore"):
            above, below = np.nanmax(curve / tests.band.high), np.nanmax(tests.band.low / curve)
        return "overconfident" if above >= below else "conservative"  # where the ANEES is farthest from its band
    if AXIS in faults or DIRECTION in faults:
        if sample.errors is not None and (DIRECTION in faults or _robust_axis(sample, tests, settings)):
            return _by_axis(settings, tests)
        heavy = True
    return "heavy-tailed" if heavy else "inconsistent"


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
    groups = sample.known_errors.groups
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


def _contradicted(settings: Settings, sample: Sample, tests: Tests) -> bool:
    """Does an axis err in the other direction than the whole?

    Any does where the whole is too large, because nothing is too small in a conservative covariance. Where it is too
    small, one that is farther from 1 than the whole, or all together, so that correlations make the whole too small.
    """
    if settings.one_sided or sample.errors is None:
        return False
    whole = float(np.log(max(tests.main.ratio, TINY)))
    ratios = {axis: tests.axes[axis].ratio for axis in sample.errors.names}
    wrong = [ratios[axis] for axis in ratios if tests.axes[axis].p_value * len(tests.axes) <= settings.false_alarm]
    farther = -np.log(max(min(ratios.values()), TINY)) > whole
    if whole > 0.0 and wrong and max(wrong) < 1.0:
        return bool(farther or len(wrong) == len(ratios))
    if _by_axis(settings, tests) != "inconsistent":
        return False
    return bool(whole < 0.0 or farther)
