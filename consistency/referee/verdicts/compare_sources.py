"""Filters against each other on the same trials, and against a baseline kept from an earlier release."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from consistency.referee.defaults import DETECT, FALSE_ALARM, POWER
from consistency.referee.diagnostics.comparison import FEWEST, Comparison, FailedRuns, compare
from consistency.referee.document.blocks import Block, Document, Text
from consistency.referee.document.compared_filters import comparison_table
from consistency.referee.errors import InputError
from consistency.referee.verdicts.baselines import Baseline


@dataclass(frozen=True)
class Compared:
    """Filter ``a`` against ``b``."""

    a: str
    b: str
    comparison: Comparison
    failures: FailedRuns
    note: str = ""
    same_runs: bool = True  # failures are of the same trials
    sources: tuple[str, str] = ("", "")  # files or folders of both, where they differ

    @property
    def sentence(self) -> str:
        c = self.comparison
        own, reference = self.names
        found = "not found less consistent"
        way = "as independent samples"
        if c.worse:
            found = "less consistent"
        if c.paired:
            way = "run by run on the same trials"
        text = f"{own} is {found} than {reference}: {c.runs} runs, {way}, p {c.p_value:.2g}"
        if c.distance == c.standard_error == 0.0:
            text += "; every run is the same in both"
        elif c.worse and c.conservative:
            text += (
                f"; its covariance is farther too large, unless rare runs with a large NEES are missing here: up to "
                f"{100.0 * c.unseen:.2g} % of all runs may be of a kind that {c.runs} do not show"
            )
        elif not c.worse:
            text += f"; {self._limit}"
            if not c.at_most < np.log(DETECT):
                text += (
                    f"; {c.needed_runs(DETECT)} runs find a covariance farther off by x{DETECT:g} with power {POWER:g}"
                )
        if any(self.failures):
            text += f"; failed runs: {self.failures.a} of {own}, {self.failures.b} of {reference}"
        if self.note:
            return f"{text}. {self.note}".rstrip(". ")
        return text

    @property
    def names(self) -> tuple[str, str]:
        """What both are called: by their sources where they have one name."""
        if self.a != self.b:
            return self.a, self.b
        own, other = self.sources
        if own == other:
            return self.a, "the reference"
        return f"{self.a} of {own}", f"{self.b} of {other}"

    @property
    def _limit(self) -> str:
        """How much farther off filter ``a`` may be that is not found worse."""
        most = self.comparison.at_most
        if most < 0.0:
            return f"nearer to consistent, by x{np.exp(-most):.3g} at least"
        if not np.isfinite(most):
            return "no difference shown"
        return f"no difference shown; at most x{np.exp(most):.3g} farther off"

    @property
    def worse(self) -> bool:
        if self.comparison.worse or not (self.comparison.paired and self.same_runs):
            return self.comparison.worse
        return self.failures.a > self.failures.b


def compare_filters(base: Baseline, filters: Sequence[str], false_alarm: float = FALSE_ALARM) -> list[Compared]:
    """The first filter against each of the others, on the same trials."""
    names = list(filters) or list(base.filters)
    if len(names) < 2:
        raise InputError(
            f"{base.name}: give two filters with --filter, or another folder or a baseline to compare with"
        )
    return [_compared(base, names[0], base, other, true_pairs=True, false_alarm=false_alarm) for other in names[1:]]


def compare_with(
    new: Baseline, old: Baseline, filters: Sequence[str], false_alarm: float = FALSE_ALARM
) -> list[Compared]:
    """Each filter of ``new`` against the same in ``old``; run by run only where the trials are the same."""
    pairs = [(name, name) for name in filters or new.filters if filters or name in old.filters]
    if not pairs and len(new.filters) == len(old.filters) == 1:  # estimators that are named after their files
        pairs = [(next(iter(new.filters)), next(iter(old.filters)))]
    if not pairs:
        raise InputError(f"{new.name} and {old.name} have no filter in common; name one with --filter")
    same = new.of_the_trials_of(old)
    note = ""
    if new.trials and old.trials:
        old, common = _numbered_alike(new, old)
        same = common >= FEWEST
        note = f"{common} of {len(new.trials)} runs have the same seed and truth in both"
    elif not same:
        which = "Scenario or seed"
        if new.scenario is None and old.scenario is None:
            which = "Log or truth"
        note = f"{which} differ: the trials are not the same"
    comparisons = []
    for a, b in pairs:
        as_many = len(new.filters[a].runs) == len(old.filters[b].runs)
        comparisons.append(_compared(new, a, old, b, same, false_alarm, note, as_many or not new.trials))
    return comparisons


def _numbered_alike(new: Baseline, old: Baseline) -> tuple[Baseline, int]:
    """The old runs of a program with the numbers of the new ones of the same seed and truth, and how many these are.

    Runs without a counterpart have negative numbers.
    """
    number = {trial: run for run, trial in new.trials.items()}
    renamed = {run: number.get(trial, -1 - run) for run, trial in old.trials.items()}
    filters = {}
    for name, rows in old.filters.items():
        runs = [renamed.get(int(run), -1 - int(run)) for run in rows.runs]
        filters[name] = replace(rows, runs=np.array(runs, np.int64))
    return replace(old, filters=filters), sum(run >= 0 for run in renamed.values())


def _compared(
    a: Baseline,
    of_a: str,
    b: Baseline,
    of_b: str,
    true_pairs: bool,
    false_alarm: float,
    note: str = "",
    same_runs: bool = True,
) -> Compared:
    """Filter ``of_a`` of ``a`` against ``of_b`` of ``b``; run by run where these are ``true_pairs``."""
    for base, name in ((a, of_a), (b, of_b)):
        if name not in base.filters:
            raise InputError(f"--filter {name}: is not in {base.name}; there are: {', '.join(base.filters)}")
    axes = a.axes[of_a]
    if axes != b.axes[of_b]:
        raise InputError(
            f"{of_a} against {of_b}: their errors have different components, {', '.join(axes)} and "
            f"{', '.join(b.axes[of_b])}"
        )
    paired = None
    if not true_pairs:
        paired = False
    try:
        comparison = compare(a.filters[of_a], b.filters[of_b], false_alarm, axes, paired)
    except ValueError as error:
        raise InputError(f"{of_a} against {of_b}: {error}") from None
    failures = FailedRuns(a.failures[of_a], b.failures[of_b])
    return Compared(of_a, of_b, comparison, failures, note, same_runs, (a.name, b.name))


def comparison_document(compared: Sequence[Compared]) -> Document:
    """Tables and sentences of comparisons, and their numbers."""
    blocks: list[Block] = []
    data: list[dict[str, Any]] = []
    for each in compared:
        blocks += [comparison_table(*each.names, each.comparison), Text(each.sentence), Text("")]
        numbers = {"a": each.a, "b": each.b, "worse": each.worse, "sentence": each.sentence, "failures": each.failures}
        data.append(numbers | asdict(each.comparison))
    return Document("", "", (), tuple(blocks), data)
