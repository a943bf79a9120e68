"""Figures of a monitor: the NIS of a run and the evidence against it, or the test ratios of a gate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from consistency.referee.diagnostics.monitoring.gate_ratios import GateRatios
from consistency.referee.document.colours import EXPECTED, LIMIT, style
from consistency.referee.document.drawing import Axis, Line, Mark, Panel, Points, Rule, Sheet, Span, thin
from consistency.referee.show import with_matplotlib
from consistency.referee.types import Array
from consistency.referee.verdicts.monitor_sources import Watched

HEIGHT = 3.6  # inches
POINTS = 600  # at most, of the NIS: few enough to see a change among them
FAULT = replace(style(1), dash=(), width=1.1)


def monitor_plot(shown: Watched | Sequence[GateRatios], kind: str) -> bytes:
    """NIS / dof above, the e-value below, over the steps of the file, or test ratios; ``kind`` is png, pdf or svg."""
    if isinstance(shown, Watched):
        return with_matplotlib.render(sheet(shown), kind)
    return with_matplotlib.render(Sheet(tuple(map(_ratios, shown)), HEIGHT * len(shown) / 2.0, columns=1), kind)


def _ratios(each: GateRatios) -> Panel:
    """Test ratios of a sensor over time, the gate, and what a right filter seldom exceeds."""
    keep = thin(each.ratio)
    marks: list[Mark] = [Points(each.t[keep], each.ratio[keep], replace(style(0), size=2.0, alpha=0.7))]
    marks += [Rule("y", at, look) for at, look in ((1.0, LIMIT), (each.unusual, EXPECTED)) if np.isfinite(at)]
    alt = f"Test ratios of {each.sensor} over time"
    return Panel(Axis("t / s", share="t"), Axis("test ratio"), tuple(marks), alt, title=each.sensor)


def sheet(watched: Watched) -> Sheet:
    """One panel above the other, over the same steps."""
    return Sheet((_sizes(watched), _evidence(watched)), HEIGHT, columns=1)


def _sizes(watched: Watched) -> Panel:
    step, ratio, together = averaged(watched.step, watched.nis_over_dof)
    label = "NIS / dof" if together == 1 else f"NIS / dof\n(mean of {together})"
    points = Points(step, ratio, replace(style(0), size=2.0, alpha=0.7))
    return Panel(
        Axis("step", share="step"), Axis(label, log=bool((ratio > 0).any())), (points, Rule("y", 1.0, EXPECTED)),
        f"NIS over degrees of freedom of {watched.name} over steps", title=watched.name,
    )  # fmt: skip


def _evidence(watched: Watched) -> Panel:
    """E-value after each step with the value at which an alarm is raised; since the fault it is shaded.

    What goes on beyond the square of that value is cut off.
    """
    threshold, alarm = watched.monitor.threshold, watched.alarm
    marks: list[Mark] = []
    if alarm is not None:
        marks.append(Span("x", float(alarm.since), float(alarm.step), replace(FAULT, alpha=0.15)))
        marks.append(Rule("x", float(alarm.step), FAULT))
    marks += [Rule("y", threshold, LIMIT), Line(watched.step, watched.evidence, style(0))]
    return Panel(
        Axis("step", share="step"), Axis("e-value", log=True, most=threshold**2), tuple(marks),
        f"E-value of {watched.name} over steps",
    )  # fmt: skip


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
