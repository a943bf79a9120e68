"""Pictures of a noise model and of a correction, which draw them where they are asked for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import stats

from consistency.referee.defaults import CONFIDENCE, DETECT
from consistency.referee.fit_covariance.covariance_ratios import JudgedSpan
from consistency.referee.fit_covariance.drives import mean_square, span_of
from consistency.referee.fit_covariance.estimation import nees_of
from consistency.referee.pages.record_figures import ellipse
from consistency.referee.show.blocks import BAND, EXPECTED, LIMIT, ZERO, solid, style
from consistency.referee.show.figures import (
    add_legend,
    canvas,
    curve,
    dots,
    intervals,
    log_axis,
    name_rows,
    path,
    points,
    stroke,
)
from consistency.referee.types import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Drawing

SHOWN = 3  # spans with a panel of errors
MOST_ROWS = 16  # runs that have a row
ROW = 0.14  # in, height of one
MANY = 2000  # errors of motions that are drawn
EACH = replace(style(0), size=2.0, alpha=0.7)


def draw_noise(model: Any) -> Drawing:
    """Errors of the first spans of a noise model, a panel each, and below them growth and drives."""
    spans = model.spans[:SHOWN]
    axes = range(len(model.noise.axes))
    d = model.windows.d
    figure, panels = canvas(4.0, 3, len(spans) + 3)
    for panel, judged in zip(panels, spans, strict=False):
        _draw_errors(panel, model, judged)
    growth, turns, drives = panels[-3:]
    _draw_growth(growth, model, axes[:d], "m²")
    _draw_growth(turns, model, axes[d:], "rad²")
    ratios = model.spans[0].by_drive[:, 0]
    known = np.flatnonzero(np.isfinite(ratios))
    draw_ratios(drives, [model.drives[i].name for i in known], ratios[known])
    drives.axvline(model.ratio.value, **stroke(LIMIT))
    most = 1.1 * float(ratios[known].max())
    drives.set(title=f"ratios over {span_of(model.span).text}", xlim=(0.0, max(2.0, most)))
    return add_legend(figure)


def _draw_errors(axes: Axes, model: Any, judged: JudgedSpan) -> None:
    windows = model.error_windows(judged)
    error = windows.errors[:, :2]
    C = model.noise.covariance(windows.pieces)[:, :2, :2]
    inside = float((nees_of(error, C) < stats.chi2.ppf(CONFIDENCE, 2)).mean())
    axes.axvline(0.0, **stroke(ZERO))
    axes.axhline(0.0, **stroke(ZERO))
    points(axes, error[:, 0], error[:, 1], EACH, limit=MANY)
    path(axes, ellipse(np.zeros(2), C.mean(axis=0)), solid(style(1)), "95 % ellipse")
    title = f"{span_of(judged.span).text}: {100 * inside:.0f} % of {len(error)} inside"
    axes.set(xlabel="error in x (m)", ylabel="error in y (m)", title=title)


def _draw_growth(
    panel: Axes,
    model: Any,
    axes: Sequence[int],
    unit: str,
) -> None:
    found = [model.error_windows(judged) for judged in model.spans]
    spans = np.array([windows.span.size for windows in found])
    squares = np.array([mean_square(windows.errors) for windows in found])
    stated = np.array([model.noise.variances(windows.pieces).mean(axis=0) for windows in found])
    for number, axis in enumerate(axes):
        curve(panel, spans, stated[:, axis], solid(style(number)))
        panel.plot(spans, squares[:, axis], label=model.noise.axes[axis], **dots(style(number)))
    unit_of_span = {"step": "steps"}.get(found[0].span.unit, found[0].span.unit)
    panel.set(xlabel=f"span ({unit_of_span})", ylabel=f"mean squared error ({unit})")
    log_axis(panel, "x")
    log_axis(panel, "y")


def draw_ratios(axes: Axes, names: Sequence[str], *ratios: Array) -> None:
    """Ratios of true to stated covariance, a row for each name, beside those that count as consistent."""
    name_rows(axes, names)
    axes.axvspan(1.0 / DETECT, DETECT, color=BAND, linewidth=0, zorder=0.4, label="consistent if shown inside")
    axes.axvline(1.0, **stroke(EXPECTED))
    for number, values in enumerate(ratios):
        axes.plot(values, np.arange(len(values)), **dots(style(number)))
    axes.set_xlabel("true / stated")


def draw_correction(found: Any) -> Drawing:
    """Ratios of held-out runs, factors, and coverage of a correction."""
    judged = len(found.judged)
    rows = np.linspace(0, judged - 1, min(MOST_ROWS, judged)).round().astype(int)
    figure, (runs, factors, coverage) = canvas(max(2.4, ROW * len(rows)), 3, 3)
    ratios = found.before.ratios, found.after.ratios
    draw_ratios(runs, np.array(found.judged)[rows], *(each[rows] for each in ratios))
    log_axis(runs, "x")
    _draw_factors(factors, found)
    levels = np.linspace(0.01, 0.99, 50)
    coverage.plot([0.0, 1.0], [0.0, 1.0], **stroke(EXPECTED))
    curve(coverage, levels, found.before.covered(levels), solid(style(0)), "stated")
    curve(coverage, levels, found.after.covered(levels), solid(style(1)), "corrected")
    coverage.set(xlabel="probability of the ellipsoid", ylabel="share of errors inside")
    return add_legend(figure)


def _draw_factors(axes: Axes, found: Any) -> None:
    """The factor of each block with its interval, a row for each."""
    names = [f"{group} {block.name}".strip() for group in found.shown for block in found.blocks]
    values = np.array([factor for fit in found.shown.values() for factor in fit.factor])
    high = values[:, 2].max()
    low = max(values[:, 1].min(), 1e-3 * high)  # a factor may be 0
    name_rows(axes, names)
    axes.axvline(1.0, **stroke(EXPECTED))
    axes.set_xlim(min(0.7, 0.8 * low), max(1.4, 1.25 * high))
    intervals(axes, np.arange(len(names), dtype=float), values, style(1))
    log_axis(axes, "x")
    axes.set(xlabel="factor on variances")
