"""Covariance ratio, bias and coverage by axis of the pose."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from consistency.referee.diagnostics import Verdict
from consistency.referee.diagnostics.statistics.accuracy import TWO_SIGMA
from consistency.referee.document.colours import EXPECTED, solid
from consistency.referee.document.drawing import Axis, Figure, Intervals, Key, Panel, Rule, Sheet, dodge
from consistency.referee.pages.judged import Estimator, Judged
from consistency.referee.pages.section import STUDY, Section
from consistency.referee.types import Array

Interval = tuple[float, float, float]  # value, low, high; the ends may be infinite
Row = tuple[str, tuple[Interval | None, ...]]  # an axis, and an interval or None for each filter

WHOLE, DIRECTION = "all axes", "worst direction"
FAR = 30.0  # an interval that reaches further than this factor beyond all values is cut off


@dataclass(frozen=True)
class Forest:
    """One quantity of the axes, with intervals."""

    name: str
    label: str  # of the axis with its unit
    form: str  # of a number
    expected: float
    window: tuple[float, float]  # drawn range
    log: bool
    rows: tuple[Row, ...]

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of the rows that hold something."""
        return tuple(label for label, intervals in self.rows if any(intervals))


@dataclass(frozen=True)
class ByAxis:
    """Quantities that a filter of the study has; at least one."""

    study: Judged
    forests: tuple[Forest, ...]

    @property
    def labels(self) -> tuple[str, ...]:
        """Names of all rows, in one order."""
        names = dict.fromkeys(name for forest in self.forests for name, _ in forest.rows)
        return tuple(sorted(names, key=lambda name: name == WHOLE))


def read(study: Judged) -> ByAxis | None:
    """The intervals of the verdicts; None where no filter has any."""
    all_forests = forests(study)
    return ByAxis(study, all_forests) if all_forests else None


def forests(study: Judged) -> tuple[Forest, ...]:
    """Covariance ratio, bias and coverage by axis; those that no filter has are left out."""
    kinds = (
        ("ratio", "covariance ratio (truth / stated)", ".3g", 1.0, _ratio_window, True, _ratios),
        ("bias", "mean error (stated sigma)", "+.2f", 0.0, _bias_window, False, _biases),
        ("coverage", "within 2 sigma (%)", ".0f", 100.0 * TWO_SIGMA, _coverage_window, False, _coverages),
    )
    result = []
    for name, label, form, expected, window, log, intervals_of in kinds:
        rows = _rows(study, intervals_of)
        if rows:
            intervals = [i for _, row in rows for i in row if i is not None]
            result.append(Forest(name, label, form, expected, window(intervals), log, rows))
    return tuple(result)


def _rows(study: Judged, intervals_of: Callable[[Verdict], dict[str, Interval]]) -> tuple[Row, ...]:
    by_filter = [{k: i for k, i in intervals_of(t.verdict).items() if np.isfinite(i[0])} for t in study.tracks]
    names = dict.fromkeys(name for intervals in by_filter for name in intervals)
    return tuple((name, tuple(intervals.get(name) for intervals in by_filter)) for name in names)


def _ratios(v: Verdict) -> dict[str, Interval]:
    intervals: dict[str, Interval] = {}
    if v.axes is not None:
        intervals |= v.axes.inflation
        if v.axes.largest is not None:
            intervals[DIRECTION] = v.axes.largest
    if v.scale is not None:
        intervals[WHOLE] = v.scale.inflation
    return {name: interval for name, interval in intervals.items() if interval[0] > 0}


def _biases(v: Verdict) -> dict[str, Interval]:
    return {} if v.bias is None else dict(v.bias.by_axis)


def _coverages(v: Verdict) -> dict[str, Interval]:
    if v.accuracy is None or v.axes is None:
        return {}
    rows = zip(v.axes.names, v.accuracy.coverage_one_step, v.accuracy.coverage_interval, strict=True)
    return {axis: (100.0 * float(share), 100.0 * float(low), 100.0 * float(high)) for axis, share, (low, high) in rows}


def _ratio_window(intervals: list[Interval]) -> tuple[float, float]:
    values = [value for value, _, _ in intervals] + [1.0]
    ends = [end for interval in intervals for end in interval if np.isfinite(end) and end > 0] + [1.0]
    return max(min(ends), min(values) / FAR) / 1.3, min(max(ends), max(values) * FAR) * 1.3


def _bias_window(intervals: list[Interval]) -> tuple[float, float]:
    most = 3.0 * max(abs(value) for value, _, _ in intervals) + 3.0
    ends = [float(np.clip(end, -most, most)) for interval in intervals for end in interval if np.isfinite(end)]
    room = 0.06 * (max([*ends, 0.0]) - min([*ends, 0.0])) or 1.0
    return min([*ends, 0.0]) - room, max([*ends, 0.0]) + room


def _coverage_window(intervals: list[Interval]) -> tuple[float, float]:
    return max(min(low for _, low, _ in intervals) - 5.0, -3.0), 103.0


def figures(by_axis: ByAxis) -> tuple[Figure, ...]:
    """A panel for each quantity; on paper the rows of all panels stand in one line."""
    study = by_axis.study
    panels = tuple(_panel(study, forest, forest.labels) for forest in by_axis.forests)
    aligned = tuple(_panel(study, forest, by_axis.labels, "axis of the pose") for forest in by_axis.forests)
    marked = tuple(replace(key, look=solid(key.look)) for key in study.keys(marked=True))
    sheet = Sheet(aligned, 0.55 + len(by_axis.labels) * (0.12 + 0.08 * len(study.tracks)), keys=marked)
    keys = (Key("expected", EXPECTED), *study.keys())
    return (Figure("By axis", caption(by_axis), panels, (sheet,), keys, layout="three", level=4),)


def _panel(study: Judged, forest: Forest, labels: tuple[str, ...], share: str = "") -> Panel:
    marks = [
        mark
        for slot, track in enumerate(study.tracks)
        if (mark := _intervals(forest, labels, track, slot, len(study.tracks))) is not None
    ]
    return Panel(
        Axis(forest.label, log=forest.log, window=forest.window),
        Axis("", rows=labels, share=share),
        (Rule("x", forest.expected, EXPECTED), *marks),
        f"{forest.label} of {study.name} by axis",
        height=70 + len(labels) * (14 + 13 * len(study.tracks)),
    )


def _intervals(forest: Forest, labels: tuple[str, ...], track: Estimator, slot: int, slots: int) -> Intervals | None:
    """Intervals of the filter in one slot of each row."""
    named_intervals = [(label, interval) for label, row in forest.rows if (interval := row[slot]) is not None]
    if not named_intervals:
        return None
    value, low, high = np.array([interval for _, interval in named_intervals]).T
    y: Array = np.array([labels.index(label) for label, _ in named_intervals]) + dodge(slot, slots)
    text = [f"{v:{forest.form}} [{a:{forest.form}}, {b:{forest.form}}]" for _, (v, a, b) in named_intervals]
    tips = (("axis", "@axis"), (forest.label, "@text"))
    look = replace(track.look, size=5.0, width=1.3)
    columns = {"axis": [label for label, _ in named_intervals], "text": text}
    return Intervals(y, value, low, high, look, track.owner, tips, columns)


def caption(by_axis: ByAxis) -> str:
    """What the panels show."""
    parts, tracks = {forest.name for forest in by_axis.forests}, by_axis.study.tracks
    text = "By axis of the pose. Covariance ratio: 1 is right (line), above is overconfident; log axis."
    if any(t.verdict.location is not None and t.verdict.location.since is not None for t in tracks):
        text += " Ratio and bias are those since the step that the verdict names."
    if any(track.verdict.axes is not None and track.verdict.axes.largest is not None for track in tracks):
        text += f" {DIRECTION.capitalize()}: chosen by one half of the runs and measured in the other."
    if "bias" in parts:
        text += " Bias: mean error in units of the stated sigma; 0 is right."
    if "coverage" in parts:
        text += " Coverage: share of runs within 2 sigma, in one step of each; 95.4 % is right."
    return (
        f"{text} Bars: 95 % intervals, of ratio and bias for all axes at once, of coverage exact for each axis; an "
        "arrow goes on beyond the drawn range. The questions decide, not the bars."
    )


SECTION = Section(STUDY, read, figures)
