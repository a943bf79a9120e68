"""Stated bounds corrected by a factor each, judged on runs that chose nothing.

The factor is that of conformal risk control (Angelopoulos, Bates, Fisch, Lei & Schuster 2024): one more run, outside in
all of its steps, is counted among those fitted. A new run is then expected to leave the corrected bound in at most
1 - level of its steps, whatever the errors and however steps of a run depend on each other, if runs are exchangeable.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from consistency.referee.diagnostics.bound_words import factor_text, level_text
from consistency.referee.diagnostics.exceedance import Exceedance, fewest_fitted
from consistency.referee.diagnostics.number_words import percent, plural, short
from consistency.referee.diagnostics.record import Bound, BoundErrors, Map, Record
from consistency.referee.diagnostics.verdict import Verdict, plain
from consistency.referee.diagnostics.verdict_parts import Interval
from consistency.referee.errors import InputError
from consistency.referee.fit_covariance.covariance_ratios import IN_TURN, fitted_and_judged, require_fixed_groups
from consistency.referee.show.blocks import Block, Column, Document, Text, table
from consistency.referee.types import Array
from consistency.referee.verdicts.judge_sources import judge_all

HEAD = "The bound becomes factor * bound: of its group, or of all steps where it has none."


@dataclass(frozen=True)
class BoundFactor:
    """The factor of one bound, of all steps or of those of a group."""

    bound: Bound
    group: str  # "" of all steps
    factor: float
    interval: Interval  # of the factor with which the level holds, 95 %
    left_out: Array = field(repr=False)  # (R,), the factor without each of the fitted runs
    note: str = ""


@dataclass(frozen=True)
class BoundCorrection:
    """Factors of stated bounds, with the verdict on errors that chose nothing."""

    name: str
    factors: tuple[BoundFactor, ...]
    held_out: str  # "in turn", "half" or names
    fitted: tuple[str, ...]  # names of runs
    judged: tuple[str, ...]
    numbers: tuple[int, ...]  # of the judged runs
    before: Verdict = field(repr=False)  # the judged runs as they are stated
    after: Verdict = field(repr=False)
    rates: Mapping[str, Interval]  # share of steps outside the corrected bound, held out, 95 %, by bound

    @property
    def status(self) -> str:
        """consistent, undecided, or inconsistent where a level does not hold after."""
        return self.after.status if self.after.status in ("consistent", "undecided") else "inconsistent"

    @property
    def sentence(self) -> str:
        """The end that was reached, and how often held-out errors leave the bounds."""
        parts = []
        for score in self.before.bounds:
            if score.group:
                continue
            rate = self.rates[score.name]
            parts.append(
                f"held-out errors leave {score.name} in {percent(score.rate)} of the steps before and in "
                f"{percent(rate.value)} [{percent(rate.low)}, {percent(rate.high)}] after, "
                f"{100.0 * (1.0 - score.level):.3g} % expected"
            )
        how = f"{plural(len(self.judged), self.after.unit)}, each judged by the factors of the others"
        if self.held_out != IN_TURN:
            how = f"fitted on {plural(len(self.fitted), self.after.unit)}, judged on {len(self.judged)} others"
        if self.status != "consistent":
            how += f"; {self.after.reasons[0]}"
        return f"{self.status} after: {'; '.join(parts)}; {how}"

    def __repr__(self) -> str:
        return f"<BoundCorrection {self.name}: {self.sentence}>"


def correct_bounds(record: Record, labels: Sequence[str], held_out: str | None) -> BoundCorrection:
    """Fit a factor to each bound of a record, and judge it on runs that chose nothing.

    Parameters
    ----------
    record : with errors over bounds
    labels : of the runs, for messages and ``held_out``
    held_out : as of :func:`consistency.correct`

    Raises
    ------
    InputError
        There are fewer runs than a level takes; or a name is not there.
    """
    assert record.errors.bounded is not None
    require_fixed_groups(record)
    counted = np.asarray((~np.isnan(record.errors.bounded.ratios)).any(axis=(1, 2)))
    fitted, judged = fitted_and_judged(labels, counted, held_out)
    fit = record.of_runs(fitted)
    factors = tuple(
        factor for b in range(len(record.errors.bounded.bounds)) for factor in _factors(fit, b, held_out is None)
    )
    some = replace(record, map=Map(), world=None).of_runs(judged)
    stated = some.errors.bounded
    assert stated is not None
    place = {run: row for row, run in enumerate(fitted)}
    ratios = stated.ratios.copy()
    index = np.zeros(ratios.shape[:2], int) if some.groups is None else some.groups.index
    for factor in factors:
        b = [bound.name for bound in stated.bounds].index(factor.bound.name)
        own = [factor.left_out[place[run]] if run in place else factor.factor for run in judged]
        names = ("",) if some.groups is None else some.groups.names
        in_group = index == names.index(factor.group) if factor.group or some.groups is None else index < 0
        ratios[..., b] = np.where(in_group, stated.ratios[..., b] / np.array(own)[:, None], ratios[..., b])
    some = _over_bounds(some, BoundErrors(stated.bounds, stated.ratios))  # regions are of bounds as they are stated
    corrected = _over_bounds(some, BoundErrors(stated.bounds, ratios))
    rates = {
        bound.name: Exceedance(np.abs(ratios[..., b]), np.zeros(len(ratios), int), bound.level).rate_interval()
        for b, bound in enumerate(stated.bounds)
    }
    before, after = (judge_all([each])[record.name] for each in (some, corrected))
    names_of = tuple(labels[i] for i in fitted), tuple(labels[i] for i in judged)
    numbers = tuple(some.run_numbers.tolist())
    return BoundCorrection(record.name, factors, held_out or IN_TURN, *names_of, numbers, before, after, rates)


def _over_bounds(record: Record, bounded: BoundErrors) -> Record:
    return replace(record, errors=replace(record.errors, bounded=bounded))


def _factors(record: Record, b: int, in_turn: bool) -> list[BoundFactor]:
    """Factors of a bound in each group, and last in all steps; a group of too few runs has that of all."""
    assert record.errors.bounded is not None
    bound = record.errors.bounded.bounds[b]
    sizes = np.abs(record.errors.bounded.ratios[..., b])
    least = fewest_fitted(bound.level) + in_turn
    there = int((~np.isnan(sizes)).any(axis=1).sum())
    if there < least:
        rows = "" if record.runs.independent else "; rows that do not depend on each other are runs with --independent"
        raise InputError(
            f"{bound.name}: {plural(there, record.runs.unit)} of {least} that a factor for {level_text(bound.level)} "
            f"takes: with fewer, none is sure to hold its level for a new one; give more, or a lower level{rows}"
        )
    whole = _factor(bound, "", sizes)
    found = []
    groups = record.groups
    for number, name in enumerate(() if groups is None else groups.names):
        assert groups is not None
        of_group = np.where(groups.index == number, sizes, np.nan)
        if (runs := int((~np.isnan(of_group)).any(axis=1).sum())) < least:
            note = f"{name}: {plural(runs, record.runs.unit)} of {least} needed; the factor is that of all steps"
            found.append(replace(whole, group=name, note=note))
        else:
            found.append(_factor(bound, name, of_group))
    return [*found, whole]


def _factor(bound: Bound, group: str, sizes: Array) -> BoundFactor:
    of = Exceedance(sizes, np.zeros(len(sizes), int), bound.level)
    factor, left_out = of.covering_factors()
    if not (min(factor, left_out.min()) > 0.0 and max(factor, left_out.max()) < np.inf):
        raise InputError(
            f"{bound.name}: errors or bounds are 0 in too many steps for a factor at {level_text(bound.level)}: judge "
            "those steps by themselves"
        )
    return BoundFactor(bound, group, factor, of.factor(), left_out)


def bound_correction_document(found: BoundCorrection) -> Document:
    """Sentence, factors, and limits; numbers as data."""
    has_groups = any(factor.group for factor in found.factors)
    heads = ("group", "bound", "level", "factor", "95 % interval of the right one")
    rows = []
    for each in found.factors:
        cells = (each.group or "all steps", each.bound.name, level_text(each.bound.level), short(each.factor))
        rows.append((*cells, factor_text(each.interval))[not has_groups :])
    columns = tuple(Column(head) for head in heads[not has_groups :])
    text = "a new run is expected to leave a corrected bound in at most 1 - level of its steps, if it is like these"
    notes = [each.note for each in found.factors if each.note]
    blocks: tuple[Block, ...] = (
        Text(f"{found.name}: {found.sentence}"), table(columns, rows, "Factors of each bound", style="plain"),
        *map(Text, notes), Text(text),
    )  # fmt: skip
    return Document(f"{found.name}: correction of the stated bounds", "", (), blocks, data_of_bounds(found))


def data_of_bounds(found: BoundCorrection) -> dict[str, object]:
    """Everything as plain data, as correction.toml and --json have it."""
    factors = [
        {"group": each.group or None, "bound": each.bound.name, "level": each.bound.level, "factor": each.factor,
         "factor_interval": each.interval[1:]}
        for each in found.factors
    ]  # fmt: skip
    held_out = [
        {"bound": name, "outside": rate.value, "outside_interval": rate[1:]} for name, rate in found.rates.items()
    ]
    return dict(
        plain({
            "name": found.name, "status": found.status, "sentence": found.sentence, "held_out": found.held_out,
            "fitted_runs": found.fitted, "judged_runs": found.judged, "factors": factors, "corrected": held_out,
            "referee": found.after.statistics,
        })
    )  # fmt: skip
