"""How figures look, on a canvas of Matplotlib in the style of the reports, and figures as files.

Files are SVG for pages, PNG for notebooks, and what a user asks for. Sections draw on the axes directly; text is shown
literally. A mark with a ``tag`` belongs to a filter, whose checkbox hides it on a page. Matplotlib is loaded when the
first figure is drawn.
"""

from __future__ import annotations

import logging
import os
import re
import sys
import textwrap
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from html import escape, unescape
from importlib.util import find_spec
from io import BytesIO
from itertools import pairwise
from types import ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np

from consistency.referee.show.blocks import BAND, Document, Look
from consistency.referee.types import Array, Indices

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

LIMIT = 300  # points of a line
WIDTH = 5.0  # inches, the widest figure
FILTER, TITLE = "filter:", "title:"  # begin the identifier of what a checkbox hides, and of what has words to hover
NARROWEST = 0.15  # span of one axis of a map over that of the other, at least: room for the tick labels
WIDE = 200.0  # a log axis that spans more has room for powers of ten only
UNNAMED = re.compile(r"_child\d+|_nolegend_|")  # labels that Matplotlib gives
RC: Any = {
    "font.family": "DejaVu Sans", "font.size": 6.5, "axes.titlesize": 7, "axes.labelsize": 6.5, "legend.fontsize": 6.5,
    "axes.titlelocation": "left", "axes.linewidth": 0.6, "xtick.major.width": 0.6, "ytick.major.width": 0.6,
    "axes.grid": True, "grid.color": "#ececec", "grid.linewidth": 0.6, "axes.axisbelow": True, "axes.spines.top": False,
    "axes.spines.right": False, "axes.formatter.useoffset": False, "figure.constrained_layout.use": True,
    "legend.frameon": False, "legend.handlelength": 2.6, "legend.columnspacing": 1.4, "legend.borderaxespad": 0.1,
    "text.parse_math": False, "svg.fonttype": "none", "path.simplify": True,
}  # fmt: skip
POINTS = 72  # in an inch, the resolution of an SVG
MOST_TITLES = 300  # on a page
GROUP = re.compile(r'<g id="([^"]*)">')
PLACES = re.compile(r' (?:x|y|width|height|transform)="[^"]*"|<path d="[^"]*"')
STYLE = '<defs><style type="text/css">*{stroke-linejoin: round; stroke-linecap: butt}</style></defs>'  # of Matplotlib
NUMBER = re.compile(r"-?\d+\.\d+")
CURVED = re.compile("[CQ]")
UPRIGHT = re.compile(r' transform="rotate\(-0 [^"]*"')
Pictures = dict[int, tuple[str, ...]]  # SVG of each drawing of a figure, by the figure's id


@contextmanager
def own_style(**more: Any) -> Iterator[None]:
    """Draw in the style of the reports and with ``more`` parameters, whatever the user has set for other figures."""
    mpl = _matplotlib()
    with mpl.rc_context():
        mpl.rcdefaults()
        mpl.rcParams.update(RC | more)
        yield


def _matplotlib() -> ModuleType:
    """Import Matplotlib, though the user's files or ``MPLBACKEND`` name what is not there; reports need no backend."""
    if "matplotlib" in sys.modules:
        return sys.modules["matplotlib"]
    backend = os.environ.get("MPLBACKEND")
    disabled = logging.root.manager.disable
    try:
        logging.disable(logging.CRITICAL)  # what Matplotlib says of a matplotlibrc
        if backend is not None:
            os.environ["MPLBACKEND"] = "agg"
        import matplotlib as mpl
    finally:
        logging.disable(disabled)
        if backend is not None:
            os.environ["MPLBACKEND"] = backend
    if backend:
        with suppress(ValueError):
            mpl.rcParams["backend"] = backend
    return mpl


def canvas(
    height: float, columns: int = 1, panels: int = 1, stacked: bool = False, *, width: float = WIDTH, **shared: Any
) -> tuple[Figure, list[Axes]]:
    """A figure with so many panels in rows of ``columns``, and their axes.

    Parameters
    ----------
    height, width : inches
    stacked : the panels follow each other downwards, column by column
    **shared : of :meth:`matplotlib.figure.Figure.subplots`, such as ``sharex``
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height))
    rows = -(-panels // columns)
    grid = figure.subplots(rows, columns, squeeze=False, **shared)
    axes = list(grid.T.flat if stacked else grid.flat)
    for empty_panel in axes[panels:]:
        empty_panel.set_axis_off()
    if shared.get("sharex"):  # a panel with none below it has numbers on its axis
        for number, panel in enumerate(axes[:panels]):
            below = number + 1 if stacked and (number + 1) % rows else number + (panels if stacked else columns)
            panel.tick_params(labelbottom=below >= panels)
    return figure, axes[:panels]


def with_small_ones(height: float, many: int) -> tuple[Figure, list[Axes]]:
    """A figure of one panel and so many square ones in two rows at its right, and their axes."""
    from matplotlib.figure import Figure

    figure, columns = Figure(figsize=(WIDTH, height)), -(-many // 2)
    left, right = figure.subfigures(1, 2, width_ratios=(2.5, columns), squeeze=False)[0]
    grid = right.add_gridspec(2, columns)
    return figure, [left.subplots(), *(right.add_subplot(grid[k % 2, k // 2]) for k in range(many))]


def rows_of(panels: int) -> int:
    """Panels in a row, of some that are alike."""
    return 2 if panels in (2, 4) else min(3, panels)


def stroke(look: Look) -> dict[str, Any]:
    """How Matplotlib draws a line of this look."""
    style: Any = "-"
    if look.dash:
        style = (0.0, look.dash)
    return {"color": look.colour, "linestyle": style, "linewidth": look.width}


def dots(look: Look) -> dict[str, Any]:
    """How Matplotlib draws the markers of this look."""
    return {
        "linestyle": "", "marker": look.marker, "color": look.colour, "markersize": look.size, "alpha": look.alpha,
        "markeredgecolor": look.edge or look.colour, "markeredgewidth": float(bool(look.edge)),
    }  # fmt: skip


def owned(tag: str) -> str | None:
    """Identifier of what the checkbox of a filter hides."""
    return FILTER + tag if tag else None


# --- marks --------------------------------------------------------------------------------------------


def thin(*lines: Array, limit: int = LIMIT) -> Indices:
    """Rows to keep of lines (T,) on one axis, at most about ``limit``; all where there are fewer.

    The rows are cut into equal pieces, and each piece keeps where every line has its least and its
    greatest value, so that no peak is lost. The first and the last row stay.
    """
    steps = len(lines[0])
    if steps <= limit:
        return np.arange(steps)
    pieces = max(1, (limit - 2) // (2 * len(lines)))
    edges = np.linspace(0, steps, pieces + 1).astype(np.int64)
    keep = {0, steps - 1}
    for start, end in pairwise(edges):
        for line in lines:
            piece = line[start:end]
            if np.isfinite(piece).any():
                keep |= {start + int(np.nanargmin(piece)), start + int(np.nanargmax(piece))}
            else:
                keep.add(int(start))
    return np.array(sorted(keep), dtype=np.int64)


def curve(axes: Axes, x: Array, y: Array, look: Look, label: str = "", tag: str = "", **options: Any) -> None:
    """A line through N points (N,); the row of a NaN is a gap."""
    rows = thin(y)
    axes.plot(x[rows], y[rows], label=label, gid=owned(tag), **stroke(look), **options)


def path(axes: Axes, points: Array, look: Look, label: str = "", tag: str = "") -> None:
    """A line through points (N, 2) that goes back and forth."""
    x, y = points.T
    rows = thin(x, y)
    axes.plot(x[rows], y[rows], label=label, gid=owned(tag), **stroke(look))


def band(axes: Axes, x: Array, ends: Array, label: str = "", colour: str = BAND) -> None:
    """Shading between the two columns of ``ends`` (N, 2)."""
    rows = thin(ends[:, 1])
    low, high = ends[rows].T
    axes.fill_between(x[rows], low, high, color=colour, linewidth=0, zorder=0.5, label=label)


def edges(axes: Axes, x: Array, ends: Array, look: Look, label: str = "", tag: str = "") -> None:
    """The two columns of ``ends`` (N, 2) as lines."""
    low, high = ends.T
    curve(axes, x, low, look, label, tag)
    curve(axes, x, high, look, "", tag)


def points(axes: Axes, x: Array, y: Array, look: Look, label: str = "", tag: str = "", limit: int = LIMIT) -> None:
    """N small round points as one path, which takes little room in a file; ``look`` has their size."""
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path

    rows = thin(y, limit=limit)
    rows = rows[np.isfinite(x[rows]) & np.isfinite(y[rows])]
    places = np.repeat(np.column_stack([x[rows], y[rows]]).astype(float), 2, axis=0)
    if not len(places):
        places = np.full((2, 2), np.nan)
    places[1::2, 0] += 1e-7 * (np.ptp(places[:, 0]) or 1.0)  # what has no length at all is left out of a PNG
    codes = np.tile([Path.MOVETO, Path.LINETO], len(places) // 2)
    shape = Path(places, codes)
    shape.should_simplify = False
    axes.add_patch(PathPatch(
        shape, fill=False, edgecolor=look.colour, linewidth=look.size, capstyle="round", alpha=look.alpha,
        label=label, gid=owned(tag), zorder=2.0, snap=False,
    ))  # fmt: skip
    axes.autoscale_view()


def intervals(axes: Axes, y: Array, ends: Array, look: Look, label: str = "", tag: str = "") -> None:
    """Lying intervals (N, 3) of value, low and high; an end beyond the drawn range of x becomes an arrow."""
    start, end = axes.get_xlim()
    value, low, high = ends.T
    left, right = np.clip(low, start, end), np.clip(high, start, end)
    gid = owned(tag)
    bars = axes.hlines(y, left, right, color=look.colour, linewidth=look.width, gid=gid, zorder=2.0)
    bars.set_capstyle("butt")
    for edge, beyond, arrow in ((left, low < start, "<"), (right, high > end, ">")):
        for rows, marker in ((~beyond, "|"), (beyond, arrow)):
            if rows.any():
                axes.plot(edge[rows], y[rows], marker, color=look.colour, markersize=4.0, clip_on=False, gid=gid)
    axes.plot(value, y, label=label, gid=gid, **dots(look))


def dodge(slot: int, slots: int) -> float:
    """Place of a filter beside the others, from -0.5 to 0.5 around a common mark."""
    return 0.76 * ((slot + 0.5) / slots - 0.5)


# --- axes ---------------------------------------------------------------------------------------------


def name_rows(axes: Axes, labels: Sequence[str]) -> None:
    """Rows with names, from the top; every second one on a darker ground."""
    for row in range(1, len(labels), 2):
        axes.axhspan(row - 0.5, row + 0.5, color="#f5f5f5", linewidth=0, zorder=0)
    axes.set(ylim=(len(labels) - 0.5, -0.5), yticks=range(len(labels)))
    axes.set_yticklabels([wrapped(label, 24) for label in labels])
    axes.tick_params(axis="y", length=0)
    axes.grid(visible=False, axis="y")


def log_axis(axes: Axes, side: str) -> None:
    """A log axis with plain numbers, as many as there is room for; called when all is drawn."""
    from matplotlib.ticker import LogLocator, NullFormatter

    axes.set(**{f"{side}scale": "log"})
    low, high = getattr(axes, f"get_{side}lim")()
    ticks = getattr(axes, f"{side}axis")
    parts: tuple[float, ...] = (1.0, 2.0, 5.0)
    if high > WIDE * low:
        parts = (1.0,)
    ticks.set_major_locator(LogLocator(subs=parts))
    ticks.set_major_formatter("{x:g}")
    ticks.set_minor_formatter(NullFormatter())


def make_map(axes: Axes) -> None:
    """One metre is as long on both axes; a straight path has height too."""
    limits = np.array([axes.get_xlim(), axes.get_ylim()])
    spans = np.diff(limits)[:, 0]
    spans = np.maximum(spans, NARROWEST * spans.max())
    low, high = limits.mean(axis=1) - spans / 2, limits.mean(axis=1) + spans / 2
    axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    axes.set_aspect("equal", adjustable="box")


def say(axes: Axes, text: str) -> None:
    """Words in the middle of a panel, in place of values."""
    axes.text(0.5, 0.5, text, transform=axes.transAxes, ha="center", va="center")


def wrapped(label: str, width: int = 26) -> str:
    """The label in lines of at most ``width`` characters."""
    return "\n".join(textwrap.wrap(label, width)) or label


# --- legends ------------------------------------------------------------------------------------------


def add_legend(figure: Figure, beside: bool = False) -> Figure:
    """A legend of all that has a label, above the axes or to their right; the figure is made larger for it."""
    found = labelled(figure.axes)
    if not found:
        return figure
    labels = [wrapped(label) for label in found]
    options: dict[str, Any] = {"loc": "outside right center"}
    if not beside:
        longest = max(len(line) for label in labels for line in label.split("\n"))
        columns = max(1, min(len(labels), int(17.5 * figure.get_figwidth() / (longest + 7))))
        rows = -(-len(labels) // columns)
        columns = -(-len(labels) // rows)  # Matplotlib fills columns; the last row is nearly as long as the others
        lines = rows * max(label.count("\n") + 1 for label in labels)
        figure.set_figheight(figure.get_figheight() + 0.13 * lines)
        options = {"loc": "outside upper left", "ncols": columns, "alignment": "left"}
    # a legend leaves out labels that begin with an underscore, so it gets numbers first
    legend = figure.legend([_handle(artist) for artist in found.values()], list(map(str, range(len(found)))), **options)
    for text, handle, label, artist in zip(
        legend.get_texts(), legend.legend_handles, labels, found.values(), strict=True
    ):
        text.set_text(label)
        for part in (text, handle):
            if part is not None:  # an entry is hidden with what it stands for
                part.set_gid(artist.get_gid())
    return figure


def labelled(panels: Sequence[Axes]) -> dict[str, Artist]:
    """What has a label, each label once."""
    found: dict[str, Artist] = {}
    for axes in panels:
        for artist in (*axes.collections, *axes.patches, *axes.lines):
            label = str(artist.get_label())
            if not UNNAMED.fullmatch(label):
                found.setdefault(label, artist)
    return found


def _handle(artist: Any) -> Artist:
    """What stands for the artist in a legend."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch, PathPatch

    if isinstance(artist, Line2D):
        return artist
    if isinstance(artist, PathPatch):  # small points
        return Line2D([], [], linestyle="", marker="o", markersize=3.0, color=artist.get_edgecolor())
    return Patch(color=artist.get_facecolor(), alpha=artist.get_alpha())


def paint(document: Document) -> Pictures:
    """All figures of a document; none where Matplotlib is not installed."""
    if find_spec("matplotlib") is None:
        return {}
    titles = Titles()
    return {
        id(figure): tuple(svg(draw, f"{number}-{part}", titles) for part, draw in enumerate(figure.drawings))
        for number, figure in enumerate(document.figures)
    }


class Titles:
    """Counts the words to hover of a page: browsers slow down with many."""

    def __init__(self, most: int = MOST_TITLES) -> None:
        self.left = most

    def markup(self, words: str) -> str:
        """A title element, or nothing once the page has enough of them."""
        self.left -= 1
        return f"<title>{escape(unescape(words))}</title>" if self.left >= 0 else ""


def svg(draw: Callable[[], Figure], name: str = "figure", titles: Titles | None = None) -> str:
    """A drawing as compact SVG whose text is text; the same drawing of the same name gives the same characters.

    Parameters
    ----------
    name : tells what the drawing refers to from that of the other drawings of a page
    """
    with own_style():
        from matplotlib.backends.backend_svg import FigureCanvasSVG

        figure = draw()
        # laid out here and not by savefig, which draws everything once more for that
        figure.set_dpi(POINTS)
        FigureCanvasSVG(figure)
        engine: Any = figure.get_layout_engine()
        engine.execute(figure)
        figure.set_layout_engine("none")
    for patch in (figure.patch, *(axes.patch for axes in figure.axes)):
        patch.set_visible(False)  # the ground is that of the page
    return _compact(saved(figure, "svg", name=name).decode("utf-8"), figure.get_figwidth(), titles or Titles())


def png(draw: Callable[[], Figure], resolution: int = 200) -> bytes:
    """A drawing as PNG."""
    return saved(drawn(draw), "png", resolution)


def drawn(draw: Callable[[], Figure]) -> Figure:
    """A drawing in the style of the reports, as a figure of Matplotlib."""
    with own_style():
        return draw()


def saved(figure: Figure, kind: str, resolution: int = 200, name: str = "figure") -> bytes:
    """A figure as PNG, PDF or SVG, without date and software; ``name`` is that of :func:`svg`."""
    without: dict[str, dict[str, None]] = {
        "png": {"Software": None}, "pdf": {"CreationDate": None},
        "svg": dict.fromkeys(("Date", "Creator", "Format", "Type")),
    }  # fmt: skip
    buffer = BytesIO()
    with warnings.catch_warnings(), own_style(**{"svg.hashsalt": name}):
        # a name in a script that the font lacks is drawn as boxes; the tables of the page show it
        warnings.filterwarnings("ignore", message="Glyph .* missing from font")
        figure.savefig(buffer, format=kind, dpi=resolution, metadata=without[kind])
    return buffer.getvalue()


def _compact(text: str, width: float, titles: Titles) -> str:
    """The SVG element with its width in inches, coordinates to a tenth of a point, classes of filters, and titles."""

    def group(match: re.Match[str]) -> str:
        name = match[1]
        if name.startswith(FILTER):
            return f'<g class="filter-{name.removeprefix(FILTER)}">'
        if name.startswith(TITLE):
            return f"<g>{titles.markup(name.removeprefix(TITLE))}"
        return "<g>"

    def rounded(match: re.Match[str]) -> str:
        places = NUMBER.sub(lambda number: f"{float(number[0]):.1f}".removesuffix(".0"), match[0])
        if places.startswith("<path") and not CURVED.search(places):
            places = places.replace("L ", "")  # what follows a move are lines
        return places

    text = re.sub(r"\s+", " ", text[text.index("<svg") :]).replace("> <", "><")
    text = text.replace("<svg ", f'<svg style="--inches: {width:g}" stroke-linejoin="round" ', 1).replace(STYLE, "")
    text = UPRIGHT.sub("", text)
    return PLACES.sub(rounded, GROUP.sub(group, text))
