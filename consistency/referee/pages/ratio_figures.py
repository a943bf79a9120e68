"""Ratios as figures: of the axes of the pose, of groups of runs and steps, and of a monitor over time.

Beside the covariance ratio of an axis stand its bias and its coverage; a monitor's ratios are NIS over their degrees of
freedom, or the test ratios of a sensor.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from consistency.referee.diagnostics.monitor import GateRatios
from consistency.referee.diagnostics.nees import TWO_SIGMA
from consistency.referee.diagnostics.number_words import UNCERTAIN
from consistency.referee.diagnostics.verdict import Verdict
from consistency.referee.diagnostics.verdict_parts import SIDES, ByGroup, Group
from consistency.referee.pages.verdicts import Judged
from consistency.referee.show.blocks import (
    ACCEPTED,
    BAND,
    EXPECTED,
    LIMIT,
    LOW,
    OVER,
    REJECTED,
    Block,
    Cell,
    Column,
    Details,
    Figure,
    Look,
    Quantity,
    solid,
    style,
    table,
)
from consistency.referee.show.figures import (
    add_legend,
    canvas,
    curve,
    dodge,
    dots,
    intervals,
    log_axis,
    name_rows,
    points,
    stroke,
)
from consistency.referee.types import Array
from consistency.referee.verdicts.monitor_sources import Watched

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Drawing

Interval = tuple[float, float, float]  # value, low, high; the ends may be infinite
Row = tuple[str, tuple[Interval | None, ...]]  # an axis, and an interval or None for each filter

WHOLE, DIRECTION = "all axes", "worst direction"
FAR = 30.0  # an interval that reaches further than this factor beyond all values is cut off
HEIGHT = 3.6  # inches
FROM_START = "time from the start (s)"
LONG = 2000  # test ratios drawn of a sensor
POINTS = 600  # at most, of the NIS: few enough to see a change among them
EACH_STEP = replace(style(0), size=1.8, alpha=0.7)
FAULT = Look(OVER, width=1.1)


@dataclass(frozen=True)
class Forest:
    """One quantity of the axes, with intervals."""

    name: str
    label: str  # of the axis with its unit
    expected: float
    window: tuple[float, float]  # drawn range
    log: bool
    rows: tuple[Row, ...]


def by_axis(study: Judged) -> tuple[Block, ...]:
    """A panel for each quantity, in which each axis has a row, and the ratios in numbers; nothing if there are none."""
    found = forests(study)
    if not found:
        return ()
    labels = row_labels(found)

    def draw() -> Drawing:
        height = 0.5 + len(labels) * (0.13 + 0.07 * len(study.tracks))
        figure, panels = canvas(height, len(found), len(found))
        for axes, forest in zip(panels, found, strict=True):
            _draw_forest(axes, study, forest, labels)
        for axes in panels[1:]:
            axes.set_yticklabels([])
        return add_legend(figure)

    blocks: list[Block] = [Figure("By axis", axis_caption(study, found), (draw,), level=4)]
    if found[0].name == "ratio":
        columns = (Column("Axis"), *(Column(track.name, number=True) for track in study.tracks))
        rows: list[tuple[Cell, ...]] = [(name, *map(_quantity, intervals)) for name, intervals in found[0].rows]
        shown = table(columns, rows, f"Covariance ratio by axis of {study.name}")
        blocks.append(Details("Covariance ratio by axis, in numbers", (shown,)))
    return tuple(blocks)


def _quantity(interval: Interval | None) -> Quantity:
    if interval is None:
        return Quantity(None)
    value, low, high = interval
    return Quantity(value, (low, high), limit=UNCERTAIN, is_factor=True)


def row_labels(found: tuple[Forest, ...]) -> tuple[str, ...]:
    """Names of all rows, in one order, the whole last."""
    names = dict.fromkeys(name for forest in found for name, _ in forest.rows)
    return tuple(sorted(names, key=lambda name: name == WHOLE))


def _draw_forest(axes: Axes, study: Judged, forest: Forest, labels: tuple[str, ...]) -> None:
    """Intervals of all filters, one beside the other in the row of each axis."""
    axes.set(xlabel=forest.label, xlim=forest.window)
    name_rows(axes, labels)
    axes.axvline(forest.expected, **stroke(EXPECTED))
    slots = len(study.tracks)
    for slot, track in enumerate(study.tracks):
        rows = [(labels.index(label), own) for label, row in forest.rows if (own := row[slot]) is not None]
        if rows:
            places = np.array([place + dodge(slot, slots) for place, _ in rows])
            look = replace(solid(track.look), size=3.2, width=1.1)
            intervals(axes, places, np.array([own for _, own in rows]), look, track.name, track.tag)
    if forest.log:
        log_axis(axes, "x")


def forests(study: Judged) -> tuple[Forest, ...]:
    """Covariance ratio, bias and coverage by axis; those that no filter has are left out."""
    kinds = (
        ("ratio", "ratio (truth / stated)", 1.0, ratio_window, True, _ratios),
        ("bias", "mean error (stated sigma)", 0.0, _bias_window, False, _biases),
        ("coverage", "within 2 sigma (%)", 100.0 * TWO_SIGMA, _coverage_window, False, _coverages),
    )
    result = []
    for name, label, expected, window, log, intervals_of in kinds:
        known: list[Interval] = []
        rows: dict[str, list[Interval | None]] = {}
        for number, track in enumerate(study.tracks):
            for axis, interval in intervals_of(track.verdict).items():
                if np.isfinite(interval[0]):
                    known.append(interval)
                    rows.setdefault(axis, [None] * len(study.tracks))[number] = interval
        if rows:
            of_axes = tuple((axis, tuple(row)) for axis, row in rows.items())
            result.append(Forest(name, label, expected, window(known), log, of_axes))
    return tuple(result)


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


def ratio_window(intervals: list[Interval]) -> tuple[float, float]:
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


def axis_caption(study: Judged, found: tuple[Forest, ...]) -> str:
    """What the panels show."""
    parts, tracks = {forest.name for forest in found}, study.tracks
    text = "Covariance ratio: 1 is right (line), above is overconfident; log axis."
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
        "arrow continues beyond the drawn range. The questions decide, not the bars."
    )


OPEN, STATED = Look("#7f7f7f"), Look("#333333", marker="D", size=4.0)


def ratio_by_group_figure(verdict: Verdict) -> tuple[Figure, ...]:
    """A row for each group with its ratio and interval, a panel for each part; nothing without groups."""
    of_parts = {name: part.by_group for name, part in verdict.parts.items() if part.by_group is not None}
    if verdict.by_group is not None:
        of_parts = {"": verdict.by_group}
    if not of_parts:
        return ()
    first, factor = next(iter(of_parts.values())), verdict.settings.factor
    labels = tuple(dict.fromkeys(group.name for by in of_parts.values() for group in by.groups))

    def draw() -> Drawing:
        figure, panels = canvas(0.5 + 0.2 * len(labels), len(of_parts), len(of_parts))
        for axes, (name, by) in zip(panels, of_parts.items(), strict=True):
            _draw_groups(axes, by, labels, factor)
            axes.set_title(name)
        for axes in panels[1:]:
            axes.set_yticklabels([])
        return add_legend(figure)

    caption = (
        f"Ratio of true to stated covariance in each group by {first.column}: 1 is right (line), above is "
        "overconfident; log axis. Bars: 95 % intervals for all groups at once, from the run means of their steps. "
    )
    if first.outcome:
        caption += f"{first.column} {first.outcome}, which selects on the outcome: groups show, they do not convict."
    else:
        caption += "The questions decide, not the bars."
    return (Figure(f"By {first.column}", caption, (draw,)),)


def _draw_groups(axes: Axes, by: ByGroup, labels: tuple[str, ...], factor: float) -> None:
    """Intervals of the groups, in a colour for each kind of verdict."""
    drawn = [group for group in by.groups if group.ratio.value > 0]
    axes.set(xlabel="covariance ratio (true / stated)", xlim=ratio_window([(*group.ratio,) for group in drawn]))
    name_rows(axes, labels)
    axes.axvspan(1.0 / factor, factor, color=BAND, linewidth=0, zorder=0.5, label="consistent if shown inside")
    axes.axvline(1.0, **stroke(EXPECTED))
    kinds: dict[str, list[Group]] = {}
    for group in drawn:
        kinds.setdefault(group.status or "not judged", []).append(group)
    for kind, groups in kinds.items():
        rows = np.array([float(labels.index(group.name)) for group in groups])
        intervals(axes, rows, np.array([tuple(group.ratio) for group in groups]), _look(kind), kind)
    log_axis(axes, "x")


def _look(status: str) -> Look:
    """At fault, shown to be right, or neither."""
    looks = {"consistent": ACCEPTED, "conservative": LOW} | {side: REJECTED for side in SIDES if side != "conservative"}
    return replace(looks.get(status, OPEN), size=3.2, width=1.1)


def bound_figures(verdict: Verdict) -> tuple[Figure, ...]:
    """A row for each bound and group: how often the error is outside, and the factor; nothing without bounds."""
    scores = verdict.bounds
    if not scores:
        return ()
    labels = tuple(score.name for score in scores)
    factor = next((score.equivalence.factor for score in scores), 1.0)

    def draw() -> Drawing:
        figure, (shares, factors) = canvas(0.5 + 0.2 * len(labels), 2, 2)
        most = 100.0 * max(
            max(s.rate, 1.0 - s.level, s.rate_limit if np.isfinite(s.rate_limit) else 0.0) for s in scores
        )
        shares.set(xlabel="steps outside the bound (%)", xlim=(0.0, 1.1 * most))
        factors.set(xlabel="factor by which the bound must grow", xlim=ratio_window([(*s.factor,) for s in scores]))
        factors.axvspan(1.0 / factor, factor, color=BAND, linewidth=0, zorder=0.5, label="consistent if shown inside")
        factors.axvline(1.0, **stroke(EXPECTED))
        for axes in (shares, factors):
            name_rows(axes, labels)
        expected = [100.0 * (1.0 - score.level) for score in scores]
        shares.plot(expected, range(len(scores)), label="stated by the level", **dots(STATED))
        for kind in dict.fromkeys(score.status or "not judged" for score in scores):
            rows = [row for row, score in enumerate(scores) if (score.status or "not judged") == kind]
            rates = [(100.0 * scores[row].rate,) * 2 + (100.0 * scores[row].rate_limit,) for row in rows]
            intervals(shares, np.array(rows, float), np.array(rates), _look(kind))
            intervals(
                factors, np.array(rows, float), np.array([(*scores[row].factor,) for row in rows]), _look(kind), kind
            )
        log_axis(factors, "x")
        factors.set_yticklabels([])
        return add_legend(figure)

    caption = (
        "Left: share of the steps in which the error is outside, up to which larger shares are not excluded at 95 %, "
        "beside the share that the level states. Right: factor by which the bound must grow for its level to hold, "
        "with its 95 % interval; 1 is right (line), above is overconfident; log axis."
    )
    return (Figure("Coverage of the bounds", caption, (draw,)),)


# --- a monitor -------------------------------------------------------------------------------------------


def monitor_drawing(shown: Watched | Sequence[GateRatios]) -> Drawing:
    """NIS / dof above, the e-value below, over time, or the steps of a file without; or test ratios of each sensor."""
    if isinstance(shown, Watched):
        figure, (above, below) = canvas(HEIGHT, panels=2, sharex=True)
        _draw_sizes(above, shown)
        _draw_evidence(below, shown)
        return add_legend(figure)
    figure, panels = canvas(HEIGHT * len(shown) / 2.0, panels=len(shown), sharex=True)
    start = min((float(each.t[0]) for each in shown if len(each.t)), default=0.0)
    for axes, each in zip(panels, shown, strict=True):
        points(axes, each.t - start, each.ratio, EACH_STEP, "test ratio", limit=LONG)
        for at, look, label in ((1.0, LIMIT, "gate"), (each.unusual, EXPECTED, "rarely exceeded by a right filter")):
            if np.isfinite(at):
                axes.axhline(at, **stroke(look), label=label)
        axes.set(ylabel="test ratio", title=each.sensor)
    panels[-1].set_xlabel(FROM_START)
    return add_legend(figure)


def _draw_sizes(axes: Axes, watched: Watched) -> None:
    """NIS over its degrees of freedom."""
    step, ratio, together = averaged(_clock(watched)[0], watched.nis_over_dof)
    points(axes, step, ratio, EACH_STEP, "NIS / dof", limit=POINTS)
    axes.axhline(1.0, **stroke(EXPECTED), label="expected")
    axes.set(ylabel="NIS / dof" if together == 1 else f"NIS / dof\n(mean of {together})", title=watched.name)
    if (ratio > 0).any():
        log_axis(axes, "y")


def _draw_evidence(axes: Axes, watched: Watched) -> None:
    """E-value after each step with the value at which an alarm is raised; since the fault it is shaded.

    What continues beyond the square of that value is cut off.
    """
    threshold, alarm = watched.monitor.threshold, watched.alarm
    clock, label = _clock(watched)
    if alarm is not None:
        since, raised = float(alarm.since), float(alarm.step)
        if label != "step":
            since, raised = watched.since_t - watched.t[0], watched.alarm_t - watched.t[0]
        axes.axvspan(since, raised, color=FAULT.colour, alpha=0.15, linewidth=0, label="since the fault")
        axes.axvline(raised, **stroke(FAULT), label="alarm")
    axes.axhline(threshold, **stroke(LIMIT), label="e-value of an alarm")
    evidence = np.minimum(watched.evidence, threshold**3)  # it may be near the largest number that there is
    curve(axes, clock, evidence, style(0), "e-value")
    axes.set(xlabel=label, ylabel="e-value")
    log_axis(axes, "y")
    low, high = evidence[evidence > 0.0].min(initial=1.0), evidence.max(initial=threshold)
    axes.set_ylim(low / 2.0, min(2.0 * high, threshold**2))


def _clock(watched: Watched) -> tuple[Array, str]:
    """Times of the steps from the first on, s, or their numbers where some have none; and what they are."""
    if len(watched.t) and np.isfinite(watched.t).all():
        return watched.t - watched.t[0], FROM_START
    return watched.step, "step"


def averaged(step: Array, ratio: Array) -> tuple[Array, Array, int]:
    """Steps and ratios (N,) averaged over as many neighbours as leave few enough points; how many those are."""
    known = np.isfinite(ratio)
    step, ratio = step[known], ratio[known]
    together = max(1, -(-len(ratio) // POINTS))
    starts = np.arange(0, len(ratio), together)
    if together == 1:
        return step, ratio, 1
    counts = np.diff(np.append(starts, len(ratio)))
    return np.add.reduceat(step, starts) / counts, np.add.reduceat(ratio, starts) / counts, together
