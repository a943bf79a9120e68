"""Figures of a filter's honesty: records and arrays onto Matplotlib Axes. Nothing is computed here but outlines.

Every function draws on the Axes it is given and returns nothing; text is shown literally, so a name
may hold any character. Colours are those of Okabe & Ito (2008); each style has its own dash pattern
and marker as well, so that a grey print still reads.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, MaxNLocator, NullFormatter

from consistency.types import Array, Indices

TRUTH, ODOMETRY, BAND = "#000000", "#7f7f7f", "#d9d9d9"
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
# lengths in points, drawn and left out; 5 patterns and 6 colours repeat together only after 30
DASHES: tuple[tuple[float, ...], ...] = (
    (),
    (5.0, 2.0),
    (1.5, 1.5),
    (7.0, 2.0, 1.5, 2.0),
    (3.0, 1.5, 1.0, 1.5, 1.0, 1.5),
)
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")
NARROWEST = 0.15  # span of one axis of a map over that of the other, at least: room for the tick labels
BESIDE = 0.66  # of the figure's width is left of a legend that stands beside the axes
AXES = (("x", "m"), ("y", "m"), ("heading", "deg"))
PERCENT = 100.0
LEAST_CORRELATION = 0.1  # drawn on either side of zero, so that noise does not look large
Interval = tuple[float, float, float]  # value, low, high; the ends may be infinite


@dataclass(frozen=True)
class Style:
    """How one filter looks everywhere."""

    colour: str
    dash: tuple[float, ...]  # empty: solid
    marker: str

    @property
    def linestyle(self) -> Any:
        """The dash pattern as Matplotlib takes it."""
        return (0.0, self.dash) if self.dash else "-"


ACCEPTED, REJECTED = Style(COLOURS[0], (), "o"), Style(COLOURS[1], (), "X")


def style(index: int) -> Style:
    """Style of the filter with this number; the same number always looks the same."""
    return Style(COLOURS[index % len(COLOURS)], DASHES[index % len(DASHES)], MARKERS[index % len(MARKERS)])


def scenario(
    axes: Axes,
    true_path: Array | None,
    odometry: Array | None,
    landmarks: Array | None,
    paths: Sequence[tuple[Style, Array]] = (),
) -> None:
    """World from above, as Herath et al. (2007) fig. 2a.

    Parameters
    ----------
    true_path, odometry : (T + 1, 2) in m, or None where unknown
    landmarks : (N, 2) in m, or None
    paths : a style and an estimated path (T, 2) in m for each filter
    """
    if landmarks is not None:
        axes.plot(*landmarks.T, "*", color="#8c8c8c", markersize=4, markeredgewidth=0, zorder=1)
    if odometry is not None:
        axes.plot(*odometry.T, color=ODOMETRY, linewidth=1.1, dashes=(6, 3), zorder=2)
    if true_path is not None:
        axes.plot(*true_path.T, color=TRUTH, linewidth=1.6, zorder=3)
        axes.plot(*true_path[0], "o", color="white", markeredgecolor=TRUTH, markersize=7, zorder=6)
    for look, path in paths:
        axes.plot(*path.T, color=look.colour, linestyle=look.linestyle, linewidth=1.1, zorder=4)
    _widen(axes)
    axes.set_aspect("equal", adjustable="box")
    axes.set(xlabel="x (m)", ylabel="y (m)")
    _frame(axes)


def pose_error(axes: Axes, steps: Indices, error: Array, sigma: Array, look: Style, component: int) -> None:
    """One component of the pose error of one run with its 2-sigma bounds, as Herath et al. (2007) fig. 2b.

    Parameters
    ----------
    steps, error, sigma : (T,), m, or degrees for the heading
    component : 0 for x, 1 for y, 2 for the heading
    """
    name, unit = AXES[component]
    axes.fill_between(steps, -2 * sigma, 2 * sigma, color=look.colour, alpha=0.15, linewidth=0)
    for sign in (-2.0, 2.0):
        axes.plot(steps, sign * sigma, color=look.colour, linewidth=0.9, linestyle="--")
    axes.plot(steps, error, color=look.colour, linewidth=0.9)
    axes.axhline(0.0, color="#555555", linewidth=0.5)
    axes.set(ylabel=f"{name} error\n({unit})")
    axes.margins(x=0.01)
    _frame(axes)


def anees_band(
    axes: Axes, steps: Indices, band: Array, simultaneous: Array, expected: float, look: Style | None = None
) -> None:
    """Where the average NEES of a consistent filter stays: in one step (shaded), in all at once (dashed).

    ``band`` and ``simultaneous`` are (T, 2). With ``look`` both are thin lines in that style's colour.
    """
    if look is None:
        axes.fill_between(steps, *band.T, color=BAND, linewidth=0, zorder=0)
        axes.axhline(expected, color="#555555", linewidth=0.8, zorder=1)
    colour = "#333333" if look is None else look.colour
    for low_high in simultaneous.T:
        axes.plot(steps, low_high, color=colour, linewidth=0.9, dashes=(4, 3), zorder=1)
    if look is not None:
        for low_high in band.T:
            axes.plot(steps, low_high, color=colour, linewidth=0.7, dashes=(1, 2), zorder=1)


def anees(axes: Axes, curves: Sequence[tuple[Style, Indices, Array]], log: bool, single: bool = False) -> None:
    """Average NEES (or, with ``single``, the NEES of one run) over steps, as Herath et al. (2007) fig. 11.

    ``curves`` holds a style, steps (T,) and values (T,) for each filter.
    """
    for look, steps, values in curves:
        axes.plot(steps, values, color=look.colour, linestyle=look.linestyle, linewidth=1.2, zorder=3)
    if log:
        _log_scale(axes)
    axes.set(xlabel="step", ylabel=f"{'NEES' if single else 'ANEES'} of the pose")
    axes.margins(x=0.01)
    _frame(axes)


def nis(axes: Axes, steps: Indices, ratio: Array, look: Style, log: bool = False) -> None:
    """Normalized innovation squared over its degrees of freedom, one point a step; 1 is expected."""
    axes.plot(steps, ratio, look.marker, color=look.colour, markersize=2.0, markeredgewidth=0, alpha=0.7)
    axes.axhline(1.0, color="#333333", linewidth=0.8)
    if log:
        _log_scale(axes)
    axes.set(xlabel="step", ylabel="NIS / dof")
    axes.margins(x=0.01)
    _frame(axes)


def evidence(axes: Axes, steps: Array, values: Array, threshold: float, alarm: tuple[float, float] | None) -> None:
    """E-value after each step with the value at which an alarm is raised (dashed).

    What goes on beyond the square of that value is cut off.

    Parameters
    ----------
    steps, values : (N,), (N,)
    alarm : the step since which there is a fault and that of the alarm, shaded between; None without alarm
    """
    if alarm is not None:
        axes.axvspan(*alarm, color=COLOURS[1], alpha=0.15, linewidth=0, zorder=0)
        axes.axvline(alarm[1], color=COLOURS[1], linewidth=1.1, zorder=2)
    axes.axhline(threshold, color="#333333", linewidth=0.9, dashes=(4, 3), zorder=1)
    axes.plot(steps, values, color=COLOURS[0], linewidth=1.2, zorder=3)
    axes.set_yscale("log")
    axes.set(xlabel="step", ylabel="e-value")
    axes.set_ylim(top=min(axes.get_ylim()[1], threshold**2))
    axes.margins(x=0.01)
    _frame(axes)


def forest(
    axes: Axes,
    looks: Sequence[Style],
    rows: Sequence[tuple[str, Sequence[Interval | None]]],
    expected: float,
    window: tuple[float, float],
    log: bool = False,
) -> None:
    """Values with intervals, a row for each axis of the pose and in it a line for each filter.

    Parameters
    ----------
    looks : a style a filter
    rows : a label, and for each filter value, low and high, or None
    window : drawn range; an interval that goes on beyond it ends in an arrow
    """
    axes.axvline(expected, color="#555555", linewidth=0.8, zorder=1)
    for row, (_, intervals) in enumerate(rows):
        if row % 2:
            axes.axhspan(row - 0.5, row + 0.5, color="#f5f5f5", linewidth=0, zorder=0)
        for slot, (look, interval) in enumerate(zip(looks, intervals, strict=True)):
            if interval is not None:
                _interval(axes, row + dodge(slot, len(looks)), interval, window, look)
    if log:
        axes.set_xscale("log")
        _plain_numbers(axes.xaxis, *window)
    axes.set(xlim=window, ylim=(len(rows) - 0.5, -0.5), yticks=range(len(rows)))
    axes.set_yticklabels([label for label, _ in rows], parse_math=False)
    axes.tick_params(axis="y", length=0, pad=7)
    _frame(axes)
    axes.grid(visible=False, axis="y")


def dodge(slot: int, slots: int) -> float:
    """Place of a filter beside the others, from -0.5 to 0.5 around a common mark."""
    return 0.76 * ((slot + 0.5) / slots - 0.5)


def _interval(axes: Axes, y: float, interval: Interval, window: tuple[float, float], look: Style) -> None:
    value, low, high = interval
    ends = [max(low, window[0]), min(high, window[1])]
    axes.plot(ends, [y, y], color=look.colour, linewidth=1.3, solid_capstyle="butt", zorder=3)
    for beyond, end, arrow in ((low < window[0], ends[0], "<"), (high > window[1], ends[1], ">")):
        mark, size = (arrow, 4.5) if beyond else ("|", 4.0)
        axes.plot([end], [y], mark, color=look.colour, markersize=size, clip_on=False, zorder=4)
    axes.plot([value], [y], look.marker, color=look.colour, markersize=4.2, markeredgewidth=0.8, zorder=5)


def distribution(axes: Axes, x: Array, y: Array, half_width: float, look: Style) -> None:
    """Empirical distribution function (x, y of each step) against the diagonal and its simultaneous band."""
    corners = sorted({0.0, half_width, 1.0 - half_width, 1.0})
    low, high = ([min(max(u + side, 0.0), 1.0) for u in corners] for side in (-half_width, half_width))
    axes.fill_between(corners, low, high, color=BAND, linewidth=0, zorder=0)
    axes.plot([0, 1], [0, 1], color="#555555", linewidth=0.8, zorder=1)
    axes.plot(x, y, color=look.colour, linewidth=1.3, drawstyle="steps-post", zorder=3)
    axes.set(xlim=(-0.02, 1.02), ylim=(-0.02, 1.02), xticks=(0, 0.5, 1), yticks=(0, 0.5, 1))
    _frame(axes)


def autocorrelation(axes: Axes, values: Array, bound: float | None, look: Style) -> None:
    """Autocorrelation of lag 1, 2, ... (lags,), and the bound that each stays within where it is judged."""
    if bound is not None:
        axes.axhspan(-bound, bound, color=BAND, linewidth=0, zorder=0)
    axes.axhline(0.0, color="#555555", linewidth=0.8, zorder=1)
    number = range(1, len(values) + 1)
    axes.vlines(number, 0.0, values, color=look.colour, linewidth=1.3, zorder=3)
    axes.plot(number, values, look.marker, color=look.colour, markersize=3.6, markeredgewidth=0.8, zorder=4)
    axes.xaxis.set_major_locator(MaxNLocator(5, integer=True))
    reach = 1.15 * max(float(np.abs(values).max()), bound or 0.0, LEAST_CORRELATION)
    axes.set(xlabel="lag (steps)", ylabel="correlation", xlim=(0.4, len(values) + 0.6), ylim=(-reach, reach))
    _frame(axes)


def samples(axes: Axes, points: Array, linear: Array, fitted: Array) -> None:
    """Transformed points (n, 2) in m with two ellipses (m, 2), as Herath et al. (2007) fig. 12."""
    axes.plot(*points.T, ".", color="#555555", markersize=2.0, markeredgewidth=0, alpha=0.6)
    axes.plot(*linear.T, color=COLOURS[0], linewidth=1.4)
    axes.plot(*fitted.T, color=COLOURS[1], linewidth=1.4, dashes=DASHES[1])
    axes.set(xlabel="x (m)", ylabel="y (m)")
    _frame(axes)


def shares(axes: Axes, x: Array, share: Array, expected: float, accepted: tuple[float, float]) -> None:
    """Shares (n,) in % with the expected one and the range that a test accepts (shaded).

    As Valencia & Andrade-Cetto (2018) fig. 2.2, which is one repetition.
    """
    axes.axhspan(PERCENT * accepted[0], PERCENT * accepted[1], color=BAND, linewidth=0, zorder=0)
    axes.axhline(PERCENT * expected, color="#555555", linewidth=0.8, zorder=1)
    axes.plot(x, PERCENT * share, "-o", color=COLOURS[0], linewidth=1.2, markersize=4.2, zorder=3)
    axes.set(xlabel="depth (m)", ylabel="inside the 95 % region (%)")
    _frame(axes)


def cells(axes: Axes, ratio: Array, nees: Array, accepted: Array, holds: float) -> None:
    """NEES over its degrees of freedom against the noise of the disparity, both (n,), on log axes; 1 is right.

    ``accepted`` (n,) says of each cell whether its verdict is consistent; up to ``holds`` it should be.
    """
    axes.axhline(1.0, color="#555555", linewidth=0.8, zorder=1)
    axes.axvline(PERCENT * holds, color="#333333", linewidth=0.9, dashes=(4, 3), zorder=1)
    for look, chosen in ((ACCEPTED, accepted), (REJECTED, ~accepted)):
        axes.plot(
            PERCENT * ratio[chosen], nees[chosen], look.marker, color=look.colour, markersize=4.2, markeredgewidth=0,
            alpha=0.8, zorder=3,
        )  # fmt: skip
    axes.set(xscale="log", xlabel="noise / disparity (%)", ylabel="mean NEES / dof")
    _plain_numbers(axes.xaxis, *axes.get_xlim())
    _log_scale(axes)
    _frame(axes)


def ellipse(axes: Axes, centre: Array, covariance: Array, scale: float, look: Style) -> None:
    """Iso-uncertainty curve of a covariance (2, 2) about ``centre`` (2,), ``scale`` standard deviations wide.

    Valencia & Andrade-Cetto (2018) fig. 2.4 and 2.5.
    """
    width, axis = np.linalg.eigh(covariance)
    turn = np.linspace(0.0, 2.0 * np.pi, 73)
    half = scale * np.sqrt(np.maximum(width, 0.0))
    curve = axis @ (half[:, None] * np.stack([np.cos(turn), np.sin(turn)])) + np.asarray(centre)[:, None]
    axes.plot(*curve, color=look.colour, linestyle=look.linestyle, linewidth=1.1, zorder=4)


def cloud(axes: Axes, points: Array, labels: tuple[str, str]) -> None:
    """Samples (n, 2) and their mean, as Valencia & Andrade-Cetto (2018) fig. 2.5."""
    axes.plot(*points.T, ".", color="#8c8c8c", markersize=2.0, markeredgewidth=0, alpha=0.6, zorder=1)
    axes.plot(*points.mean(axis=0), "o", color="#D55E00", markersize=3.5, markeredgewidth=0, zorder=5)
    axes.set(xlabel=labels[0], ylabel=labels[1])
    _frame(axes)


def image(axes: Axes, pixels: Array) -> None:
    """A grey image (h, w) as it is."""
    axes.imshow(pixels, cmap="gray", vmin=0, vmax=255)
    axes.set_axis_off()


def marginal(axes: Axes, edges: Array, density: Array, grid: Array, linear: Array, fitted: Array) -> None:
    """Histogram of x (edges (n + 1,), density (n,)) and two densities on ``grid`` (g,), per m."""
    axes.stairs(density, edges, fill=True, color="#c4c4c4")
    axes.plot(grid, linear, color=COLOURS[0], linewidth=1.4)
    axes.plot(grid, fitted, color=COLOURS[1], linewidth=1.4, dashes=DASHES[1])
    axes.set(xlabel="x (m)", ylabel="density (1/m)", ylim=(0, None))
    _frame(axes)


def key(figure: Figure, entries: Sequence[tuple[str, Artist]], columns: int, beside: bool = False) -> None:
    """Legend above the axes of ``figure``, or to the right of them; labels are shown literally."""
    place: dict[str, Any] = {"loc": "upper center", "bbox_to_anchor": (0.5, 1.0)}
    if beside:
        place = {"loc": "center left", "bbox_to_anchor": (BESIDE, 0.5)}
    legend = figure.legend(
        [handle for _, handle in entries], [str(i) for i in range(len(entries))], ncols=columns, frameon=False,
        handlelength=2.6, columnspacing=1.4, borderaxespad=0.1, **place,
    )  # fmt: skip
    for text, (label, _) in zip(legend.get_texts(), entries, strict=True):
        text.set_parse_math(False)
        text.set_text(label)


def line(look: Style) -> Line2D:
    """Legend entry of a filter."""
    return Line2D([], [], color=look.colour, linestyle=look.linestyle, linewidth=1.4)


def title(axes: Axes, text: str) -> None:
    """Title shown literally, dollar signs included."""
    axes.set_title(text, loc="left", parse_math=False)


def _log_scale(axes: Axes) -> None:
    axes.set_yscale("log")
    _plain_numbers(axes.yaxis, *axes.get_ylim())


def _plain_numbers(axis: Axis, low: float, high: float) -> None:
    """Labels of a log axis without powers of ten, as many as there is room for."""
    axis.set_major_locator(LogLocator(subs=(1.0,) if high > 200 * low else (1.0, 2.0, 5.0)))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter(NullFormatter())


def _widen(axes: Axes) -> None:
    """A straight path has height too: neither axis spans less than :data:`NARROWEST` of the other."""
    limits = np.array([axes.get_xlim(), axes.get_ylim()])
    spans = np.maximum(np.diff(limits)[:, 0], NARROWEST * np.diff(limits).max())
    low, high = limits.mean(axis=1) - spans / 2, limits.mean(axis=1) + spans / 2
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))


def _frame(axes: Axes) -> None:
    axes.grid(visible=True, color="#ececec", linewidth=0.6, zorder=0)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)
