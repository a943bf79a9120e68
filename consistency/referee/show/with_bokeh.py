"""Figures onto a screen: the panels of a description drawn with Bokeh."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from bokeh.models import BasicTickFormatter, ColumnDataSource, DataRange1d, FixedTicker, HoverTool, Range1d, glyphs
from bokeh.models.annotations import BoxAnnotation
from bokeh.models.annotations import Span as Across
from bokeh.plotting import figure

from consistency.referee.document.colours import Look, solid
from consistency.referee.document.drawing import (
    Axis,
    Band,
    Bars,
    Columns,
    Intervals,
    Line,
    Mark,
    Owner,
    Panel,
    Points,
    Rule,
    Span,
    Stems,
    Tiles,
    kept,
)
from consistency.referee.types import Array

# Bokeh's names of the marker shapes in looks.MARKERS
MARKERS = {
    "o": "circle", "s": "square", "^": "triangle", "D": "diamond", "v": "inverted_triangle", "P": "plus", "X": "x",
    "*": "star",
}  # fmt: skip
TOOLS = "pan,box_zoom,wheel_zoom,reset,save"
STROKE = 1.5  # pixels of a line for a point of its width on paper
DASH = 1.6
STROKES = "PX"  # markers that Bokeh draws with lines alone
DECADES = range(-6, 13)
ROOM = 0.03  # of a window is left beyond its ends for arrows


class Screen:
    """Panels of one chapter; axes of one name are one range."""

    def __init__(self, limit: int) -> None:
        self.limit = limit  # points a mark
        self.shared: dict[str, Any] = {}

    def draw(self, panel: Panel) -> Any:
        """A Bokeh figure of one panel."""
        arrows = any(isinstance(mark, Intervals) for mark in panel.marks)
        ranges = {"x_range": self._range(panel.x, arrows), "y_range": self._range(panel.y)}
        chart = figure(
            height=panel.height, sizing_mode="stretch_width", tools=TOOLS, active_drag="box_zoom",
            x_axis_label=panel.x.label, y_axis_label=panel.y.label, x_axis_type="log" if panel.x.log else "linear",
            y_axis_type="log" if panel.y.log else "linear", match_aspect=panel.equal,
            **{side: value for side, value in ranges.items() if value is not None},
        )  # fmt: skip
        for axis, drawn_range in ((panel.x, chart.x_range), (panel.y, chart.y_range)):
            if axis.share:
                self.shared.setdefault(axis.share, drawn_range)
        _dress(chart, panel)
        tips: dict[tuple[tuple[str, str], ...], list[Any]] = {}
        for mark in panel.marks:
            glyph = PAINT[type(mark)](chart, mark, panel, self.limit)
            if glyph is not None and mark.tips:  # type: ignore[union-attr]
                named = (("filter", "$name"),) if getattr(mark, "owner", None) else ()
                tips.setdefault((*named, *mark.tips), []).append(glyph)  # type: ignore[union-attr]
        for words, drawn in tips.items():
            chart.add_tools(HoverTool(renderers=drawn, tooltips=list(words)))
        return chart

    def _range(self, axis: Axis, arrows: bool = False) -> Any:
        if axis.share in self.shared:
            return self.shared[axis.share]
        if axis.rows:
            return Range1d(start=len(axis.rows) - 0.5, end=-0.5)
        if axis.names:
            return Range1d(start=-0.5, end=len(axis.names) - 0.5)
        if axis.follows:
            return DataRange1d(only_visible=True, min_interval=axis.least or None)
        if axis.window is not None:
            start, end = _roomy(axis) if arrows else axis.window
            return Range1d(start=start, end=end)
        return None if axis.start is None else DataRange1d(start=axis.start)


def _roomy(axis: Axis) -> tuple[float, float]:
    """The window of an axis with room for arrows at its ends."""
    assert axis.window is not None
    low, high = axis.window
    if axis.log:
        return low / (high / low) ** ROOM, high * (high / low) ** ROOM
    return low - ROOM * (high - low), high + ROOM * (high - low)


def _dress(chart: Any, panel: Panel) -> None:
    """Everything of a chart that is no mark."""
    chart.toolbar.logo = None
    chart.toolbar.autohide = True
    for axis in chart.axis:
        axis.axis_label_text_font_style = "normal"
    chart.grid.grid_line_color = "#e8e8e8"
    chart.outline_line_color = None
    for axis, ticks in ((panel.x, chart.xaxis), (panel.y, chart.yaxis)):
        if axis.log and (axis.window or axis.digits):
            ticks.formatter = BasicTickFormatter(use_scientific=False)
        if axis.digits:
            ticks.ticker = FixedTicker(ticks=[digit * 10.0**k for k in DECADES for digit in axis.digits])
        if axis.whole and axis.window:
            low, high = axis.window
            ticks.ticker = FixedTicker(ticks=list(range(int(np.ceil(low)), int(high) + 1)))
    named = (panel.x.names, chart.xaxis, chart.grid), (panel.y.rows, chart.yaxis, chart.ygrid)
    for labels, ticks, grid in named:
        if labels:
            ticks.ticker = FixedTicker(ticks=list(range(len(labels))))
            ticks.major_label_overrides = dict(enumerate(labels))
            grid.visible = False
    for row in range(1, len(panel.y.rows), 2):
        chart.add_layout(BoxAnnotation(bottom=row - 0.5, top=row + 0.5, fill_color="#f5f5f5", level="image"))


def _source(**columns: Any) -> ColumnDataSource:
    """Columns in single precision: seven digits are more than a screen shows."""
    return ColumnDataSource({name: _column(values) for name, values in columns.items()})


def _column(values: Any) -> Any:
    values = np.asarray(values)
    if values.dtype.kind in "OU":
        return list(values)
    return values.astype(np.int32 if values.dtype.kind == "i" else np.float32)


def _columns_of(columns: Columns, rows: Array) -> dict[str, Any]:
    return {name: np.asarray(values)[rows] for name, values in columns.items()}


def _stroke(look: Look) -> dict[str, Any]:
    dash = [max(1, round(DASH * length)) for length in look.dash] or "solid"
    return {"line_color": look.colour, "line_width": round(STROKE * look.width, 2), "line_dash": dash}


def _dots(look: Look) -> dict[str, Any]:
    return {
        "marker": MARKERS[look.marker], "size": round(2.6 + 1.1 * look.size, 1), "fill_color": look.colour,
        "line_color": look.edge or look.colour, "fill_alpha": look.alpha, "line_alpha": look.alpha,
        "line_width": 2.0 if look.marker in STROKES else 1.0,
    }  # fmt: skip


def _owned(owner: Owner | None, *glyphs: Any) -> None:
    for glyph in glyphs:
        if owner is not None:
            glyph.name, glyph.tags = owner.name, [owner.tag]


def _line(chart: Any, mark: Line, _: Panel, limit: int) -> Any:
    rows = kept(mark, limit)
    columns = {"x": mark.x[rows], "y": mark.y[rows]} | _columns_of(mark.columns, rows)
    if mark.bound is not None:
        columns |= {"bound": mark.bound[rows], "below": -mark.bound[rows]}
    source = _source(**columns)
    edges = []
    if mark.bound is not None:
        edge: dict[str, Any] = {"line_color": mark.look.colour, "line_width": 1.3, "line_dash": [5, 4]}
        edges = [
            chart.add_glyph(source, glyphs.Line(x="x", y=side, line_alpha=1.0, **edge)) for side in ("bound", "below")
        ]
    stroke = _stroke(mark.look)
    curve = glyphs.Step(x="x", y="y", mode="after", **stroke) if mark.steps else glyphs.Line(x="x", y="y", **stroke)
    line = chart.add_glyph(source, curve)
    _owned(mark.owner, line, *edges)
    return line


def _points(chart: Any, mark: Points, _: Panel, limit: int) -> Any:
    rows = kept(mark, limit)
    source = _source(x=mark.x[rows], y=mark.y[rows], **_columns_of(mark.columns, rows))
    dots = chart.add_glyph(source, glyphs.Scatter(x="x", y="y", **_dots(mark.look)))
    _owned(mark.owner, dots)
    return dots


def _stems(chart: Any, mark: Stems, _: Panel, __: int) -> Any:
    source = _source(x=mark.x, y=mark.y, **mark.columns)
    stems = chart.add_glyph(source, glyphs.Segment(x0="x", y0=0, x1="x", y1="y", **_stroke(solid(mark.look))))
    dots = chart.add_glyph(source, glyphs.Scatter(x="x", y="y", **_dots(mark.look)))
    _owned(mark.owner, stems, dots)
    return dots


def _intervals(chart: Any, mark: Intervals, panel: Panel, _: int) -> Any:
    assert panel.x.window is not None
    start, end = panel.x.window
    low, high = np.clip(mark.low, start, end), np.clip(mark.high, start, end)
    source = _source(x=mark.x, y=mark.y, low=low, high=high, **mark.columns)
    bars = glyphs.Segment(x0="low", y0="y", x1="high", y1="y", **_stroke(solid(mark.look)))
    drawn = [chart.add_glyph(source, bars)]
    for beyond, edge, angle in ((mark.low < start, start, np.pi / 2), (mark.high > end, end, -np.pi / 2)):
        if beyond.any():
            colour: dict[str, Any] = {"fill_color": mark.look.colour, "line_color": mark.look.colour}
            arrows = glyphs.Scatter(x=edge, y="y", marker="triangle", angle=angle, size=9, **colour)
            drawn.append(chart.add_glyph(_source(y=mark.y[beyond]), arrows))
    dots = chart.add_glyph(source, glyphs.Scatter(x="x", y="y", **_dots(mark.look)))
    _owned(mark.owner, *drawn, dots)
    return dots


def _band(chart: Any, mark: Band, _: Panel, limit: int) -> None:
    rows = kept(mark, limit)
    source = _source(x=mark.x[rows], low=mark.low[rows], high=mark.high[rows])
    if mark.outline:
        edges = [chart.add_glyph(source, glyphs.Line(x="x", y=side, **_stroke(mark.look))) for side in ("low", "high")]
        _owned(mark.owner, *edges)
    else:
        shade: dict[str, Any] = {"fill_color": mark.look.colour, "fill_alpha": 0.8}
        chart.add_glyph(source, glyphs.VArea(x="x", y1="low", y2="high", **shade))


def _bars(chart: Any, mark: Bars, _: Panel, __: int) -> Any:
    source = _source(left=mark.edges[:-1], right=mark.edges[1:], height=mark.height)
    bars: dict[str, Any] = {"left": "left", "right": "right", "top": "height", "bottom": 0}
    return chart.add_glyph(source, glyphs.Quad(**bars, fill_color=mark.look.colour, line_color=None))


def _tiles(chart: Any, mark: Tiles, _: Panel, __: int) -> Any:
    texts = {"text": mark.text, "below": mark.below, "face": mark.faces, "ink": mark.inks}
    source = _source(x=mark.x, y=mark.y, **texts, **mark.columns)
    edge: dict[str, Any] = {"line_color": "#ffffff", "line_width": 2}
    tiles = chart.add_glyph(source, glyphs.Rect(x="x", y="y", width=1, height=1, fill_color="face", **edge))
    middle: dict[str, Any] = {"x": "x", "y": "y", "text_align": "center", "text_color": "ink"}
    number: dict[str, Any] = {
        "text_font_size": "13px",
        "text_font_style": "bold",
        "text_baseline": "bottom",
        "y_offset": 2,
    }
    word: dict[str, Any] = {"text_font_size": "10px", "text_baseline": "top", "y_offset": 4}
    chart.add_glyph(source, glyphs.Text(text="text", **middle, **number))
    chart.add_glyph(source, glyphs.Text(text="below", **middle, **word))
    return tiles


def _rule(chart: Any, mark: Rule, _: Panel, __: int) -> None:
    dimension = "width" if mark.side == "y" else "height"
    chart.add_layout(Across(location=mark.at, **({"dimension": dimension} | _stroke(mark.look))))


def _span(chart: Any, mark: Span, _: Panel, __: int) -> None:
    ends: dict[str, Any] = (
        {"bottom": mark.low, "top": mark.high} if mark.side == "y" else {"left": mark.low, "right": mark.high}
    )
    chart.add_layout(
        BoxAnnotation(fill_color=mark.look.colour, fill_alpha=0.8 * mark.look.alpha, level="image", **ends)
    )


PAINT: dict[type[Mark], Callable[[Any, Any, Panel, int], Any]] = {
    Line: _line, Points: _points, Stems: _stems, Intervals: _intervals, Band: _band, Bars: _bars, Tiles: _tiles,
    Rule: _rule, Span: _span,
}  # fmt: skip
