"""Figures onto paper: the sheets of a description drawn with Matplotlib. Text is shown literally."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from io import BytesIO
from typing import Any, TypeAlias

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis as TickAxis
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from matplotlib.ticker import MaxNLocator

from consistency.referee.document.drawing import (
    LIMIT,
    Axis,
    Band,
    Bars,
    Intervals,
    Line,
    Mark,
    Panel,
    Points,
    Rule,
    Sheet,
    Span,
    Stems,
    Tiles,
    kept,
)
from consistency.referee.show.legends import (
    SMALL,
    dots,
    frame,
    legend,
    panel_labels,
    panel_legend,
    plain_numbers,
    stroke,
    title,
    wrapped,
)

Drawn: TypeAlias = Figure  # for rooms that do not draw themselves
NARROWEST = 0.15  # span of one axis of a map over that of the other, at least: room for the tick labels
BOUND = 0.9  # points, width of the lines at plus and minus a bound
POINTS = 72  # in an inch, the resolution of an SVG
RC: Any = {
    "font.family": "DejaVu Sans", "font.size": 7.5, "axes.titlesize": 8, "axes.labelsize": 7.5, "legend.fontsize": 7.5,
    "axes.linewidth": 0.6, "xtick.major.width": 0.6, "ytick.major.width": 0.6, "svg.hashsalt": "consistency",
    "path.simplify": True, "axes.formatter.useoffset": False,
}  # fmt: skip


def render(sheet: Sheet, kind: str = "svg", resolution: int = 200) -> bytes:
    """One sheet as PNG, PDF or SVG; the same sheet gives the same bytes."""
    with mpl.rc_context(RC):
        figure = draw(sheet)
        if kind == "svg":
            # laid out here and not by savefig, which draws everything once more for that
            figure.set_dpi(POINTS)
            FigureCanvasSVG(figure)
            engine: Any = figure.get_layout_engine()
            engine.execute(figure)
            figure.set_layout_engine(None)
        return picture(figure, kind, resolution)


def drawn(sheet: Sheet) -> Drawn:
    """One sheet as a figure of Matplotlib, in the looks of the reports."""
    with mpl.rc_context(RC):
        return draw(sheet)


def picture(figure: Figure, kind: str, resolution: int = 200) -> bytes:
    """A figure as PNG, PDF or SVG, without date and software."""
    metadata = {"png": {"Software": None}, "pdf": {"CreationDate": None}, "svg": {"Date": None}}[kind]
    buffer = BytesIO()
    with warnings.catch_warnings():
        # a name in a script that the font lacks is drawn as boxes; the tables of the HTML show it
        warnings.filterwarnings("ignore", message="Glyph .* missing from font")
        figure.savefig(buffer, format=kind, dpi=resolution, metadata=metadata)
    return buffer.getvalue()


def draw(sheet: Sheet) -> Figure:
    """The panels of a sheet with its title and legend."""
    panels, columns = sheet.panels, sheet.columns or len(sheet.panels)
    rows = -(-len(panels) // columns)
    own = [panel_labels(panel.keys, sheet.width / columns) for panel in panels]
    room = SMALL * sum(max(lines for *_, lines in own[row * columns :][:columns]) for row in range(rows))
    figure = Figure(figsize=(sheet.width, sheet.height + room), layout="constrained")
    names = ({panel.x.share for panel in panels}, {panel.y.share for panel in panels})
    sharex, sharey = (len(panels) > 1 and len(some) == 1 and some != {""} for some in names)
    shared = {"sharex": sharex, "sharey": sharey}
    options: dict[str, Any] = {"squeeze": False, "width_ratios": sheet.widths or None} | shared
    grid = figure.subplots(rows, columns, **options)
    for panel, axes, (labels, many, _) in zip(panels, grid.flat, own, strict=False):
        draw_panel(axes, panel)
        panel_legend(axes, panel.keys, labels, many)
    for axes in grid.flat[len(panels) :]:
        axes.set_axis_off()
    _outer(grid, len(panels), **shared)
    if sheet.title:
        title(grid[0, 0], wrapped(sheet.title, 90))
    if sheet.keys:
        legend(figure, sheet)
    return figure


def _outer(grid: Any, panels: int, sharex: bool, sharey: bool) -> None:
    """Labels of shared axes at the edge only; a panel with none below it has numbers on its axis."""
    columns = grid.shape[1]
    for number, axes in enumerate(grid.flat[:panels]):
        if sharey and number % columns:
            axes.set_ylabel("")
            axes.tick_params(labelleft=False)
        if sharex:
            axes.tick_params(labelbottom=number + columns >= panels)
        if sharex and number < grid.size - columns:
            axes.set_xlabel("")


# --- one panel --------------------------------------------------------------------------------


def draw_panel(axes: Axes, panel: Panel) -> None:
    """Marks, axes and title of one panel."""
    for number, mark in enumerate(panel.marks):
        PAINT[type(mark)](axes, mark, 2.0 + 0.01 * number, panel)
    if panel.equal:
        _widen(axes)
        axes.set_aspect("equal", adjustable="box")
    _axis(axes, "x", panel.x)
    _axis(axes, "y", panel.y)
    if panel.title:
        title(axes, panel.title)
    frame(axes)
    if panel.y.rows:
        axes.grid(visible=False, axis="both" if panel.x.names else "y")
    if panel.empty and not panel.has_values:
        axes.text(0.5, 0.5, panel.empty, transform=axes.transAxes, ha="center")
        if not panel.marks:
            axes.set_axis_off()


def _axis(axes: Axes, side: str, axis: Axis) -> None:
    ticks: TickAxis = getattr(axes, f"{side}axis")
    axes.set(**{f"{side}label": axis.short or axis.label})
    if axis.log:
        axes.set(**{f"{side}scale": "log"})
        plain_numbers(ticks, *(axis.window or getattr(axes, f"get_{side}lim")()))
    if axis.rows:
        _rows(axes, axis.rows)
    if axis.names:
        axes.set(xlim=(-0.5, len(axis.names) - 0.5), xticks=range(len(axis.names)))
        axes.set_xticklabels([wrapped(name, 12) for name in axis.names], parse_math=False)
    if axis.window is not None:
        axes.set(**{f"{side}lim": axis.window})
    if axis.start is not None:
        axes.set(**{f"{side}lim": (axis.start, None)})
    if axis.most is not None:
        axes.set(**{f"{side}lim": (None, min(getattr(axes, f"get_{side}lim")()[1], axis.most))})
    if axis.ticks:
        axes.set(**{f"{side}ticks": axis.ticks})
    if axis.whole:
        ticks.set_major_locator(MaxNLocator(5, integer=True))


def _rows(axes: Axes, labels: Sequence[str]) -> None:
    """Rows from the top, every second one on a darker ground."""
    for row in range(1, len(labels), 2):
        axes.axhspan(row - 0.5, row + 0.5, color="#f5f5f5", linewidth=0, zorder=0)
    axes.set(ylim=(len(labels) - 0.5, -0.5), yticks=range(len(labels)))
    axes.set_yticklabels([wrapped(label, 28) for label in labels], parse_math=False)
    axes.tick_params(axis="y", length=0, pad=7)


def _widen(axes: Axes) -> None:
    """A straight path has height too: neither axis spans less than :data:`NARROWEST` of the other."""
    limits = np.array([axes.get_xlim(), axes.get_ylim()])
    spans = np.maximum(np.diff(limits)[:, 0], NARROWEST * np.diff(limits).max())
    low, high = limits.mean(axis=1) - spans / 2, limits.mean(axis=1) + spans / 2
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))


# --- marks ------------------------------------------------------------------------------------


def draw_line(axes: Axes, mark: Line, order: float, _: Panel | None = None) -> None:
    """A curve, with shading and dashed lines where it has bounds; ``order``: greater is in front."""
    rows = kept(mark, LIMIT)
    x = mark.x[rows]
    if mark.bound is not None:
        bound = mark.bound[rows]
        axes.fill_between(x, -bound, bound, color=mark.look.colour, alpha=0.15, linewidth=0, zorder=1)
        for sign in (-1.0, 1.0):
            axes.plot(x, sign * bound, color=mark.look.colour, linewidth=BOUND, linestyle="--", zorder=order)
    style = "steps-post" if mark.steps else "default"
    axes.plot(x, mark.y[rows], drawstyle=style, zorder=order, **stroke(mark.look))


def _points(axes: Axes, mark: Points, order: float, _: Panel) -> None:
    rows = kept(mark, LIMIT)
    axes.plot(mark.x[rows], mark.y[rows], zorder=order, **dots(mark.look))


def _stems(axes: Axes, mark: Stems, order: float, _: Panel) -> None:
    axes.vlines(mark.x, 0.0, mark.y, color=mark.look.colour, linewidth=mark.look.width, zorder=order)
    axes.plot(mark.x, mark.y, zorder=order, **dots(mark.look))


def _intervals(axes: Axes, mark: Intervals, order: float, panel: Panel) -> None:
    assert panel.x.window is not None
    start, end = panel.x.window
    low, high = np.clip(mark.low, start, end), np.clip(mark.high, start, end)
    bars = axes.hlines(mark.y, low, high, color=mark.look.colour, linewidth=mark.look.width, zorder=order)
    bars.set_capstyle("butt")
    for edge, beyond, arrow in ((low, mark.low < start, "<"), (high, mark.high > end, ">")):
        for rows, marker, size in ((~beyond, "|", 4.0), (beyond, arrow, 4.5)):
            if rows.any():
                ends: dict[str, Any] = {"color": mark.look.colour, "markersize": size, "clip_on": False}
                axes.plot(edge[rows], mark.y[rows], marker, zorder=order, **ends)
    axes.plot(mark.x, mark.y, zorder=order, **dots(mark.look))


def _band(axes: Axes, mark: Band, order: float, _: Panel) -> None:
    rows = kept(mark, LIMIT)
    x, low, high = mark.x[rows], mark.low[rows], mark.high[rows]
    if mark.outline:
        for edge in (low, high):
            axes.plot(x, edge, zorder=order, **stroke(mark.look))
    else:
        axes.fill_between(x, low, high, color=mark.look.colour, linewidth=0, zorder=0)


def _bars(axes: Axes, mark: Bars, order: float, _: Panel) -> None:
    axes.stairs(mark.height, mark.edges, fill=True, color=mark.look.colour, zorder=order)


def _tiles(axes: Axes, mark: Tiles, order: float, _: Panel) -> None:
    for x, y, text, below, face, ink in zip(mark.x, mark.y, mark.text, mark.below, mark.faces, mark.inks, strict=True):
        axes.add_patch(Rectangle((x - 0.5, y - 0.5), 1, 1, facecolor=face, edgecolor="white", zorder=order))
        place: dict[str, Any] = {"color": ink, "ha": "center", "zorder": order, "parse_math": False}
        axes.text(x, y, text, weight="bold", va="bottom", **place)
        axes.text(x, y + 0.08, below, fontsize=5.5, va="top", **place)


def _rule(axes: Axes, mark: Rule, order: float, _: Panel) -> None:
    (axes.axhline if mark.side == "y" else axes.axvline)(mark.at, zorder=order, **stroke(mark.look))


def _span(axes: Axes, mark: Span, _: float, __: Panel) -> None:
    shade = axes.axhspan if mark.side == "y" else axes.axvspan
    shade(mark.low, mark.high, color=mark.look.colour, alpha=mark.look.alpha, linewidth=0, zorder=0.4)


PAINT: dict[type[Mark], Callable[[Axes, Any, float, Panel], None]] = {
    Line: draw_line, Points: _points, Stems: _stems, Intervals: _intervals, Band: _band, Bars: _bars, Tiles: _tiles,
    Rule: _rule, Span: _span,
}  # fmt: skip
