"""Every test of a record's errors and innovations, and the status that follows.

Components whose cross terms are not stated are tested one by one. The tests themselves are in ``error_parts``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from consistency.referee.defaults import CONFIDENCE
from consistency.referee.diagnostics.bias_and_shape import t_squared
from consistency.referee.diagnostics.error_parts import accuracy_of, bias_of, error_parts, excused, run_tests
from consistency.referee.diagnostics.nees import FEW, chi2_mean_interval
from consistency.referee.diagnostics.number_of_runs import FEWEST_PLANNED
from consistency.referee.diagnostics.record import Errors, InnovationRecord, RatioTable, Record
from consistency.referee.diagnostics.sample import (
    Sample,
    impossible_values,
    names_of,
    runs_and_steps,
    sample_of,
)
from consistency.referee.diagnostics.scale import (
    equivalence,
    equivalence_by_betting,
    equivalence_of_total,
    is_tolerated,
    ratio_interval,
    run_means,
    worst,
)
from consistency.referee.diagnostics.status import (
    few_lost,
    nothing_judged,
    status_by_errors,
    status_by_innovations,
    status_without_fault,
    withheld,
)
from consistency.referee.diagnostics.tails import early_ends, lost_of
from consistency.referee.diagnostics.verdict import UNKNOWN_ENDS, Findings
from consistency.referee.diagnostics.verdict_parts import (
    JOINT,
    MAIN,
    SHARES,
    Answer,
    EarlyEnds,
    Equivalence,
    ErrorParts,
    Innovations,
    Interval,
    Lost,
    Scale,
    Settings,
    answers,
    faults_of,
    least_of_steps,
    named_p_values,
    with_tolerated,
)
from consistency.referee.diagnostics.whitening import every_entry, squared_length, whiten
from consistency.referee.types import Array

if TYPE_CHECKING:
    from consistency.referee.diagnostics.maps import JointTest
    from consistency.referee.diagnostics.uncertain_truth import UncertainTruth

INNOVATIONS = "innovations"


@dataclass(frozen=True)
class InterimLook:
    """One of several looks at growing evidence; see :mod:`consistency.referee.diagnostics.planning`."""

    spent: float | None  # part of the false-alarm rate of every question but the scale that this look may cost;
    # None where nothing but the scale is asked
    scale: float  # p value of the scale, valid at any time
    named: float = 1.0  # that with which a fault of the scale is named, once one is found

    def corrected(self, p_values: Mapping[str, float]) -> dict[str, float]:
        """p values corrected for the number of looks; the share of the scale is the same if it is asked alone."""
        corrected = {}
        for question, p in p_values.items():
            if question == MAIN or not np.isfinite(p):
                corrected[question] = p
            elif self.spent is None:
                corrected[question] = 1.0
            else:
                corrected[question] = min(1.0, p / self.spent)
        return corrected


def findings_of(
    record: Record,
    settings: Settings,
    inspection: InterimLook | None = None,
    truth: UncertainTruth | None = None,
    unshown: str = "",
) -> Findings:
    """Test the errors and innovations of a record, and nothing beside them.

    Parameters
    ----------
    truth : where it is uncertain; the record is then :attr:`UncertainTruth.evidence`
    unshown : why nothing can be shown, so that no question of the errors is asked and nothing is decided
    """
    runs, steps = runs_and_steps(record)
    table = record.table()
    asked_for = settings
    if table is not None:
        settings = _of_numbers(settings, table)
    both_sides = settings
    if record.fit.reduced:
        settings = replace(settings, allow="conservative")
    innovations, p_values = _innovations(record, settings)
    joint = _joint(record, settings)
    if joint is not None:
        p_values |= joint.p_values
    sample = sample_of(record, settings)
    tests = None
    named: dict[str, float] = {}
    if sample is not None:
        scale_p_value = None
        if inspection is not None:
            scale_p_value = inspection.scale
        tests = run_tests(sample, settings, p_values, scale_p_value)
        asked = tests.p_values
        if truth is not None:
            asked = truth.p_values(asked, settings)
        if not unshown:
            p_values |= {question: p for question, p in asked.items() if question not in record.fit.unavailable}
        if truth is None or not truth.bounded:
            named = dict(tests.named)
    if inspection is not None:
        p_values = inspection.corrected(p_values)
        if named:
            named = inspection.corrected(named | {MAIN: inspection.named})
    p_values = named_p_values(p_values, named)
    given_answers = tuple(answers(p_values, settings.false_alarm).values())
    given_answers = with_tolerated(given_answers, _tolerated(joint, innovations, settings))

    parts = ErrorParts()
    lost = None
    ends = None
    impossible: list[tuple[int, int]] = []
    left_out_steps: list[int] = []
    if sample is not None and tests is not None:
        given_answers = excused(given_answers, sample, tests, settings)
        scale_equivalence = _equivalence(sample, both_sides, inspection, record, truth)
        parts = error_parts(record, sample, tests, given_answers, settings, scale_equivalence)
        lost = lost_of(record, sample.nees, sample.dof, settings, any_time=inspection is not None)
        if record.map.landmarks is None:
            ends = _early_ends(sample)
        if sample.whitened is not None:
            impossible = _impossible(record, sample)
            left_out_steps = _left_out_steps(record, sample)
    broken = bool(record.failures or impossible or (joint is not None and joint.score.not_definite))

    faults = set(faults_of(given_answers))
    if nothing_judged(parts.scale, innovations):
        status = "failed"
    elif not faults:
        status = status_without_fault(broken, parts.scale, innovations, lost, settings)
    elif sample is None or tests is None:
        status = status_by_innovations(faults, innovations, settings)
    else:
        status = status_by_errors(given_answers, settings, sample, tests, joint, parts)
    share = None
    if truth is not None:
        share = truth.truth_share()
        status = truth.status(status, given_answers, settings)
        parts = _parts_of_estimate(truth, parts, given_answers, settings)
    if table is not None:
        parts = _of_covariance(parts, record, sample, asked_for)
    unshown, status, scale = withheld(unshown, status, parts.scale)
    is_early = inspection is not None and (inspection.spent is None or runs < FEWEST_PLANNED)
    later = status == "consistent" and is_early
    if later:
        status = "undecided"
    return Findings(
        filter=record.name,
        status=status,
        runs=runs,
        steps=steps,
        settings=replace(settings, detect=asked_for.detect, tolerance=asked_for.tolerance),
        answers=given_answers,
        failures=record.failures,
        impossible=tuple(impossible),
        left_out_steps=tuple(left_out_steps),
        **parts._replace(scale=scale)._asdict(),
        innovations=innovations,
        landmarks=record.map.landmarks,
        joint=None if joint is None else joint.score,
        times=record.runs.t if record.origin.files and len(record.runs.t) == steps else None,
        files=record.origin.files if len({*record.origin.files.values()}) > 1 else {},
        unit=record.runs.unit,
        lost=lost,
        ends=ends,
        skipped=record.runs.skipped,
        truth=share,
        unshown=unshown,
        later=later,
    )


# --- innovations, and pose and map together ----------------------------------------------------------


def _innovations(record: Record, settings: Settings) -> tuple[Innovations | None, dict[str, float]]:
    """What the innovations say, and the p values of their questions where an optimal gain is declared."""
    if record.innovations.nis is None and record.innovations.values is None:
        return None, {}
    from consistency.referee.diagnostics.whiteness import (
        nis_and_dof,
        nis_test,
        nis_whiteness,
        outliers_of,
        whiteness,
    )

    innovations = nis_and_dof(record)
    if innovations is None:
        return None, {}
    nis, dof = innovations
    test = nis_test(nis, dof)
    interval = UNKNOWN_ENDS
    if test.dof:
        interval = chi2_mean_interval(test.dof, CONFIDENCE)
    if record.innovations.values is not None and record.innovations.covariances is not None:
        white = whiteness(record.innovations.values, record.innovations.covariances)
    else:
        white = nis_whiteness(nis, dof)
    said = Innovations(test.ratio, interval, test.dof, record.innovations.optimal_gain, white.correlation, white.bound)
    if not record.innovations.optimal_gain:
        return said, {}
    factor = max(settings.factor, settings.tolerated)
    shown = equivalence_of_total(test.ratio * test.dof, test.dof, settings, factor)
    p_values = {"innovation scale": test.p_value}
    if settings.one_sided:
        p_values = {"innovation scale": test.above}
    far = outliers_of(nis, dof)
    if far is not None:
        p_values["innovation scale"] = min(p_values["innovation scale"], far.p_value)
        far = replace(far, run=int(record.run_numbers[far.run]), step=far.step + 1)
    if not settings.one_sided:
        p_values["innovation whiteness"] = white.p_value
    return replace(said, equivalence=shown, outliers=far), p_values


def _joint(record: Record, settings: Settings) -> JointTest | None:
    if record.map.joint is None:
        return None
    from consistency.referee.diagnostics.maps import joint_test

    return joint_test(record.map.joint, settings, record.run_numbers, record.map.landmarks)


def _tolerated(joint: JointTest | None, innovations: Innovations | None, settings: Settings) -> set[str]:
    """Questions of totals whose ratio is shown to lie within the tolerance."""
    tolerated = set()
    if joint is not None and is_tolerated(joint.nees, joint.score.dof, settings):
        tolerated.add(JOINT)
    i = innovations
    if i is not None and i.judged and not i.outliers and is_tolerated(i.ratio * i.dof, i.dof, settings):
        tolerated.add("innovation scale")
    return tolerated


# --- errors -----------------------------------------------------------------------------------------


def _equivalence(
    sample: Sample, settings: Settings, inspection: InterimLook | None, record: Record, truth: UncertainTruth | None
) -> Equivalence:
    """Whether the ratio of true to stated covariance is shown to lie where it should.

    At a look both tests must show it: the e-process is valid at any look, but shows the mean of unlike runs too soon.
    """
    factor = max(settings.factor, settings.tolerated)
    if truth is not None:
        return truth.equivalence(sample, settings, factor)
    shown = equivalence(
        sample.means(),
        sample.dof,
        sample.longest,
        settings,
        factor,
        low_is_fault=not record.fit.reduced,
        unseen=record.fit.unseen,
        is_whole=True,
        test=sample.run_means().tests(gaussian=False),
    )
    if inspection is None:
        return shown
    return worst((shown, equivalence_by_betting(sample.means(), sample.dof, settings, sample.early_means)))


def _of_numbers(settings: Settings, table: RatioTable) -> Settings:
    """Settings of numbers whose mean squares are not ratios of covariances."""
    tolerance = None if settings.tolerance is None else table.factor(settings.tolerated)
    return replace(settings, detect=table.factor(settings.factor), tolerance=tolerance)


def _of_covariance(parts: ErrorParts, record: Record, sample: Sample | None, settings: Settings) -> ErrorParts:
    """The parts of such numbers with ratios of the covariance, and what was asked of them."""
    components = {} if sample is None else {**sample.components, **sample.reported}
    tables = {key: record.table(index) for key, index in components.items()} | {MAIN: record.table()}

    def of(mean_square: Interval, key: str) -> Interval:
        table = tables[key]
        assert table is not None
        value, low, high = map(table.ratio, mean_square)
        return Interval(min(value, float(table.true[-1])), low, high)

    def shown(found: Equivalence) -> Equivalence:
        interval = None
        if found.interval is not None:
            interval = of(Interval(1.0, *found.interval), MAIN)[1:]
        return replace(found, factor=max(settings.factor, settings.tolerated), interval=interval)

    found = parts.with_ratios(of)
    if found.scale is not None:
        found = found._replace(scale=replace(found.scale, equivalence=shown(found.scale.equivalence)))
    if found.accuracy is not None:  # numbers have no units
        none = float("nan")
        rmse = np.full_like(found.accuracy.rmse, none)
        accuracy = replace(found.accuracy, rmse=rmse, rmse_position=none, rmse_heading=none)
        found = found._replace(accuracy=accuracy)
    if found.by_group is not None:
        groups = tuple(replace(group, equivalence=shown(group.equivalence)) for group in found.by_group.groups)
        found = found._replace(by_group=replace(found.by_group, groups=groups))
    return found


def _early_ends(sample: Sample) -> EarlyEnds | None:
    ends = early_ends(sample.nees)
    if not ends.runs:
        return None
    return ends


def _impossible(record: Record, sample: Sample) -> list[tuple[int, int]]:
    """Run and step (1..T) of every value that no filter may say."""
    return [(int(run), int(k) + 1) for run, k in np.argwhere(impossible_values(record, sample.counted))]


def _left_out_steps(record: Record, sample: Sample) -> list[int]:
    """Steps (1..T) in which the covariance of some run is stated and of no full rank."""
    stated = every_entry(np.isfinite, np.asarray(record.errors.covariance, float))
    return [int(k) + 1 for k in np.flatnonzero((stated & ~sample.counted).any(axis=0))]


def _parts_of_estimate(
    truth: UncertainTruth, parts: ErrorParts, given: Sequence[Answer], settings: Settings
) -> ErrorParts:
    """The parts with every ratio that of the estimate alone, and with the mean error and its size."""
    if parts.axes is None or parts.scale is None or not parts.scale.judged_steps:
        return parts
    if not truth.contrasted:
        return truth.of_estimate(parts, given, settings)
    assert parts.bias is not None
    assert parts.accuracy is not None
    assert parts.location is not None
    size = accuracy_of(truth.total)
    clearest = None
    whitened = truth.total.whitened
    assert whitened is not None
    if whitened.shape[1] > 1:
        _, clearest = least_of_steps(t_squared(whitened)[1])  # whatever the truth allows
    mean = bias_of(truth.total, clearest, parts.location, set(faults_of(given)))
    return parts._replace(
        bias=replace(mean, inflation_without=parts.bias.inflation_without),
        accuracy=replace(
            parts.accuracy, rmse=size.rmse, rmse_position=size.rmse_position, rmse_heading=size.rmse_heading
        ),
    )


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
        record = replace(record, fit=replace(record.fit, unavailable=tuple(SHARES)))
    parts = _by_holm(_records_of_parts(record), settings)
    undivided = replace(
        record,
        errors=replace(record.errors, parts=()),
        innovations=replace(record.innovations, optimal_gain=False),
        fit=replace(record.fit, unavailable=tuple(SHARES)),
    )
    whole = findings_of(undivided, settings)
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
    axes = record.errors.axes or names
    assert record.errors.error is not None
    covariance = np.asarray(record.errors.covariance, float)
    records = {}
    for index in record.errors.parts:
        some = list(index)
        ensemble = record.errors.ensemble
        if ensemble is not None:
            ensemble = ensemble._replace(tables=tuple(ensemble.tables[i] for i in index))
        errors = replace(
            record.errors,
            error=record.errors.error[..., some],
            covariance=covariance[..., some, :][..., some],
            dof=len(some),
            axes=tuple(axes[i] for i in index),
            ensemble=ensemble,
            parts=(),
        )
        records[", ".join(names[i] for i in index)] = replace(record, errors=errors, innovations=InnovationRecord())
    if record.innovations.optimal_gain and record.innovations.nis is not None:
        errors = Errors(axes=record.errors.axes, own_names=record.errors.own_names)
        records[INNOVATIONS] = replace(record, errors=errors)
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
    assert record.errors.error is not None
    assert record.errors.covariance is not None
    nees = squared_length(whiten(record.errors.error, record.errors.covariance)) / record.errors.error.shape[-1]
    counted = np.isfinite(nees)
    if record.errors.nees is not None:
        counted = np.isfinite(record.errors.nees)
    return np.where(counted, nees, np.nan)


def _scale_of_whole(whole: Scale, parts: Mapping[str, Findings], record: Record, nees: Array) -> Scale:
    """The size of all errors, with what is known of it whatever the correlations."""
    scales = [part.scale for part in parts.values() if part.scale is not None]
    means, counts = run_means(nees)
    inflation = whole.inflation
    if counts.astype(bool).sum() < FEW:  # the errors of all parts may be the same
        inflation = ratio_interval(means[counts > 0], min(map(len, record.errors.parts)))
        table = record.table()
        if table is not None:
            inflation = Interval(*map(table.ratio, inflation))
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
