"""Figures as files: SVG for a page and for Typst, PNG for notebooks, and what a user asks for."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable
from html import escape, unescape
from importlib.util import find_spec
from io import BytesIO
from typing import TYPE_CHECKING, Any

from consistency.referee.document.blocks import Document
from consistency.referee.show.matplotlib_style import FILTER, TITLE, WIDTH, own_style

if TYPE_CHECKING:
    from matplotlib.figure import Figure

POINTS = 72  # in an inch, the resolution of an SVG
MOST_TITLES = 300  # on a page
GROUP = re.compile(r'<g id="([^"]*)">')
PLACES = re.compile(r' (?:x|y|width|height|transform)="[^"]*"|<path d="[^"]*"')
STYLE = '<defs><style type="text/css">*{stroke-linejoin: round; stroke-linecap: butt}</style></defs>'  # of Matplotlib
NUMBER = re.compile(r"-?\d+\.\d+")
CURVED = re.compile("[CQ]")
UPRIGHT = re.compile(r' transform="rotate\(-0 [^"]*"')
Pictures = dict[int, tuple[str, ...]]  # SVG of each drawing of a figure, by the figure's id


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
    kind = "narrow" if figure.get_figwidth() < WIDTH else "full"
    return _compact(saved(figure, "svg", name=name).decode("utf-8"), kind, titles or Titles())


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


def _compact(text: str, kind: str, titles: Titles) -> str:
    """The SVG element with coordinates to a tenth of a point, classes of filters, and titles."""

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
    text = text.replace("<svg ", f'<svg class="{kind}" stroke-linejoin="round" ', 1).replace(STYLE, "")
    text = UPRIGHT.sub("", text)
    return PLACES.sub(rounded, GROUP.sub(group, text))
