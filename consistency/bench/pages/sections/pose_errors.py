"""Error of the pose in one run with the filter's own bounds, as Herath et al. (2007) fig. 2b."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from consistency.bench.pages.sections.report_input import Study, Track
from consistency.referee.document.blocks import Figure
from consistency.referee.document.colours import SIGMAS, ZERO, solid
from consistency.referee.show.painting import canvas, curve, edges, say, stroke
from consistency.referee.types import Array

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Drawing

COMPONENTS = ("x error (m)", "y error (m)", "heading error\n(deg)")
DEGREES = np.array([1.0, 1.0, 180.0 / np.pi])


@dataclass(frozen=True)
class PoseError:
    """One filter; T steps, NaN where it had no estimate."""

    track: Track
    error: Array  # (T, 3), m, m, deg, truth minus estimate
    sigma: Array  # (T, 3), m, m, deg, stated standard deviation


def pose_errors(study: Study) -> tuple[Figure, ...]:
    """A row of x, y and heading for each filter; nothing where the truth is not known."""
    filters = [of for track in study.tracks if (of := pose_error_series(track)) is not None]
    if not study.has_truth or not filters:
        return ()
    drawings = tuple(partial(_draw, study, of) for of in filters)
    return (Figure(f"Pose errors, run {study.shown_run}", errors_caption(study), drawings),)


def _draw(study: Study, of: PoseError) -> Drawing:
    figure, panels = canvas(1.35, 3, 3)
    bounds, look = SIGMAS * of.sigma, replace(solid(of.track.look), width=1.0)
    for axes, error, bound, label in zip(panels, of.error.T, bounds.T, COMPONENTS, strict=True):
        axes.axhline(0.0, **stroke(ZERO))
        ends = np.column_stack([-bound, bound])
        edges(axes, study.clock.values, ends, replace(look, dash=(3.0, 2.0), width=0.8), tag=of.track.tag)
        curve(axes, study.clock.values, error, look, "", of.track.tag)
        axes.set_ylabel(label)
        study.clock.span(axes)
    panels[0].set_title(of.track.name)
    if not np.isfinite(of.error).any():
        say(panels[1], "no estimate in this run")
    return figure


def pose_error_series(track: Track) -> PoseError | None:
    """Errors of the shown run; None where they are not known."""
    run = track.shown.in_world
    if run.error is None or run.covariance is None:
        return None
    if not len(run.error):
        empty = np.full((len(run.t), 3), np.nan)
        return PoseError(track, empty, empty)
    variance = np.diagonal(run.covariance[0], axis1=-2, axis2=-1)
    return PoseError(track, DEGREES * run.error[0], DEGREES * np.sqrt(np.maximum(variance, 0.0)))


def errors_caption(study: Study) -> str:
    """What the figure shows."""
    return (
        f"Pose error (truth minus estimate) of run {study.shown_run}, the lowest run number, with the filter's "
        "own 2-sigma bounds (dashed). An honest filter's error stays inside about 95 % of the time."
    )
