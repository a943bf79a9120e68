"""The charts of a diagnosis in the HTML report. Nothing is computed here."""

from __future__ import annotations

from typing import Any

import numpy as np
from bokeh.models import BasicTickFormatter, ColumnDataSource, DataRange1d, FixedTicker, Range1d
from bokeh.models.annotations import BoxAnnotation, Span

from consistency.reporting.charts import MARKERS, add_hover, add_line, base_figure, columns, pixels, tag
from consistency.reporting.diagnosis import Forest, forests, lags, steps
from consistency.reporting.model import Study, Track
from consistency.reporting.plots import BAND, LEAST_CORRELATION, Interval, dodge, style
from consistency.reporting.thin import thin


def diagnosis_charts(study: Study, index: int, limit: int) -> dict[str, Any]:
    """Figures by name: axes-ratio, axes-bias, axes-coverage, nees and lags; those without values are left out."""
    charts = {f"axes-{part.name}": _forest(study, index, part) for part in forests(study)}
    if any(steps(track, thin) for track in study.tracks):
        charts["nees"] = _distribution(study, index, limit)
    if any(lags(track) for track in study.tracks):
        charts["lags"] = _lags(study, index)
    return charts


def _forest(study: Study, index: int, part: Forest) -> Any:
    rows, (start, end) = part.only(), part.roomy()
    chart = base_figure(
        part.label, "", 70 + len(rows) * (14 + 13 * len(study.tracks)), x_axis_type="log" if part.log else "linear",
        x_range=Range1d(start=start, end=end), y_range=Range1d(start=len(rows) - 0.5, end=-0.5),
    )  # fmt: skip
    chart.yaxis.ticker = FixedTicker(ticks=list(range(len(rows))))
    chart.yaxis.major_label_overrides = {row: label for row, (label, _) in enumerate(rows)}
    chart.ygrid.visible = False
    chart.xaxis.formatter = BasicTickFormatter(use_scientific=False)
    chart.add_layout(Span(location=part.expected, dimension="height", line_color="#555555", line_width=1.0))
    for row in range(1, len(rows), 2):
        chart.add_layout(BoxAnnotation(bottom=row - 0.5, top=row + 0.5, fill_color="#f5f5f5", level="image"))
    points = []
    for slot, track in enumerate(study.tracks):
        found = [(row, label, i) for row, (label, of) in enumerate(rows) if (i := of[slot]) is not None]
        if found:
            points.append(_intervals(chart, part, found, dodge(slot, len(study.tracks)), track, tag(index, track)))
    add_hover(chart, points, [("axis", "@axis"), (part.label, "@text")])
    return chart


def _intervals(
    chart: Any, part: Forest, found: list[tuple[int, str, Interval]], beside: float, track: Track, label: str
) -> Any:
    look, (start, end) = style(track.style), part.window
    low, high = ([float(np.clip(i[side], start, end)) for _, _, i in found] for side in (1, 2))
    y = [row + beside for row, _, _ in found]
    text = [f"{value:{part.form}} [{a:{part.form}}, {b:{part.form}}]" for _, _, (value, a, b) in found]
    data = ColumnDataSource(
        {"y": y, "value": [i[0] for _, _, i in found], "low": low, "high": high, "axis": [a for _, a, _ in found],
         "text": text}
    )  # fmt: skip
    bars = chart.segment("low", "y", "high", "y", source=data, line_color=look.colour, line_width=2)
    glyphs = [bars]
    below = [y[k] for k, (*_, i) in enumerate(found) if i[1] < start]
    above = [y[k] for k, (*_, i) in enumerate(found) if i[2] > end]
    for places, edge, angle in ((below, start, 90), (above, end, -90)):
        if places:
            options = {"marker": "triangle", "angle": angle, "angle_units": "deg", "size": 9, "color": look.colour}
            glyphs.append(chart.scatter([edge] * len(places), places, **options))
    dots = chart.scatter(
        "value", "y", source=data, marker=MARKERS[look.marker], size=8, fill_color=look.colour, line_color=look.colour,
        name=track.name,
    )  # fmt: skip
    for glyph in (*glyphs, dots):
        glyph.tags = [label]
    return dots


def _distribution(study: Study, index: int, limit: int) -> Any:
    chart = base_figure(
        "chi-square cdf of the NEES", "share of runs", 340, x_range=Range1d(start=-0.02, end=1.02),
        y_range=Range1d(start=-0.02, end=1.02),
    )  # fmt: skip
    found = [(track, of) for track in study.tracks if (of := steps(track, lambda v: thin(v, limit=limit))) is not None]
    same = len({of.half_width for _, of in found}) == 1
    for track, of in found if not same else found[:1]:
        corners = np.unique([0.0, of.half_width, 1.0 - of.half_width, 1.0])
        low, high = (np.clip(corners + side, 0.0, 1.0) for side in (-of.half_width, of.half_width))
        data = columns(x=corners, low=low, high=high)
        if same:
            chart.varea("x", "low", "high", source=data, fill_color=BAND, fill_alpha=0.8)
        else:
            for side in ("low", "high"):
                add_line(chart, data, "x", side, track, tag(index, track), line_width=0.9, line_dash=[1, 3])
    chart.line([0, 1], [0, 1], color="#555555", line_width=1.0)
    curves = []
    for track, of in found:
        look = style(track.style)
        curve = chart.step(
            "x", "y", source=columns(x=of.x, y=of.y), mode="after", line_color=look.colour, line_width=1.9,
            line_dash=pixels(look.dash), name=track.name,
        )  # fmt: skip
        curve.tags = [tag(index, track)]
        curves.append(curve)
    add_hover(chart, curves, [("chi-square cdf", "@x{0.000}"), ("share of runs", "@y{0.000}")])
    return chart


def _lags(study: Study, index: int) -> Any:
    chart = base_figure(
        "lag (steps)",
        "autocorrelation",
        240,
        y_range=DataRange1d(only_visible=True, min_interval=2 * LEAST_CORRELATION),
    )
    found = [(slot, track, of) for slot, track in enumerate(study.tracks) if (of := lags(track)) is not None]
    bounds = {of.bound for _, _, of in found if of.bound is not None}
    if len(bounds) == 1:
        (bound,) = bounds
        chart.add_layout(BoxAnnotation(bottom=-bound, top=bound, fill_color=BAND, level="image"))
    points = []
    for slot, track, of in found:
        look, label = style(track.style), tag(index, track)
        lag = np.arange(1, len(of.values) + 1)
        data = columns(x=lag + 0.6 * dodge(slot, len(study.tracks)), value=of.values, lag=lag)
        stems = chart.segment("x", 0, "x", "value", source=data, line_color=look.colour, line_width=1.6)
        dots = chart.scatter(
            "x", "value", source=data, marker=MARKERS[look.marker], size=6, fill_color=look.colour,
            line_color=look.colour, name=track.name,
        )  # fmt: skip
        stems.tags = dots.tags = [label]
        points.append(dots)
        if len(bounds) > 1 and of.bound is not None:
            for side in (-of.bound, of.bound):
                ends = columns(x=[0.5, len(of.values) + 0.5], bound=[side, side])
                add_line(chart, ends, "x", "bound", track, label, line_width=0.9, line_dash=[1, 3])
    chart.add_layout(Span(location=0.0, dimension="width", line_color="#555555", line_width=1.0))
    chart.xaxis.ticker = FixedTicker(ticks=list(range(1, max(len(of.values) for _, _, of in found) + 1)))
    add_hover(chart, points, [("lag", "@lag"), ("autocorrelation", "@value{0.000}")])
    return chart
