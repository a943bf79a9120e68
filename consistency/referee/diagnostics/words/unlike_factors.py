"""Blocks and axes of the state that are off by unlike factors, in words."""

from __future__ import annotations

import numpy as np

from consistency.referee.diagnostics.verdict.parts import TINY, ComponentRatios, Interval
from consistency.referee.diagnostics.verdict.verdict import Findings
from consistency.referee.diagnostics.words.numbers import MOST, SIDE, names_in_a_row, off_by

BLOCKS = ("position", "attitude", "velocity")
NEAR = 1.3  # ratio of each axis of a block that is called right: with more, an axis wrong by 1.5 hides in it too often


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


def is_right(v: Findings, name: str, ratio: Interval) -> bool:
    """Whether an axis or block is shown to lie within ``--detect``, and each of its axes may be right and is near 1."""
    assert v.axes is not None
    ratios = [v.axes.inflation[each] for each in (name, *members_of(v.axes, name))]
    are_near = all(each.holds(1.0) and 1.0 / NEAR <= each.value <= NEAR for each in ratios)
    return are_near and 1.0 / v.settings.factor <= ratio.low and ratio.high <= v.settings.factor


def unlike_ratios(v: Findings) -> dict[str, Interval]:
    """Blocks and axes whose ratio is not 1, the farthest first; none where all may be off by one factor.

    Of a conservative covariance those that are too large alone, as nothing in it has to grow. Where that is not a
    fault, those that are too small.
    """
    if v.axes is None:
        return {}
    ratios = ratios_of_blocks(v.axes)
    if are_alike(list(ratios.values())):
        return {}
    off = []
    if not v.settings.one_sided:
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
    texts = []
    side = ""
    for name in names_to_say(off):
        size = off_by(off[name])
        texts.append(f"{name} {size.removeprefix(side).lstrip()}")  # the side once: x too small by ..., y by ...
        side = size[:SIDE]
    others = {name: ratio for name, ratio in ratios_of_blocks(v.axes).items() if name not in off}
    right = [name for name, ratio in others.items() if is_right(v, name, ratio)]
    if len(right) > MOST and len(right) == len(others):
        texts.append("the others right")
    elif 1 <= len(right) <= MOST:
        texts.append(f"{names_in_a_row(right)} right")
    return ", ".join(texts)


def names_to_say(off: dict[str, Interval]) -> list[str]:
    """The first of those that are off, with one of either side."""
    names = list(off)[:MOST]
    contrary = [name for name in off if (off[name].value > 1.0) != (off[names[0]].value > 1.0)]
    if contrary and contrary[0] not in names:
        names[-1] = contrary[0]
    return names


def factors_text(v: Findings) -> str:
    """:func:`unlike_text` where the axes that carry the fault of the scale are among those that it names, or ''."""
    assert v.location is not None
    if v.axes is None:
        return ""
    inside = set()
    for name in unlike_ratios(v):
        inside.update(members_of(v.axes, name) or [name])
    if not inside.issuperset(v.location.subset.split(", ") if v.location.subset else ()):
        return ""
    return unlike_text(v)
