"""The status of a verdict: one word for the answers to all questions."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING

import numpy as np

from consistency.referee.diagnostics.error_parts import Tests, run_tests, sided_p_value
from consistency.referee.diagnostics.nees import anees
from consistency.referee.diagnostics.sample import Sample
from consistency.referee.diagnostics.scale import MeanTest, RunMeans, scale_test, spreads_more, spreads_more_in_steps
from consistency.referee.diagnostics.verdict import Findings
from consistency.referee.diagnostics.verdict_parts import (
    AXIS,
    BIAS,
    DIRECTION,
    GROUP,
    INNOVATIONS,
    JOINT,
    MAIN,
    SCALE,
    SHARES,
    STEP,
    TINY,
    Answer,
    ErrorParts,
    Innovations,
    Interval,
    Lost,
    Scale,
    Settings,
    answers,
    at_share,
    faults_of,
)

if TYPE_CHECKING:
    from consistency.referee.diagnostics.maps import JointTest

SURE = 1.5  # standard errors by which the runs of a single step have to differ more than Gaussian ones


def nothing_judged(scale: Scale | None, innovations: Innovations | None) -> bool:
    """Whether there is neither a step nor an innovation to judge."""
    if scale is not None:
        return scale.judged_steps == 0
    return innovations is None or not innovations.dof


def status_without_fault(
    broken: bool, scale: Scale | None, innovations: Innovations | None, lost: Lost | None, settings: Settings
) -> str:
    """The status where no question found a fault; ``broken`` if a run failed or says what no filter may say."""
    if broken:
        return "failed"
    shown = None
    if scale is not None:
        shown = scale.equivalence
    elif innovations is not None:
        shown = innovations.equivalence
    if shown is not None and shown.shown and few_lost(lost, settings):
        return "consistent"
    return "undecided"


def withheld(unshown: str, status: str, scale: Scale | None) -> tuple[str, str, Scale | None]:
    """Reason, status and scale where nothing can be shown for that reason: undecided, unless a run failed."""
    if not unshown or scale is None or status == "failed":
        return "", status, scale
    return unshown, "undecided", scale.not_shown


def few_lost(lost: Lost | None, settings: Settings) -> bool:
    """Whether the share of lost runs is shown to be what was asked for, if it was."""
    if settings.lost is None:
        return True
    return lost is not None and lost.upper <= settings.lost


def status_by_innovations(faults: Collection[str], innovations: Innovations | None, settings: Settings) -> str:
    """The status where innovations alone are at fault: by the rest of them where outliers are among them."""
    if "innovation scale" not in faults or innovations is None:
        return "inconsistent"
    far = innovations.outliers
    rate = settings.false_alarm
    if far is None or far.rest.above <= rate:
        return _side(innovations.ratio)
    if far.rest.below <= rate and not settings.one_sided:
        return "inconsistent"
    return "heavy-tailed"


def status_by_errors(
    given: Sequence[Answer],
    settings: Settings,
    sample: Sample,
    tests: Tests,
    joint: JointTest | None,
    parts: ErrorParts,
) -> str:
    """The status where a question about errors found a fault. It may overwrite the arrays of the ``sample``."""
    faults = set(faults_of(given))
    if faults & set(BIAS):
        sample, tests, rest = _without_bias(given, settings, sample)
        status = "biased"
        if rest & faults:
            status = _status_of_sample(at_share(given, settings), rest & faults, sample, tests)
        if status == "heavy-tailed":
            status = "biased"  # a few errors explain less than the mean of all
    else:
        status = _with_joint(at_share(given, settings), faults, sample, tests, joint)
    if status == "overconfident" and parts.shape is not None and parts.shape.alone and JOINT not in faults:
        return "inconsistent"  # by the sign of a correlation
    if status == "heavy-tailed" and smaller(faults, parts.scale):
        return "inconsistent"
    return status


def smaller(faults: Collection[str], scale: Scale | None) -> bool:
    """Are the errors found to be smaller than stated in the mean? Then few large ones are not all that is wrong."""
    return scale is not None and MAIN in faults and scale.inflation.high < 1.0


def deciding_axis(found: Findings) -> tuple[str, Interval] | None:
    """The component that decides the status, with its ratio; None where the whole does.

    It is the worst one where an axis is found at fault and the whole is not, or errs in the other direction, or looks
    right: its ratio lies in [1 / detect, detect], and the interval of the axis outside.
    """
    axis = axis_at_fault(found.worst_axis)
    factor = found.settings.factor
    faults = found.faults
    if found.parts:
        of_parts = {question for part in found.parts.values() for question in part.faults}
        if not of_parts & set(SCALE):
            return None
        return axis
    if axis is None or found.scale is None or AXIS not in faults:
        return None
    if MAIN not in faults or found.status == "inconsistent":
        return axis
    whole_looks_right = 1.0 / factor <= found.scale.inflation.value <= factor
    if whole_looks_right and (axis[1].low > factor or axis[1].high < 1.0 / factor):
        return axis
    return None


def axis_at_fault(axis: tuple[str, Interval] | None) -> tuple[str, Interval] | None:
    """An axis whose interval does not hold 1, or None."""
    if axis is None or axis[1].holds(1.0):
        return None
    return axis


def _side(ratio: float) -> str:
    if ratio > 1.0:
        return "overconfident"
    return "conservative"


def _with_joint(settings: Settings, faults: set[str], sample: Sample, tests: Tests, joint: JointTest | None) -> str:
    """The status of the landmarks, of pose and map together, or neither where they contradict each other."""
    if joint is None or JOINT not in faults:
        return _status_of_sample(settings, faults, sample, tests)
    together = _side(joint.score.both.value)
    if not _robust(RunMeans(joint.means, np.ones(len(joint.means), int), joint.dof), settings, 1):
        together = "heavy-tailed"
    if not faults & set(SCALE):
        return together
    apart = _status_of_sample(settings, faults, sample, tests)
    if {apart, together} == {"overconfident", "conservative"}:
        return "inconsistent"
    return apart


def _without_bias(given: Sequence[Answer], settings: Settings, sample: Sample) -> tuple[Sample, Tests, set[str]]:
    """Errors less their mean over runs, their tests, and the faults that remain."""
    others = {answer.question: answer.p_value for answer in given if answer.question in INNOVATIONS}
    centred = sample.centred()  # nobody asks the sample again
    tests = run_tests(centred, settings, others)
    p_values = {q: p for q, p in (dict(tests.p_values) | dict(tests.named)).items() if q not in BIAS}
    found = answers(p_values | others, settings.false_alarm)
    return centred, tests, {question for question, answer in found.items() if answer.found}


def _status_of_sample(settings: Settings, faults: set[str], sample: Sample, tests: Tests) -> str:
    """The status by the errors of a sample: of the scale only where it does not depend on a few large errors."""
    of_groups = _sides(settings, tests.groups) if GROUP in faults else set()
    if MAIN in faults:
        if not _robust(sample.run_means(), settings, 1):
            return "heavy-tailed"
        if AXIS in faults and _contradicted(settings, sample, tests):
            return "inconsistent"
        return _status_of_sides({_side(tests.main.ratio), *of_groups})
    heavy = "outliers" in faults or (STEP in faults and _heavy_steps(sample, tests))
    if STEP in faults and not heavy:
        return _status_of_sides({_status_of_steps(settings, faults, sample, tests), *of_groups})
    if AXIS in faults or DIRECTION in faults:
        if sample.whitened is not None and (DIRECTION in faults or _robust_axis(sample, tests, settings)):
            return _status_of_sides({_status_of_axes(settings, tests), *of_groups})
        heavy = True
    if GROUP in faults and not heavy:
        if _robust_group(sample, tests, settings):
            return _status_of_sides(of_groups)
        heavy = True
    if heavy:
        return "heavy-tailed"
    return "inconsistent"


def _status_of_steps(settings: Settings, faults: set[str], sample: Sample, tests: Tests) -> str:
    """The side on which the ANEES is farthest from its band, unless axes err in both directions."""
    if AXIS in faults and _status_of_axes(settings, tests) == "inconsistent":
        return "inconsistent"
    curve = anees(sample.nees)
    with np.errstate(divide="ignore", invalid="ignore"):
        above = np.nanmax(curve / tests.band.high)
        below = np.nanmax(tests.band.low / curve)
    if above >= below:
        return "overconfident"
    return "conservative"


def _heavy_steps(sample: Sample, tests: Tests) -> bool:
    """Do the runs differ more than Gaussian errors can, in most steps, or in all of those outside the band?

    Where steps are above the band these alone count: errors that are too small have no heavy tails.
    """
    if spreads_more_in_steps(sample.nees, sample.dof):
        return True
    outside = np.flatnonzero(tests.band.above).tolist()
    if not outside:
        outside = np.flatnonzero(tests.band.below).tolist()
    for step in outside:
        if not spreads_more(sample.nees[sample.counted[:, step], step] / sample.dof, _rank(sample, step), SURE):
            return False
    return bool(outside)


def _rank(sample: Sample, step: int) -> float:
    """Degrees of freedom with which the NEES of a step spreads if errors are Gaussian, of whatever covariance.

    (tr S)^2 / tr S^2 with S that of the whitened errors, as if all axes were off by one factor where it is n. Of the
    second moment M of N runs, tr M^2 exceeds tr S^2 by (tr M)^2 / N.
    """
    if sample.whitened is None:
        return sample.dof
    w = sample.whitened[sample.counted[:, step], step]
    M = w.T @ w / len(w)
    square = float(np.trace(M)) ** 2
    return float(np.clip(square / max(float(np.square(M).sum()) - square / len(w), TINY), 1.0, sample.dof))


def _robust(runs: RunMeans, settings: Settings, questions: int, weighted: bool = False) -> bool:
    """Is the scale found at fault too where the runs differ more than Gaussian errors can?"""
    gaussian = not spreads_more(runs.values, runs.dof)
    test = scale_test(runs.values, runs.dof, runs.steps, gaussian, runs.counts if weighted else None)
    return sided_p_value(test, settings) * questions <= SHARES[MAIN] * settings.false_alarm


def _robust_axis(sample: Sample, tests: Tests, settings: Settings) -> bool:
    groups = sample.components
    for key, test in tests.axes.items():
        found = sided_p_value(test, settings) * len(groups) <= settings.false_alarm
        if found and _robust(sample.run_means(groups[key]), settings, len(groups)):
            return True
    return False


def _robust_group(sample: Sample, tests: Tests, settings: Settings) -> bool:
    """Is some group found at fault too where the runs differ more than Gaussian errors can?"""
    for number, test in enumerate(tests.groups):
        found = sided_p_value(test, settings) * len(tests.groups) <= settings.false_alarm
        if found and _robust(sample.in_group(number), settings, len(tests.groups), weighted=True):
            return True
    return False


def _status_of_axes(settings: Settings, tests: Tests) -> str:
    """Axes that err in one direction name the status, those that err in both do not."""
    if settings.one_sided:
        return "overconfident"
    return _status_of_sides(_sides(settings, list(tests.axes.values())))


def _sides(settings: Settings, tests: Sequence[MeanTest]) -> set[str]:
    """The sides on which any of the ``tests`` err."""
    wrong = [test for test in tests if sided_p_value(test, settings) * len(tests) <= settings.false_alarm]
    return {_side(test.ratio) for test in wrong}


def _status_of_sides(sides: set[str]) -> str:
    """The side on which all err that do, and otherwise that they err on both."""
    if len(sides) != 1:
        return "inconsistent"
    return next(iter(sides))


def _contradicted(settings: Settings, sample: Sample, tests: Tests) -> bool:
    """Does an axis err in the other direction than the whole?

    Any does where the whole is too large, because nothing is too small in a conservative covariance. Where it is too
    small, one that is farther from 1 than the whole, or all together, so that correlations make the whole too small.
    """
    if settings.one_sided or sample.whitened is None:
        return False
    whole = float(np.log(max(tests.main.ratio, TINY)))
    ratios = []
    wrong = []
    for axis in sample.names:
        test = tests.axes[axis]
        ratios.append(test.ratio)
        if test.p_value * len(tests.axes) <= settings.false_alarm:
            wrong.append(test.ratio)
    farther = bool(-np.log(max(min(ratios), TINY)) > whole)
    if whole > 0.0 and wrong and max(wrong) < 1.0:
        return farther or len(wrong) == len(ratios)
    if _status_of_axes(settings, tests) != "inconsistent":
        return False
    return whole < 0.0 or farther
