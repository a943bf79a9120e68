"""Whether stated bounds hold at their level, as findings of a verdict.

A step is outside where the error over the bound exceeds 1. Runs are the unit. Steps after the end of a run, and those
of lost runs, count as inside for "too small" and as outside for "too large", so that ends which depend on the errors
cannot make a fault; ``Bound.ends_independent`` declares that they do not.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from consistency.referee.defaults import GATE_FALSE_ALARM
from consistency.referee.diagnostics.exceedance import (
    Exceedance,
    betting,
    fewest_runs,
    gaffke,
    missing_steps,
    runs_to_show,
)
from consistency.referee.diagnostics.record import Bound, Record
from consistency.referee.diagnostics.verdict import Findings
from consistency.referee.diagnostics.verdict_parts import (
    HAZARD,
    REGIONS,
    Alerts,
    Answer,
    BoundScore,
    Equivalence,
    Settings,
    answers,
    faults_of,
    with_tolerated,
)
from consistency.referee.types import Array

OF_GROUPS = 0.5  # of the false-alarm rate, where groups are judged beside all steps


class Question(NamedTuple):
    """One bound, in all steps or in a group of them."""

    name: str
    bound: Bound
    ratios: Array  # (runs, steps), with their signs; NaN where a step does not count
    sizes: Exceedance
    regions: Array | None  # (runs, steps), of the Stanford diagram, where the bound has an alert limit
    group: str
    judged: bool


def findings_of_bounds(record: Record, settings: Settings) -> Findings:
    """Test every bound of a record, at a false-alarm rate that all share (Holm 1979).

    At rates up to .001 a fault is found by a bet, whose rate is proved, at larger ones by Gaffke's test, whose rate is
    measured. *Consistent* is shown by two one-sided tests that the factor by which the bound has to grow lies within
    the root of ``settings.detect``.
    """
    assert record.errors.bounded is not None
    asked = list(_questions(record))
    test = betting if settings.false_alarm <= GATE_FALSE_ALARM else gaffke
    small = {q.name: q.sizes.p_small(test=test) for q in asked if q.judged}
    p_values = dict(small)
    if not settings.one_sided:
        for q in asked:
            if q.judged:
                p_values[q.name] = min(1.0, 2.0 * min(small[q.name], q.sizes.p_large(test=test)))
    given = tuple(answers(p_values, settings.false_alarm, _shares(asked)).values())
    tolerated = []
    if settings.tolerance is not None:
        tolerated = [q.name for q in asked if q.judged and _equivalence(q, settings, settings.tolerated**0.5).shown]
    given = with_tolerated(given, tolerated)
    faults = faults_of(given)
    scores = tuple(_score(q, settings, given, q.name in faults) for q in asked)
    status = _status(scores, record)
    if status == "undecided":
        scores = tuple(_with_runs(score, settings) for score in scores)
    steps = record.errors.bounded.ratios.shape[1]
    return Findings(
        filter=record.name,
        status=status,
        runs=len(record.run_numbers),
        steps=steps,
        settings=settings,
        answers=given,
        failures=record.failures,
        bounds=scores,
        times=record.runs.t if record.origin.files and len(record.runs.t) == steps else None,
        files=record.origin.files if len({*record.origin.files.values()}) > 1 else {},
        unit=record.runs.unit,
        skipped=record.runs.skipped,
    )


def _questions(record: Record) -> Iterator[Question]:
    """Each bound in all steps, then in each group; groups are not judged where ends may depend on the errors."""
    assert record.errors.bounded is not None
    of, groups = record.errors.bounded, record.groups
    for i, bound in enumerate(of.bounds):
        ratios = of.ratios[..., i]
        missing = missing_steps(ratios)
        if bound.ends_independent:
            missing = np.zeros_like(missing)
        sizes = Exceedance(np.abs(ratios), missing, bound.level)
        regions = None
        if bound.alert_limit is not None and of.regions is not None:
            regions = of.regions[..., i]
        yield Question(bound.name, bound, ratios, sizes, regions, "", sizes.runs > 0)
        for number, name in enumerate(() if groups is None else groups.names):
            assert groups is not None
            some = np.where(groups.index == number, ratios, np.nan)
            in_group = Exceedance(np.abs(some), np.zeros_like(missing), bound.level)
            if in_group.runs:
                judged = not groups.outcome and not missing.any()
                of_group = None if regions is None else np.where(groups.index == number, regions, np.nan)
                yield Question(f"{bound.name} where {name}", bound, some, in_group, of_group, name, judged)


def _shares(asked: Sequence[Question]) -> dict[str, float]:
    """Share of the false-alarm rate of each question: bounds have one half, and their groups the other."""
    judged = [q for q in asked if q.judged]
    of_groups = sum(bool(q.group) for q in judged)
    part = OF_GROUPS if of_groups and of_groups < len(judged) else float(of_groups > 0)
    return {q.name: part / of_groups if q.group else (1.0 - part) / (len(judged) - of_groups) for q in judged}


def _equivalence(q: Question, settings: Settings, factor: float) -> Equivalence:
    """Two one-sided tests that the factor of the bound is within [1 / factor, factor]."""
    p = q.sizes.p_large(factor)
    if not settings.one_sided:
        p = max(p, q.sizes.p_small(1.0 / factor))
    level = 1.0 - settings.power
    return Equivalence(factor, p if q.judged else float("nan"), level, None, settings.one_sided)


def _score(q: Question, settings: Settings, given: Sequence[Answer], is_fault: bool) -> BoundScore:
    adjusted = {answer.question: answer.adjusted for answer in given}
    factor = q.sizes.factor()
    shown = _equivalence(q, settings, max(settings.factor, settings.tolerated) ** 0.5)
    status = ""
    if is_fault:
        status = "overconfident" if settings.one_sided or q.sizes.p_small() < q.sizes.p_large() else "conservative"
    elif q.judged:
        status = "consistent" if shown.shown else "undecided"
    above = below = float("nan")
    if len(q.bound.components) == 1:
        above, below = _share_of_side(q.ratios), _share_of_side(-q.ratios)
    return BoundScore(
        q.name, q.bound.level, factor, q.sizes.rate(), q.sizes.rate_limit(), above, below, q.sizes.runs,
        int((~np.isnan(q.ratios)).sum()), int(q.sizes.missing.sum()), fewest_runs(q.bound.level, shown.level),
        adjusted.get(q.name, float("nan")), shown, status, q.group, _alerts(q),
    )  # fmt: skip


def _alerts(q: Question) -> Alerts | None:
    """Shares of the steps in the regions of the Stanford diagram; None without an alert limit."""
    regions, limit = q.regions, q.bound.alert_limit
    if regions is None or limit is None:
        return None

    def of(region: int) -> Exceedance:
        """Steps in a region as those outside a bound."""
        return replace(q.sizes, ratios=np.where(np.isnan(regions), np.nan, 2.0 * (regions == region)))

    shares = tuple(of(region).rate() for region in range(len(REGIONS)))
    return Alerts(limit, shares, of(HAZARD).rate_limit())


def _share_of_side(ratios: Array) -> float:
    """Mean over runs of the share of steps outside on the upper side; ratios (runs, steps)."""
    there = ~np.isnan(ratios)
    some = there.any(axis=1)
    with np.errstate(invalid="ignore"):
        return float(((ratios > 1.0).sum(axis=1)[some] / there.sum(axis=1)[some]).mean())


def _with_runs(score: BoundScore, settings: Settings) -> BoundScore:
    """A score with the number of runs that show a right bound to be right, however steps depend on each other."""
    if score.status != "undecided":
        return score
    runs = runs_to_show(score.level, settings.detect, settings.power)
    return replace(score, equivalence=replace(score.equivalence, runs=runs))


def _status(scores: Sequence[BoundScore], record: Record) -> str:
    """One word for all bounds and groups."""
    statuses = {score.status for score in scores} - {""}
    sides = statuses & {"overconfident", "conservative"}
    if len(sides) > 1:
        return "inconsistent"
    if sides:
        return sides.pop()
    if record.failures or not statuses:
        return "failed"
    return "consistent" if statuses == {"consistent"} else "undecided"
