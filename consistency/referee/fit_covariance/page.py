"""Pages of a fitted noise model and of a correction, with their pictures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
from scipy import stats

from consistency.referee.defaults import CONFIDENCE, DETECT
from consistency.referee.document.blocks import Chapter, Document, Figure, Text
from consistency.referee.document.colours import BAND, EXPECTED, LIMIT, ZERO, solid, style
from consistency.referee.fit_covariance.correct import Correction
from consistency.referee.fit_covariance.correction_text import correction_document
from consistency.referee.fit_covariance.covariance_ratios import JudgedSpan
from consistency.referee.fit_covariance.likelihood import nees_of
from consistency.referee.fit_covariance.model_text import noise_document
from consistency.referee.fit_covariance.motion_windows import mean_square, span_of
from consistency.referee.fit_covariance.noise_model import NoiseModel, error_windows
from consistency.referee.pages.trajectory import ellipse
from consistency.referee.show.matplotlib_style import (
    canvas,
    curve,
    dots,
    intervals,
    log_axis,
    name_rows,
    panel_legend,
    path,
    points,
    stroke,
)
from consistency.referee.types import Array

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure as Drawing

SHOWN = 3  # spans with a panel of errors
MOST_ROWS = 30  # runs that have a row
ROW = 0.14  # in, height of one
MANY = 2000  # errors of motions that are drawn
EACH = replace(style(0), size=2.0, alpha=0.7)


def page_of(
    said: Document,
    title: str,
    caption: str,
    draw: Callable[[], Drawing],
) -> Document:
    """A document with its picture; its first sentence is the answer at the top of the page."""
    sentence, *further = said.opening
    assert isinstance(sentence, Text)
    picture = Figure(title, caption, (draw,))
    return replace(said, answer=sentence.text, opening=tuple(further), chapters=(Chapter("", "", "", (picture,)),))


# --- noise models -----------------------------------------------------------------------------------------------------


def noise_page(model: NoiseModel) -> Document:
    """What the model says, and its picture."""
    caption = (
        "Errors of corrected motions in x and y, in the body's frame at their end, with the ellipse that holds "
        "95 % of them where the covariance is right (the mean of all windows). Below: mean squared error of each axis "
        "over the span (markers) beside the model, which is fitted at the shortest span alone (lines); and the ratio "
        "of true to stated covariance of each judged drive."
    )
    return page_of(noise_document(model), "Errors of motions, growth and ratios", caption, partial(draw_noise, model))


def draw_noise(model: NoiseModel) -> Drawing:
    """Errors of the first spans, a panel each, and below them growth and drives."""
    spans = model.spans[:SHOWN]
    axes = range(len(model.noise.axes))
    d = model.windows.d
    figure, panels = canvas(4.0, 3, len(spans) + 3)
    for panel, judged in zip(panels, spans, strict=False):
        _draw_errors(panel, model, judged)
    growth, turns, drives = panels[-3:]
    _draw_growth(growth, model, axes[:d], "m²")
    _draw_growth(turns, model, axes[d:], "rad²")
    _draw_drives(drives, model)
    return figure


def _draw_errors(axes: Axes, model: NoiseModel, judged: JudgedSpan) -> None:
    windows = error_windows(model, judged)
    error = windows.errors[:, :2]
    C = model.noise.covariance(windows.pieces)[:, :2, :2]
    inside = float((nees_of(error, C) < stats.chi2.ppf(CONFIDENCE, 2)).mean())
    axes.axvline(0.0, **stroke(ZERO))
    axes.axhline(0.0, **stroke(ZERO))
    points(axes, error[:, 0], error[:, 1], EACH, limit=MANY)
    path(axes, ellipse(np.zeros(2), C.mean(axis=0)), solid(style(1)))
    title = f"{span_of(judged.span).text}: {100 * inside:.0f} % of {len(error)} inside"
    axes.set(xlabel="error in x (m)", ylabel="error in y (m)", title=title)


def _draw_growth(
    panel: Axes,
    model: NoiseModel,
    axes: Sequence[int],
    unit: str,
) -> None:
    found = [error_windows(model, judged) for judged in model.spans]
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
    panel_legend(panel)


def _draw_drives(axes: Axes, model: NoiseModel) -> None:
    """Ratio of true to stated covariance, a row for each drive."""
    ratios = model.spans[0].by_drive[:, 0]
    known = np.flatnonzero(np.isfinite(ratios))
    draw_ratios(axes, [model.drives[i].name for i in known], ratios[known])
    axes.axvline(model.ratio.value, **stroke(LIMIT))
    most = 1.1 * float(ratios[known].max())
    axes.set(title=f"ratios over {span_of(model.span).text}", xlim=(0.0, max(2.0, most)))


def draw_ratios(axes: Axes, names: Sequence[str], *ratios: Array) -> None:
    """Ratios of true to stated covariance, a row for each name, beside those that count as consistent."""
    name_rows(axes, names)
    axes.axvspan(1.0 / DETECT, DETECT, color=BAND, linewidth=0, zorder=0.4)
    axes.axvline(1.0, **stroke(EXPECTED))
    for number, values in enumerate(ratios):
        axes.plot(values, np.arange(len(values)), **dots(style(number)))
    axes.set_xlabel("true / stated")


# --- corrections ------------------------------------------------------------------------------------------------------


def correction_page(found: Correction) -> Document:
    """What a correction says, and its pictures."""
    caption = (
        "Ratio of true to stated covariance of each held-out run, as stated and corrected; the factor of each block "
        "with its interval; and the share of held-out errors inside the ellipsoid of each probability."
    )
    title = "Held-out runs, factors and coverage"
    return page_of(correction_document(found), title, caption, partial(draw_correction, found))


def draw_correction(found: Correction) -> Drawing:
    """Ratios of held-out runs, factors, and coverage."""
    judged = len(found.judged)
    rows = np.linspace(0, judged - 1, min(MOST_ROWS, judged)).round().astype(int)
    figure, (runs, factors, coverage) = canvas(max(2.4, ROW * len(rows)), 3, 3)
    ratios = found.before.ratios, found.after.ratios
    draw_ratios(runs, np.array(found.judged)[rows], *(each[rows] for each in ratios))
    log_axis(runs, "x")
    _draw_factors(factors, found)
    _draw_coverage(coverage, found)
    return figure


def _draw_factors(axes: Axes, found: Correction) -> None:
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


def _draw_coverage(axes: Axes, found: Correction) -> None:
    """Share of held-out errors inside the ellipsoid of each probability."""
    levels = np.linspace(0.01, 0.99, 50)
    axes.plot([0.0, 1.0], [0.0, 1.0], **stroke(EXPECTED))
    curve(axes, levels, found.before.covered(levels), solid(style(0)), "stated")
    curve(axes, levels, found.after.covered(levels), solid(style(1)), "corrected")
    axes.set(xlabel="probability of the ellipsoid", ylabel="share of errors inside")
    panel_legend(axes)
