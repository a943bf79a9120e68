"""Pictures of a fitted model: errors with ellipses by span, growth over spans, ratios by drive; and its page."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy import stats

from consistency.referee.defaults import CONFIDENCE, DETECT
from consistency.referee.document.blocks import Block, Chapter, Document
from consistency.referee.document.colours import EXPECTED, LIMIT, SHADE, ZERO, solid, style
from consistency.referee.document.drawing import Axis, Figure, Key, Line, Mark, Panel, Points, Rule, Sheet, Span
from consistency.referee.fit_covariance.covariance_ratios import JudgedSpan
from consistency.referee.fit_covariance.model_text import noise_document
from consistency.referee.fit_covariance.motion_windows import span_of
from consistency.referee.fit_covariance.noise_model import NoiseModel, error_windows
from consistency.referee.fit_covariance.white_noise import nees_of
from consistency.referee.pages.write_pages import plotted

SHOWN = 3  # spans with a panel of errors
WIDTH, HEIGHT = 3.0, 2.7  # inches, of a panel
CIRCLE = np.linspace(0.0, 2.0 * np.pi, 121)


def noise_page(model: NoiseModel, with_pictures: bool) -> Document:
    said = noise_document(model)
    blocks: tuple[Block, ...] = noise_figures(model) if with_pictures else ()
    return Document(said.title, "", (Chapter("pictures", "Pictures", "pictures", blocks),), said.opening, said.data)


def noise_figures(model: NoiseModel) -> tuple[Figure, ...]:
    captions = (
        (
            "Errors of motions",
            "Errors of corrected motions in x and y, in the body's frame at their end, with the ellipse that holds "
            "95 % of them where the covariance is right (the mean of all windows).",
        ),
        (
            "Growth and ratios",
            "Mean squared error of each axis over the span (markers) beside the model, which is fitted at the shortest "
            "span alone (lines); and the ratio of true to stated covariance of each judged drive.",
        ),
    )
    return tuple(
        Figure(title, caption, (), tuple(Sheet((panel,), HEIGHT, WIDTH) for panel in shown))
        for (title, caption), shown in zip(captions, panels(model), strict=True)
    )


def panels(model: NoiseModel) -> tuple[tuple[Panel, ...], ...]:
    d = 2 if len(model.noise.axes) == 3 else 3
    growth = (_growth(model, range(d), "m²"), _growth(model, range(d, len(model.noise.axes)), "rad²"))
    return tuple(_errors(model, judged) for judged in model.spans[:SHOWN]), (*growth, _drives(model))


def plot_noise(model: NoiseModel, path: str | Path | None) -> Any:
    """All panels in one figure of Matplotlib; see :meth:`NoiseModel.plot`."""
    errors, rest = panels(model)
    return plotted(Sheet((*errors, *rest), 5.0, columns=3), path)


def _errors(model: NoiseModel, judged: JudgedSpan) -> Panel:
    windows = error_windows(model, judged)
    error, C = windows.errors, model.noise.covariance(windows.pieces).mean(axis=0)[:2, :2]
    values, vectors = np.linalg.eigh(C)
    radius = np.sqrt(float(stats.chi2.ppf(CONFIDENCE, 2)))
    ellipse = radius * (vectors * np.sqrt(np.maximum(values, 0.0))) @ np.array([np.cos(CIRCLE), np.sin(CIRCLE)])
    squared = nees_of(error[:, :2], model.noise.covariance(windows.pieces)[:, :2, :2])
    inside = float((stats.chi2.cdf(squared, 2) < CONFIDENCE).mean())
    marks: tuple[Mark, ...] = (
        Points(error[:, 0], error[:, 1], replace(style(0), size=2.5, alpha=0.7), whole=True),
        Line(ellipse[0], ellipse[1], solid(style(1)), path=True),
        Rule("x", 0.0, ZERO), Rule("y", 0.0, ZERO),
    )  # fmt: skip
    title = f"{span_of(judged.span).text}: {100 * inside:.0f} % of {len(error)} inside"
    return Panel(Axis("error in x (m)"), Axis("error in y (m)"), marks, f"Errors over {judged.span}", title=title)


def _growth(model: NoiseModel, axes: range, unit: str) -> Panel:
    found = [error_windows(model, judged) for judged in model.spans]
    spans = np.array([windows.span.size for windows in found])
    squares = np.array([(windows.errors**2).mean(axis=0) for windows in found])
    stated = np.array([
        np.diagonal(model.noise.covariance(windows.pieces), axis1=1, axis2=2).mean(axis=0) for windows in found
    ])  # fmt: skip
    marks: list[Mark] = []
    for look, axis in enumerate(axes):
        marks += [
            Line(spans, stated[:, axis], solid(style(look))), Points(spans, squares[:, axis], style(look), whole=True),
        ]  # fmt: skip
    keys = tuple(Key(model.noise.axes[axis], style(look), "points") for look, axis in enumerate(axes))
    unit_of_span = {"step": "steps"}.get(found[0].span.unit, found[0].span.unit)
    return Panel(
        Axis(f"span ({unit_of_span})", log=True), Axis(f"mean squared error ({unit})", log=True), tuple(marks),
        "Growth of the squared error over spans", keys=keys,
    )  # fmt: skip


def _drives(model: NoiseModel) -> Panel:
    ratios = model.spans[0].by_drive[:, 0]
    known = np.flatnonzero(np.isfinite(ratios))
    rows = np.arange(len(known), dtype=float)
    marks: tuple[Mark, ...] = (
        Span("x", 1.0 / DETECT, DETECT, SHADE), Rule("x", 1.0, EXPECTED), Rule("x", model.ratio.value, LIMIT),
        Points(ratios[known], rows, style(0), whole=True),
    )  # fmt: skip
    names, most = tuple(model.drives[i].name for i in known), max(2.0, 1.1 * float(ratios[known].max()))
    return Panel(
        Axis("true over stated covariance", window=(0.0, most)), Axis("", rows=names), marks,
        f"Ratios of {len(known)} drives", title=f"ratios over {span_of(model.span).text}",
    )  # fmt: skip
