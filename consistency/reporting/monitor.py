"""The figure of a monitor: the NIS of a run and the evidence against it."""

from __future__ import annotations

import warnings
from io import BytesIO
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

from consistency.reporting import plots
from consistency.reporting.figures import RC, WIDTH
from consistency.reporting.thin import thin
from consistency.types import Array
from consistency.verdicts.monitoring import Watched

HEIGHT = 3.6  # inches
POINTS = 600  # at most, of the NIS: few enough to see a change among them
NO_DATE: dict[str, Any] = {"png": {"Software": None}, "pdf": {"CreationDate": None}, "svg": {"Date": None}}


def monitor_plot(watched: Watched, kind: str, resolution: int = 200) -> bytes:
    """NIS / dof above, the e-value below, over the steps of the file; ``kind`` is png, pdf or svg."""
    with mpl.rc_context(RC):
        figure = Figure(figsize=(WIDTH, HEIGHT), layout="constrained")
        upper, lower = figure.subplots(2, 1, sharex=True)
        step, ratio, together = averaged(watched.step, watched.nis_over_dof)
        plots.nis(upper, step, ratio, plots.style(0), log=bool((ratio > 0).any()))
        upper.set(xlabel="", ylabel="NIS / dof" if together == 1 else f"NIS / dof\n(mean of {together})")
        plots.title(upper, watched.name)
        rows, alarm = thin(watched.evidence), watched.alarm
        span = None if alarm is None else (float(alarm.since), float(alarm.step))
        plots.evidence(lower, watched.step[rows], watched.evidence[rows], watched.monitor.threshold, span)
        buffer = BytesIO()
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", message="Glyph .* missing from font")  # of a name; drawn as boxes
            figure.savefig(buffer, format=kind, dpi=resolution, metadata=NO_DATE[kind])
        return buffer.getvalue()


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
