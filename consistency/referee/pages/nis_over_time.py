"""Figures of a monitor: the NIS of a run and the evidence against it, or the test ratios of a gate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from consistency.referee.diagnostics.monitoring.gate_ratios import GateRatios
from consistency.referee.document.colours import EXPECTED, LIMIT, style
from consistency.referee.show.matplotlib_style import canvas, curve, log_axis, points, stroke
from consistency.referee.types import Array
from consistency.referee.verdicts.monitor_sources import Watched

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Drawing

HEIGHT = 3.6  # inches
LONG = 2000  # test ratios drawn of a sensor
POINTS = 600  # at most, of the NIS: few enough to see a change among them
EACH_STEP = replace(style(0), size=1.8, alpha=0.7)
FAULT = replace(style(1), dash=(), width=1.1)


def monitor_drawing(shown: Watched | Sequence[GateRatios]) -> Drawing:
    """NIS / dof above, the e-value below, over time, or the steps of a file without; or test ratios of each sensor."""
    if isinstance(shown, Watched):
        figure, (above, below) = canvas(HEIGHT, panels=2, sharex=True)
        _draw_sizes(above, shown)
        _draw_evidence(below, shown)
        return figure
    figure, panels = canvas(HEIGHT * len(shown) / 2.0, panels=len(shown), sharex=True)
    for axes, each in zip(panels, shown, strict=True):
        _draw_ratios(axes, each)
    panels[-1].set_xlabel("t / s")
    return figure


def _draw_ratios(axes: Axes, each: GateRatios) -> None:
    """Test ratios of a sensor over time, the gate, and what a right filter rarely exceeds."""
    points(axes, each.t, each.ratio, EACH_STEP, limit=LONG)
    for at, look in ((1.0, LIMIT), (each.unusual, EXPECTED)):
        if np.isfinite(at):
            axes.axhline(at, **stroke(look))
    axes.set(ylabel="test ratio", title=each.sensor)


def _draw_sizes(axes: Axes, watched: Watched) -> None:
    """NIS over its degrees of freedom."""
    step, ratio, together = averaged(_clock(watched)[0], watched.nis_over_dof)
    points(axes, step, ratio, EACH_STEP, limit=POINTS)
    axes.axhline(1.0, **stroke(EXPECTED))
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
            since, raised = watched.since_t, watched.alarm_t
        axes.axvspan(since, raised, color=FAULT.colour, alpha=0.15, linewidth=0)
        axes.axvline(raised, **stroke(FAULT))
    axes.axhline(threshold, **stroke(LIMIT))
    curve(axes, clock, watched.evidence, style(0))
    axes.set(xlabel=label, ylabel="e-value")
    log_axis(axes, "y")
    axes.set_ylim(top=min(axes.get_ylim()[1], threshold**2))


def _clock(watched: Watched) -> tuple[Array, str]:
    """Times of the steps, s, or their numbers where some have none; and what they are."""
    if len(watched.t) and np.isfinite(watched.t).all():
        return watched.t, "t / s"
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
