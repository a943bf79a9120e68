"""A candidate and its reference, from arrays or from the bench's own results."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from consistency.referee.column_names import POSE
from consistency.referee.diagnostics.comparison import Comparison, FailedRuns, RunSummary, compare, summary
from consistency.referee.diagnostics.records.record import Record
from consistency.referee.diagnostics.records.skipped_start import Skip
from consistency.referee.gating.checked_arrays import record_of_checked, record_of_filter

if TYPE_CHECKING:
    from consistency.referee.verdicts.baselines import Baseline
    from consistency.referee.verdicts.judge_sources import Source

NONE_FAILED = FailedRuns(0, 0)


@dataclass(frozen=True)
class Sides:
    candidate: Record
    a: RunSummary
    b: RunSummary
    name_b: str
    axes: tuple[str, ...] | None
    paired: bool
    failures: FailedRuns = NONE_FAILED

    @property
    def failed_more(self) -> bool:
        return self.paired and self.failures.a > self.failures.b

    @property
    def usable_runs(self) -> int:
        """Runs that both have, or the fewer of the two where they are not paired."""
        a = self.a.runs[np.isfinite(self.a.nees)]
        b = self.b.runs[np.isfinite(self.b.nees)]
        if self.paired:
            return len(np.intersect1d(a, b))
        return min(len(a), len(b))

    def compare(self, false_alarm: float) -> Comparison:
        return compare(self.a, self.b, false_alarm, self.axes, self.paired)

    def reasons(self, c: Comparison) -> list[str]:
        """The outcome in a sentence, then every difference."""
        anees, outcome, where, runs = c.differences[0], "not worse", "nearer to", "runs"
        if c.worse or self.failed_more:
            outcome = "worse"
        if c.distance > 0:
            where = "farther from"
        if c.paired:
            runs = "paired runs"
        lines = [
            f"{outcome} than {self.name_b}: mean NEES {anees.a:.3g} against {anees.b:.3g}, {self.a.dof} expected; "
            f"its ratio to {self.a.dof} is {where} 1 by x{np.exp(abs(c.distance)):.3g} (p {c.p_value:.2g}, "
            f"{c.runs} {runs})"
        ]
        if self.failed_more:
            lines.append(f"{self.failures.a} runs failed, of {self.name_b} {self.failures.b}")
        for d in c.differences:
            kind = "ratio"
            if "coverage" in d.name:
                kind = "difference"
            interval = f"{d.difference:.3g} [{d.low:.3g}, {d.high:.3g}]"
            lines.append(f"{d.name} {d.a:.4g} against {d.b:.4g}: {kind} {interval}")
        return lines


def of_arrays(name: str, candidate: Mapping[str, Any], reference: Mapping[str, Any]) -> Sides:
    """Both sides from arguments of :func:`checked`, row i of both the same trial.

    Raises
    ------
    ValueError
        As :func:`consistency.testing.assert_not_worse`.
    """
    a, row_a = _side("candidate a", name, candidate)
    b, row_b = _side("reference b", name, reference)
    m = len(a.run_numbers)
    n = len(b.run_numbers)
    if m != n:
        raise ValueError(f"the candidate has {m} runs and the reference {n}; row i of both must be one trial")
    if a.dof != b.dof:
        raise ValueError(f"the errors have {a.dof} and {b.dof} components")
    failures = FailedRuns(len(a.failures), len(b.failures))
    return Sides(a, row_a, row_b, "the reference", tuple(a.axes) or None, paired=True, failures=failures)


def _side(side: str, name: str, arrays: Mapping[str, Any]) -> tuple[Record, RunSummary]:
    try:
        case = record_of_checked(name, **arrays)
    except ValueError as error:
        raise ValueError(f"{side}: {error}") from None
    assert case.nees is not None
    return case, summary(case.nees, case.dof, case.error, case.covariance)


def of_filters(
    results: Source,
    filter_name: str | None,
    than: str | None,
    reference: Baseline | None,
    name: str | None,
    skip: str | float | Skip | None = None,
) -> Sides:
    """Both sides from results, or from results and a baseline of an earlier state.

    Raises
    ------
    ValueError
        No such filter, or nothing to compare with.
    """
    from consistency.referee.verdicts.baselines import baseline, require_skip

    if reference is None and than is None:
        raise ValueError("than: name the filter to compare with, or give other results as reference")
    candidate = record_of_filter(results, filter_name, name, skip=skip)
    new = baseline(results, skip=skip)
    old = new
    if reference is not None:
        old = require_skip(reference, skip)
    of_a = filter_name or results.filters[0]
    of_b = than or of_a
    if of_b not in old.filters:
        raise ValueError(f"filter '{of_b}' is not in the reference; there are: {', '.join(old.filters)}")
    paired = new.of_the_trials_of(old)
    label = of_b
    if old is not new:
        label = f"{of_b} in {old.name}"
    failures = FailedRuns(new.failures[of_a], old.failures[of_b])
    return Sides(candidate, new.filters[of_a], old.filters[of_b], label, tuple(POSE), paired, failures)
