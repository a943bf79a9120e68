"""The charts of the stereo front-end in the HTML report. Nothing is computed here."""

from __future__ import annotations

from typing import Any

import numpy as np
from bokeh.models import BasicTickFormatter, ColumnDataSource, FixedTicker, HoverTool, Range1d
from bokeh.models.annotations import BoxAnnotation, Span

from consistency.reporting.charts import MARKERS, base_figure, columns
from consistency.reporting.model import Cells, FirstOrder, FrontEnd, Scenes, Shares
from consistency.reporting.plots import ACCEPTED, BAND, COLOURS, PERCENT, REJECTED

DECADES = range(-6, 13)
WIDE = 200.0  # a log axis that spans more has room for powers of ten only


def front_end_charts(found: FrontEnd) -> dict[str, Any]:
    """Figures by name: shares, scenes, cells-0, cells-1, ...; those without a table are left out."""
    charts = {}
    if found.shares is not None:
        charts["shares"] = _shares(found.shares)
    if found.scenes is not None:
        charts["scenes"] = _scenes(found.scenes)
    if found.first_order is not None:
        charts |= _first_order(found.first_order)
    return charts


def _shares(found: Shares) -> Any:
    chart = base_figure("depth (m)", "inside the 95 % region (%)", 280)
    chart.x_range.start = 0.0
    low, high = (PERCENT * end for end in found.accepted)
    chart.add_layout(BoxAnnotation(bottom=low, top=high, fill_color=BAND, fill_alpha=0.8, level="image"))
    chart.add_layout(Span(location=PERCENT * found.expected, dimension="width", line_color="#555555", line_width=1.0))
    source = columns(depth=found.depth, share=PERCENT * found.share)
    chart.line("depth", "share", source=source, line_color=COLOURS[0], line_width=1.6)
    dots = chart.scatter("depth", "share", source=source, size=8, color=COLOURS[0])
    chart.add_tools(HoverTool(renderers=[dots], tooltips=[("depth", "@depth m"), ("inside", "@share{0.0} %")]))
    return chart


def _scenes(found: Scenes) -> Any:
    start, end = found.window
    rows = list(range(len(found.scenes)))
    chart = base_figure(
        f"N times mean NEES / {found.dof}", "", 80 + 30 * len(rows),
        x_range=Range1d(start=start, end=end), y_range=Range1d(start=len(rows) - 0.5, end=-0.5),
    )  # fmt: skip
    chart.yaxis.ticker = FixedTicker(ticks=rows)
    chart.yaxis.major_label_overrides = {row: scene.label for row, scene in enumerate(found.scenes)}
    chart.ygrid.visible = False
    chart.add_layout(
        BoxAnnotation(left=found.region[0], right=found.region[1], fill_color=BAND, fill_alpha=0.8, level="image")
    )
    chart.add_layout(Span(location=1.0, dimension="height", line_color="#555555", line_width=1.0))
    source = ColumnDataSource(
        {
            "row": rows,
            "scene": [scene.label for scene in found.scenes],
            "ratio": [scene.ratio for scene in found.scenes],
            "least": [scene.spread[0] for scene in found.scenes],
            "most": [scene.spread[1] for scene in found.scenes],
        }
    )
    chart.segment("least", "row", "most", "row", source=source, line_color=COLOURS[0], line_width=2)
    dots = chart.scatter("ratio", "row", source=source, size=8, color=COLOURS[0])
    words = [("scene", "@scene"), ("mean", "@ratio{0.000}"), ("middle 95 %", "@least{0.000} to @most{0.000}")]
    chart.add_tools(HoverTool(renderers=[dots], tooltips=words))
    return chart


def _first_order(found: FirstOrder) -> dict[str, Any]:
    charts: dict[str, Any] = {}
    shared: dict[str, Any] = {}
    nees = np.concatenate([cells.nees[np.isfinite(cells.nees)] for cells in found.estimators])
    mantissas = (1,) if nees.size and nees.max() > WIDE * nees.min() else (1, 2, 5)
    for number, cells in enumerate(found.estimators):
        chart = charts[f"cells-{number}"] = _cells(cells, found.holds, shared, mantissas)
        shared = {"x_range": chart.x_range, "y_range": chart.y_range}
    return charts


def _cells(cells: Cells, holds: float, shared: dict[str, Any], mantissas: tuple[int, ...]) -> Any:
    chart = base_figure("noise / disparity (%)", "mean NEES / dof", 250, x_axis_type="log", y_axis_type="log", **shared)
    for axis, marks in ((chart.xaxis, (1,)), (chart.yaxis, mantissas)):
        axis.ticker = FixedTicker(ticks=[m * 10.0**k for k in DECADES for m in marks])
        axis.formatter = BasicTickFormatter(use_scientific=False)
    chart.add_layout(Span(location=1.0, dimension="width", line_color="#555555", line_width=1.0))
    limit = Span(location=PERCENT * holds, dimension="height", line_color="#333333", line_dash=[6, 4], line_width=1.2)
    chart.add_layout(limit)
    glyphs = []
    for look, chosen in ((ACCEPTED, cells.accepted), (REJECTED, ~cells.accepted)):
        source = columns(ratio=PERCENT * cells.ratio[chosen], nees=cells.nees[chosen])
        glyphs.append(
            chart.scatter(
                "ratio", "nees", source=source, marker=MARKERS[look.marker], size=8, fill_color=look.colour,
                line_color=look.colour, line_width=2.0, fill_alpha=0.7, line_alpha=0.9, name=cells.estimator,
            )
        )  # fmt: skip
    words = [("noise / disparity", "@ratio{0.0} %"), ("mean NEES / dof", "@nees{0.00}")]
    chart.add_tools(HoverTool(renderers=glyphs, tooltips=words))
    return chart
