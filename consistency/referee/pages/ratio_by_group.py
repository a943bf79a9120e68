"""Covariance ratio by groups of runs and steps."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from consistency.referee.diagnostics.verdict.parts import SIDES, ByGroup, Group
from consistency.referee.diagnostics.verdict.verdict import Verdict
from consistency.referee.document.blocks import Figure
from consistency.referee.document.colours import ACCEPTED, BAND, EXPECTED, REJECTED, Look
from consistency.referee.pages.ratio_by_axis import ratio_window
from consistency.referee.show.matplotlib_style import add_legend, canvas, intervals, log_axis, name_rows, stroke

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Drawing

OPEN = Look("#7f7f7f")


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

    return (Figure(f"By {first.column}", _caption(of_parts), (draw,)),)


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
    look = OPEN
    if status in SIDES:
        look = REJECTED
    elif status == "consistent":
        look = ACCEPTED
    return replace(look, size=3.2, width=1.1)


def _caption(of_parts: Mapping[str, ByGroup]) -> str:
    """What the rows show, and what they do not."""
    first = next(iter(of_parts.values()))
    text = (
        f"Ratio of true to stated covariance in each group by {first.column}: 1 is right (line), above is "
        "overconfident; log axis. Bars: 95 % intervals for all groups at once, from the run means of their steps. "
    )
    if first.outcome:
        return f"{text}{first.column} {first.outcome}, which selects on the outcome: groups show, they do not convict."
    return f"{text}The questions decide, not the bars."
