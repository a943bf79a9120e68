"""Blocks and axes of the state that are off by unlike factors, in words."""

from __future__ import annotations

import numpy as np

from consistency.referee.diagnostics.verdict.parts import TINY, ComponentRatios, Interval
from consistency.referee.diagnostics.verdict.verdict import Findings
from consistency.referee.diagnostics.words.numbers import MOST, names_in_a_row, off_by

BLOCKS = ("position", "attitude", "velocity")


def ratios_of_blocks(axes: ComponentRatios) -> dict[str, Interval]:
    """Ratio of each block whose axes are alike, and of every other axis by itself."""
    ratios, inside = {}, set()
    for block in BLOCKS:
        members = members_of(axes, block)
        if members and are_alike([axes.inflation[name] for name in (block, *members)]):
            ratios[block] = axes.inflation[block]
            inside.update(members)
    return ratios | {axis: axes.inflation[axis] for axis in axes.names if axis not in inside}


def members_of(axes: ComponentRatios, block: str) -> list[str]:
    """Axes of a block of several; none where the state has no such block."""
    index = axes.groups.get(block, ())
    if block not in BLOCKS or len(index) < 2:
        return []
    return [axes.names[i] for i in index]


def are_alike(intervals: list[Interval]) -> bool:
    """Whether some factor lies in all of the intervals."""
    return max(interval.low for interval in intervals) <= min(interval.high for interval in intervals)


def unlike_ratios(v: Findings) -> dict[str, Interval]:
    """Blocks and axes whose ratio is not 1, the farthest first; none where all may be off by one factor.

    Of a conservative covariance those that are too large alone: nothing in it has to grow.
    """
    if v.axes is None:
        return {}
    ratios = ratios_of_blocks(v.axes)
    if are_alike(list(ratios.values())):
        return {}
    off = [(name, ratio) for name, ratio in ratios.items() if ratio.high < 1.0]
    if v.status != "conservative":
        off += [(name, ratio) for name, ratio in ratios.items() if ratio.low > 1.0]
    return dict(sorted(off, key=lambda item: -abs(np.log(max(item[1].value, TINY)))))


def unlike_text(v: Findings) -> str:
    """Position too small by x2.22 [1.80, 2.81], attitude and velocity right; '' where factors may be the same."""
    off = unlike_ratios(v)
    if not off:
        return ""
    assert v.axes is not None
    texts = [f"{name} {off_by(ratio)}" for name, ratio in list(off.items())[:MOST]]
    others = {name: ratio for name, ratio in ratios_of_blocks(v.axes).items() if name not in off}
    factor = v.settings.factor
    right = [name for name, ratio in others.items() if 1.0 / factor <= ratio.low and ratio.high <= factor]
    if len(right) > MOST and len(right) == len(others):
        texts.append("the others right")
    elif 1 <= len(right) <= MOST:
        texts.append(f"{names_in_a_row(right)} right")
    return ", ".join(texts)


def block_text(v: Findings) -> str:
    """:func:`unlike_text` where whole blocks carry the fault of the scale; '' where single axes do, or all."""
    assert v.location is not None
    if v.axes is None:
        return ""
    blocks = [name for name in unlike_ratios(v) if members_of(v.axes, name)]
    inside = {axis for block in blocks for axis in members_of(v.axes, block)}
    if not blocks or (v.location.subset and not inside.issuperset(v.location.subset.split(", "))):
        return ""
    return unlike_text(v)
