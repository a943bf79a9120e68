"""Groups of runs and steps in words: which one is wrong, where the covariance is right, and what is not known."""

from __future__ import annotations

import numpy as np

from consistency.referee.diagnostics.questions.scale import FEW
from consistency.referee.diagnostics.records.groups_by_column import range_name
from consistency.referee.diagnostics.verdict.parts import SIDES, ByGroup, Group
from consistency.referee.diagnostics.verdict.verdict import Findings
from consistency.referee.diagnostics.words.numbers import MOST, is_or_are, off_by, p_text, plural, ratio_text

MUCH = 100_000  # runs; more are no advice


def groups_text(by: ByGroup, is_fault: bool) -> str:
    """The worst group where one is at fault, otherwise what is shown of the groups."""
    if is_fault:
        return _faults(by)
    return _without_fault(by)


def right_groups(v: Findings) -> str:
    """What is shown of the groups of the whole, or of each part, where none is at fault."""
    if v.by_group is not None:
        return f"; {_without_fault(v.by_group)}"
    texts = [f"; {name}: {_without_fault(part.by_group)}" for name, part in v.parts.items() if part.by_group]
    if len(texts) > MOST:
        texts = [*texts[:MOST], f"; and {len(texts) - MOST} more"]
    return "".join(texts)


def _faults(by: ByGroup) -> str:
    """The worst group and those beside it, then where the covariance is shown to be right."""
    worst = by.worst
    others = [group for group in by.groups if group.status in SIDES and group is not worst]
    text = f"covariance {off_by(worst.ratio)} where {worst.name}"
    if len(others) == 1:
        text += f", and {off_by(others[0].ratio)} where {others[0].name}"
    elif others:
        which = f"{len(others)} of the {len(by.groups) - 1} other groups"
        if len(others) == len(by.groups) - 1:
            which = f"all {len(others)} other groups"
        text += f", and wrong in {which} by {by.column}"
    right = _consistent(by)
    if right:
        text += f"; consistent where {right}"
    return text


def _without_fault(by: ByGroup) -> str:
    """What is shown of the groups where none is at fault, and the one that is farthest."""
    worst = by.worst
    count = len(by.groups)
    if not worst.status:
        return f"groups by {by.column} are reported and not judged"
    right = sum(group.status == "consistent" for group in by.groups)
    if right == count:
        return f"consistent in each of {count} groups by {by.column}"
    return f"consistent in {right} of {count} groups by {by.column} (farthest {ratio_text(worst.ratio)}, {worst.name})"


def lines_of_groups(by: ByGroup, unit: str) -> list[str]:
    """A line for each group, then what its values leave to be said."""
    lines = []
    if by.outcome:
        lines.append(f"{by.column} {by.outcome}, which selects on the outcome: groups show, they do not convict")
    lines += [f"{group.name}: {_figures(group, unit)}" for group in by.groups]
    if by.without:
        lines.append(f"{plural(by.without, 'step')} without a value of {by.column} {is_or_are(by.without)} in no group")
    return lines


def _figures(group: Group, unit: str) -> str:
    """Ratio, verdict and size of a group."""
    text = f"covariance ratio {ratio_text(group.ratio)}"
    if group.status:
        text += f", {group.status}"
    if group.status in SIDES:
        text += f" (p {p_text(group.p_value)})"
    text += f", in {plural(group.steps, 'step')} of {plural(group.runs, unit)}"
    if group.status == "undecided":
        text += _advice(group, unit)
    return text


def _advice(group: Group, unit: str) -> str:
    """That a group is in too few runs, and how many would decide."""
    few = ""
    if group.runs < FEW:
        few = f", too few to see how steps depend on each other ({FEW} are needed)"
    runs = group.equivalence.runs
    if runs is None or runs > MUCH:
        return few
    return f"{few}; {max(runs, group.runs + 1)} such {unit}s would probably decide"


def _consistent(by: ByGroup) -> str:
    """The groups where the covariance is shown to be right; neighbouring groups of numbers as one range."""
    names: list[str] = []
    low = high = np.nan
    for group in by.groups:
        if group.status != "consistent":
            continue
        if group.span is None:
            names.append(group.name)
        elif group.span[0] == high:
            high = group.span[1]
            names[-1] = range_name(by.column, low, high)
        else:
            low, high = group.span
            names.append(group.name)
    if len(names) > MOST:
        names = [*names[:MOST], f"in {len(names) - MOST} other groups"]
    return " or ".join(names)
