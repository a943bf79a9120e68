"""Distribution of the NEES in one step of each run."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from consistency.referee.pages.verdicts import Estimator, Judged
from consistency.referee.show.blocks import EXPECTED, Figure, solid
from consistency.referee.show.figures import WIDTH, add_legend, band, canvas, curve, stroke
from consistency.referee.types import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Drawing

PANELS = 4  # small ones beside each other
WINDOW = (-0.02, 1.02)


@dataclass(frozen=True)
class Steps:
    """Empirical distribution function of chi-square's distribution function at N values of the NEES."""

    track: Estimator
    x: Array  # (N + 2,), with 0 and 1
    y: Array  # (N + 2,)
    half_width: float  # of the simultaneous band


def steps(track: Estimator) -> Steps | None:
    """Distribution of one filter; None without NEES."""
    tails = track.verdict.tails
    if tails is None or not len(tails.pit) or not np.isfinite(tails.half_width):
        return None
    height = np.arange(1, len(tails.pit) + 1) / len(tails.pit)
    x, y = (np.concatenate([[0.0], column, [1.0]]) for column in (tails.pit, height))
    return Steps(track, x, y, tails.half_width)


def nees_distribution(study: Judged) -> tuple[Figure, ...]:
    """A small panel for each filter that has a NEES."""
    filters = [of for track in study.tracks if (of := steps(track)) is not None]
    if not filters:
        return ()

    def draw() -> Drawing:
        rows, columns = -(-len(filters) // PANELS), min(len(filters), PANELS)
        # panels that are nearly square
        figure, panels = canvas(1.45 * rows, columns, len(filters), width=WIDTH * columns / PANELS + 0.2, sharey=True)
        for axes, of in zip(panels, filters, strict=True):
            _draw_steps(axes, of)
        for axes in panels[::PANELS]:
            axes.set_ylabel("share of runs")
        return add_legend(figure)

    return (Figure("Distribution of the NEES", CAPTION, (draw,), level=4),)


def _draw_steps(axes: Axes, of: Steps) -> None:
    corners = np.unique([0.0, of.half_width, 1.0 - of.half_width, 1.0])
    ends = np.clip(corners[:, None] + [-of.half_width, of.half_width], 0.0, 1.0)
    band(axes, corners, ends, "95 % band of the whole curve")
    axes.plot([0.0, 1.0], [0.0, 1.0], **stroke(EXPECTED), label="expected")
    look = replace(solid(of.track.look), width=1.3)
    curve(axes, of.x, of.y, look, "", of.track.tag, drawstyle="steps-post")
    ticks = (0.0, 0.5, 1.0)
    axes.set(xlabel="chi-square cdf", title=of.track.name, xlim=WINDOW, ylim=WINDOW, xticks=ticks, yticks=ticks)


CAPTION = (
    "Chi-square probability of the NEES in one step of each run, with nothing fitted. "
    "On the diagonal the covariance is right; a curve below it has too many large values (overconfident), above it "
    "too many small ones. Shaded: where the whole curve of a right filter lies with probability 95 %."
)
