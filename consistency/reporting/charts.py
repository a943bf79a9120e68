"""The charts of the HTML report: model records onto Bokeh figures. Nothing is computed here."""

from __future__ import annotations

from typing import Any

import numpy as np
from bokeh.models import ColumnDataSource, HoverTool, Range1d
from bokeh.models.annotations import Span
from bokeh.plotting import figure

from consistency.reporting.model import Distribution, Study, Track
from consistency.reporting.plots import AXES, BAND, COLOURS, DASHES, ODOMETRY, TRUTH, style
from consistency.reporting.thin import LIMIT, thin
from consistency.types import Array

# Bokeh's names of the marker shapes in plots.MARKERS
MARKERS = {
    "o": "circle", "s": "square", "^": "triangle", "D": "diamond", "v": "inverted_triangle", "P": "plus", "X": "x",
    "*": "star",
}  # fmt: skip
TOOLS = "pan,box_zoom,wheel_zoom,reset,save"


def study_charts(study: Study, index: int, limit: int = LIMIT) -> dict[str, Any]:
    """Figures by name: map, then error-0..2 and anees where the truth is known, then nis."""
    charts = {"map": _map(study, index, limit)}
    shared = None
    if study.has_truth:
        for component in range(3):
            shared = charts[f"error-{component}"] = _error(study, index, component, shared, limit)
        charts["anees"] = _anees(study, index, shared, limit)
    charts["nis"] = _nis(study, index, shared, limit)
    return charts


def tag(study: int, track: Track) -> str:
    """Mark on every glyph of a filter, by which a checkbox finds it."""
    return f"{study}:{track.style}"


def base_figure(x: str, y: str, height: int = 280, **options: Any) -> Any:
    """Empty chart that looks like all others."""
    chart = figure(
        height=height, sizing_mode="stretch_width", tools=TOOLS, active_drag="box_zoom", x_axis_label=x, y_axis_label=y,
        **options,
    )  # fmt: skip
    chart.toolbar.logo = None
    chart.toolbar.autohide = True
    for axis in chart.axis:
        axis.axis_label_text_font_style = "normal"
    chart.grid.grid_line_color = "#e8e8e8"
    chart.outline_line_color = None
    return chart


def columns(**arrays: Any) -> ColumnDataSource:
    """Columns in single precision: seven digits are more than a screen shows."""
    data: dict[str, Any] = {
        name: np.asarray(values, np.int32 if np.asarray(values).dtype.kind == "i" else np.float32)
        for name, values in arrays.items()
    }
    return ColumnDataSource(data)


def add_hover(chart: Any, renderers: list[Any], tooltips: list[tuple[str, str]], **options: Any) -> None:
    """Tooltips that begin with the filter's name."""
    if renderers:
        chart.add_tools(HoverTool(renderers=renderers, tooltips=[("filter", "$name"), *tooltips], **options))


def add_line(chart: Any, source: ColumnDataSource, x: str, y: str, track: Track, label: str, **options: Any) -> Any:
    """Line in the filter's style, marked with ``label``."""
    look = style(track.style)
    options = {"line_width": 1.6, "line_dash": pixels(look.dash)} | options
    line = chart.line(x, y, source=source, line_color=look.colour, name=track.name, **options)
    line.tags = [label]
    return line


def pixels(pattern: tuple[float, ...]) -> Any:
    """A dash pattern as Bokeh takes it."""
    return [max(1, round(1.6 * length)) for length in pattern] or "solid"


def _map(study: Study, index: int, limit: int) -> Any:
    chart = base_figure("x (m)", "y (m)", 520, match_aspect=True)
    if study.landmarks is not None:
        source = columns(x=study.landmarks[:, 0], y=study.landmarks[:, 1])
        chart.scatter("x", "y", source=source, marker="star", size=8, color="#8c8c8c", line_color=None)
    if study.odometry is not None:
        chart.line(*_path(study.odometry, limit), color=ODOMETRY, line_dash=[9, 5], line_width=1.6)
    if study.true_path is not None:
        chart.line(*_path(study.true_path, limit), color=TRUTH, line_width=2.2)
        start = study.true_path[0]
        chart.scatter([start[0]], [start[1]], size=11, fill_color="white", line_color=TRUTH, line_width=1.5)
    lines = []
    for track in study.tracks:
        keep = thin(*track.path.T, limit=limit)
        source = columns(x=track.path[keep, 0], y=track.path[keep, 1], step=study.steps[keep])
        lines.append(add_line(chart, source, "x", "y", track, tag(index, track)))
    add_hover(chart, lines, [("step", "@step"), ("x", "@x{0.00} m"), ("y", "@y{0.00} m")])
    return chart


def _path(path: Array, limit: int) -> list[Array]:
    keep = thin(*path.T, limit=limit)
    return [column.astype(np.float32) for column in path[keep].T]


def _error(study: Study, index: int, component: int, shared: Any, limit: int) -> Any:
    name, unit = AXES[component]
    options = {} if shared is None else {"x_range": shared.x_range}
    chart = base_figure("step", f"{name} error ({unit})", 240, **options)
    lines = []
    for track in study.tracks:
        if track.error is None:
            continue
        error, bound = track.error[:, component], 2.0 * track.sigma[:, component]
        keep = thin(error, bound, limit=limit)
        source = columns(step=study.steps[keep], error=error[keep], high=bound[keep], low=-bound[keep])
        label = tag(index, track)
        for column in ("high", "low"):
            add_line(chart, source, "step", column, track, label, line_width=0.9, line_dash=[5, 4], line_alpha=0.7)
        lines.append(add_line(chart, source, "step", "error", track, label))
    chart.add_layout(Span(location=0.0, dimension="width", line_color="#777777", line_width=0.6))
    rows = [("step", "@step"), ("error", f"@error{{0.0000}} {unit}"), ("2 sigma", f"@high{{0.0000}} {unit}")]
    add_hover(chart, lines, rows)
    return chart


def _anees(study: Study, index: int, shared: Any, limit: int) -> Any:
    options = {} if shared is None else {"x_range": shared.x_range}
    chart = base_figure(
        "step", f"{study.statistic} of the pose", 360, y_axis_type="log" if study.anees_log else "linear", **options
    )
    common = study.common_band
    if common is not None:
        _common_band(chart, study, common, limit)
    lines = []
    for track in study.tracks:
        if track.anees is None or track.band is None or track.simultaneous is None:
            continue
        label = tag(index, track)
        if track.own_band:
            keep = thin(track.band[:, 1], limit=limit)
            for bounds, dash in ((track.simultaneous, [5, 4]), (track.band, [1, 3])):
                source = columns(step=study.steps[keep], low=bounds[keep, 0], high=bounds[keep, 1])
                for column in ("low", "high"):
                    add_line(chart, source, "step", column, track, label, line_width=0.9, line_dash=dash)
        keep = thin(track.anees, limit=limit)
        source = columns(
            step=study.steps[keep], value=track.anees[keep], low=track.band[keep, 0], high=track.band[keep, 1],
            least=track.simultaneous[keep, 0], most=track.simultaneous[keep, 1],
        )  # fmt: skip
        lines.append(add_line(chart, source, "step", "value", track, label, line_width=1.9))
    rows = [
        ("step", "@step"), (study.statistic, "@value{0.000}"), ("95 % band, one step", "@low{0.00} to @high{0.00}"),
        ("band of all steps", "@least{0.00} to @most{0.00}"),
    ]  # fmt: skip
    add_hover(chart, lines, rows)
    return chart


def _common_band(chart: Any, study: Study, common: Track, limit: int) -> None:
    assert common.band is not None
    assert common.simultaneous is not None
    keep = thin(common.band[:, 1], limit=limit)
    inner = columns(step=study.steps[keep], low=common.band[keep, 0], high=common.band[keep, 1])
    chart.varea("step", "low", "high", source=inner, fill_color=BAND, fill_alpha=0.8)
    outer = columns(step=study.steps[keep], low=common.simultaneous[keep, 0], high=common.simultaneous[keep, 1])
    for column in ("low", "high"):
        chart.line("step", column, source=outer, color="#333333", line_dash=[6, 4], line_width=1.2)
    chart.add_layout(Span(location=common.expected, dimension="width", line_color="#555555", line_width=1.0))


def _nis(study: Study, index: int, shared: Any, limit: int) -> Any:
    options = {} if shared is None else {"x_range": shared.x_range}
    chart = base_figure("step", "NIS / dof", 280, y_axis_type="log" if study.nis_log else "linear", **options)
    chart.y_range.only_visible = True
    points = []
    for track in study.tracks:
        look = style(track.style)
        keep = thin(track.nis_ratio, limit=limit)
        source = columns(step=study.steps[keep], value=track.nis_ratio[keep])
        glyph = chart.scatter(
            "step", "value", source=source, marker=MARKERS[look.marker], size=5, fill_color=look.colour,
            line_color=look.colour, fill_alpha=0.6, line_alpha=0.6, name=track.name,
        )  # fmt: skip
        glyph.tags = [tag(index, track)]
        points.append(glyph)
    chart.add_layout(Span(location=1.0, dimension="width", line_color="#333333", line_width=1.0))
    add_hover(chart, points, [("step", "@step"), ("NIS / dof", "@value{0.000}")])
    return chart


def distribution_charts(d: Distribution) -> tuple[Any, Any]:
    """Samples with two ellipses, and the histogram of x with two densities."""
    (x_low, x_high), (y_low, y_high) = d.window
    x_range, y_range = Range1d(start=x_low, end=x_high), Range1d(start=y_low, end=y_high)
    cloud = base_figure("x (m)", "y (m)", 320, x_range=x_range, y_range=y_range)
    cloud.scatter("x", "y", source=columns(x=d.points[:, 0], y=d.points[:, 1]), size=3, color="#555555", alpha=0.6)
    histogram = base_figure("x (m)", "density of x (1/m)", 320, x_range=cloud.x_range)
    source = columns(left=d.edges[:-1], right=d.edges[1:], density=d.density)
    bars = histogram.quad(
        left="left", right="right", top="density", bottom=0, source=source, fill_color="#c4c4c4", line_color=None
    )
    histogram.add_tools(
        HoverTool(renderers=[bars], tooltips=[("x", "@left{0.00} to @right{0.00} m"), ("density", "@density{0.0000}")])
    )
    for number, (ellipse, density) in enumerate(
        ((d.linear_ellipse, d.linear_density), (d.fitted_ellipse, d.fitted_density))
    ):
        options = {"line_color": COLOURS[number], "line_dash": pixels(DASHES[number]), "line_width": 2}
        cloud.line("x", "y", source=columns(x=ellipse[:, 0], y=ellipse[:, 1]), **options)
        histogram.line("x", "y", source=columns(x=d.grid, y=density), **options)
    return cloud, histogram
