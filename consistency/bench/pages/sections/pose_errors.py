"""Error of the pose in one run with the filter's own bounds, as Herath et al. (2007) fig. 2b."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from consistency.bench.pages.report_input import Study, Track
from consistency.referee.document.colours import SIGMAS, ZERO, Look, solid
from consistency.referee.document.drawing import Axis, Figure, Key, Line, Panel, Rule, Sheet
from consistency.referee.pages.section import STUDY, Section
from consistency.referee.types import Array

COMPONENTS = (("x", "m"), ("y", "m"), ("heading", "deg"))
DEGREES = np.array([1.0, 1.0, 180.0 / np.pi])
BOUND = Key("2-sigma bounds, thin, in the filter's colour", Look("#333333", (3.0, 2.0), width=0.8))


@dataclass(frozen=True)
class PoseError:
    """One filter; T steps, NaN where it had no estimate."""

    track: Track
    error: Array  # (T, 3), m, m, deg, truth minus estimate
    sigma: Array  # (T, 3), m, m, deg, stated standard deviation


@dataclass(frozen=True)
class PoseErrors:
    """All filters in the shown run."""

    study: Study
    filters: tuple[PoseError, ...]


def read(study: Study) -> PoseErrors | None:
    """Errors of the shown run; None where the truth is not known."""
    if not study.has_truth:
        return None
    by_track = (_pose_error(track) for track in study.tracks)
    return PoseErrors(study, tuple(of for of in by_track if of is not None))


def _pose_error(track: Track) -> PoseError | None:
    run = track.shown.in_world
    if run.error is None or run.covariance is None:
        return None
    if not len(run.error):
        empty = np.full((len(run.t), 3), np.nan)
        return PoseError(track, empty, empty)
    variance = np.diagonal(run.covariance[0], axis1=-2, axis2=-1)
    return PoseError(track, DEGREES * run.error[0], DEGREES * np.sqrt(np.maximum(variance, 0.0)))


def figures(errors: PoseErrors) -> tuple[Figure, ...]:
    """On a screen x, y and heading with all filters, on paper a row for each filter."""
    study = errors.study
    panels = tuple(_panel(study, errors.filters, component) for component in range(3))
    sheets = tuple(_sheet(study, of) for of in errors.filters)
    title = f"Pose errors, run {study.shown_run}"
    return (Figure(title, caption(errors), panels, sheets, (BOUND, *study.keys()), stacked=True),)


def _panel(study: Study, filters: tuple[PoseError, ...], component: int, alone: bool = False) -> Panel:
    name, unit = COMPONENTS[component]
    y = Axis(f"{name} error ({unit})", f"{name} error\n({unit})")
    marks = (_line(study, of, component, alone) for of in filters)
    alt = f"{name} error of {study.name} over time with 2-sigma bounds"
    return Panel(study.clock.whole, y, (*marks, Rule("y", 0.0, ZERO)), alt, height=240)


def _line(study: Study, of: PoseError, component: int, alone: bool) -> Line:
    unit = COMPONENTS[component][1]
    tips = (*study.clock.tips, ("error", f"@y{{0.0000}} {unit}"), ("2 sigma", f"@bound{{0.0000}} {unit}"))
    look = replace(solid(of.track.look) if alone else of.track.look, width=1.0)
    bound = SIGMAS * of.sigma[:, component]
    return Line(
        study.clock.values, of.error[:, component], look, of.track.owner, tips, {"step": study.steps}, bound=bound
    )


def _sheet(study: Study, of: PoseError) -> Sheet:
    panels = [_panel(study, (of,), component, alone=True) for component in range(3)]
    panels[1] = replace(panels[1], empty="no estimate in this run")
    return Sheet(tuple(panels), 1.4, title=of.track.name)


def caption(errors: PoseErrors) -> str:
    return (
        f"Pose error (truth minus estimate) of run {errors.study.shown_run}, the lowest run number, with the filter's "
        "own 2-sigma bounds (dashed). An honest filter's error stays inside about 95 % of the time."
    )


SECTION = Section(STUDY, read, figures)
