"""One run of each filter: the world from above with its path, and the error of its pose with the filter's own bounds.

As Herath et al. (2007) fig. 2a and 2b.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from consistency.bench.pages.sections.report_input import Study, Track
from consistency.bench.scenario.models import dead_reckoning
from consistency.bench.simulation import simulate
from consistency.referee.show.blocks import ODOMETRY, SIGMAS, TRUTH, ZERO, Figure, Look, solid
from consistency.referee.show.figures import add_legend, canvas, curve, dots, edges, make_map, path, say, stroke
from consistency.referee.types import Array, Indices

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Drawing

LANDMARK = Look("#8c8c8c", marker="*", size=4.0)
ALONE = Look(ODOMETRY, (6.0, 3.0), width=1.1)
TRUE = Look(TRUTH, width=1.6)
START = Look("#ffffff", size=8.0, edge=TRUTH)
COMPONENTS = ("x error (m)", "y error (m)", "heading error\n(deg)")
DEGREES = np.array([1.0, 1.0, 180.0 / np.pi])


@dataclass(frozen=True)
class DrawnWorld:
    """Paths of one run of T steps, in m."""

    study: Study
    paths: tuple[tuple[Track, Array], ...]  # (T, 2), NaN where there is no estimate
    truth: Array | None  # (T + 1, 2)
    odometry: Array | None  # (T + 1, 2)
    landmarks: Array | None  # (N, 2)


def world_of(study: Study) -> DrawnWorld:
    """What the results hold of the shown run."""
    paths = []
    for track in study.tracks:
        path = np.full((len(study.steps), 2), np.nan)
        step, values = _of_shown_run(study, "estimates", track.name)
        path[step - 1] = values
        paths.append((track, path))
    step, values = _of_shown_run(study, "truth")
    truth = values[np.argsort(step, kind="stable")] if len(values) else None
    landmarks = study.results.landmarks
    places = None if landmarks is None else landmarks[["x", "y"]].to_numpy(float)
    scenario, seed = study.results.scenario, study.results.manifest.get("seed")
    odometry = None  # results keep no controls, but a simulated trial can be drawn again
    if scenario is not None and seed is not None:
        trial = simulate(scenario, study.shown_run, int(seed))
        odometry = dead_reckoning(trial.start, trial.controls)[:, :2]
    return DrawnWorld(study, tuple(paths), truth, odometry, places)


def _of_shown_run(study: Study, table: str, filter_name: str | None = None) -> tuple[Indices, Array]:
    """Steps (N,) and positions (N, 2), m."""
    rows = [np.zeros((0, 3))]
    for batch in study.results.batches(table, ["run", "step", "x", "y"], filter_name):
        rows.append(np.stack([batch["step"], batch["x"], batch["y"]], axis=-1)[batch["run"] == study.shown_run])
    found = np.concatenate(rows)
    return found[:, 0].astype(np.int64), found[:, 1:]


def world_map(study: Study) -> tuple[Figure, ...]:
    """Landmarks, and the paths of truth, odometry and filters."""
    world = world_of(study)

    def draw() -> Drawing:
        figure, (axes,) = canvas(2.9)
        if world.landmarks is not None:
            axes.plot(*world.landmarks.T, label="landmark", **dots(LANDMARK))
        if world.odometry is not None:
            path(axes, world.odometry, ALONE, "odometry alone")
        if world.truth is not None:
            path(axes, world.truth, TRUE, "true path")
        for track, estimates in world.paths:
            path(axes, estimates, track.look, track.name, track.tag)
        if world.truth is not None:
            axes.plot(*world.truth[:1].T, label="start", **dots(START))
        axes.set(xlabel="x (m)", ylabel="y (m)")
        make_map(axes)
        return add_legend(figure, beside=True)

    return (Figure(f"Scenario and estimates, run {study.shown_run}", map_caption(world), (draw,)),)


def map_caption(world: DrawnWorld) -> str:
    parts = []
    if world.truth is not None:
        parts.append("true path solid with its start as a circle")
    if world.odometry is not None:
        parts.append("path by odometry alone dashed grey")
    if world.landmarks is not None:
        parts.append(f"{len(world.landmarks)} landmarks as stars")
    parts.append("estimates in the filters' colours")
    note = "" if world.odometry is not None else " The odometry path is left out: results of a log hold no controls."
    return f"{world.study.name} from above, run {world.study.shown_run}: {', '.join(parts)}.{note}"


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
    drawings = tuple(partial(_draw_errors, study, of) for of in filters)
    return (Figure(f"Pose errors, run {study.shown_run}", errors_caption(study), drawings),)


def _draw_errors(study: Study, of: PoseError) -> Drawing:
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
    if run.errors.error is None or run.errors.covariance is None:
        return None
    if not len(run.errors.error):
        empty = np.full((len(run.runs.t), 3), np.nan)
        return PoseError(track, empty, empty)
    variance = np.diagonal(run.errors.covariance[0], axis1=-2, axis2=-1)
    return PoseError(track, DEGREES * run.errors.error[0], DEGREES * np.sqrt(np.maximum(variance, 0.0)))


def errors_caption(study: Study) -> str:
    """What the figure shows."""
    return (
        f"Pose error (truth minus estimate) of run {study.shown_run}, the lowest run number, with the filter's "
        "own 2-sigma bounds (dashed). An honest filter's error stays inside about 95 % of the time."
    )
