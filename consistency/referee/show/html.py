"""A document as one HTML file that needs nothing else."""

from __future__ import annotations

import re
from base64 import b64encode
from bisect import bisect_right
from collections.abc import Sequence
from hashlib import sha256

from bokeh.document import Document as BokehDocument
from bokeh.embed import components
from bokeh.resources import Resources
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from consistency.referee.document.blocks import Block, Document
from consistency.referee.document.drawing import LIMIT, Figure, numbers
from consistency.referee.document.wording import written
from consistency.referee.show.with_bokeh import Screen

MAXIMUM = 6_000_000  # bytes of the whole file
SCRIPT = 1_400_000  # bytes of Bokeh itself, style and words
CHART = 16_000  # bytes of a chart before its data
POINT = 5.4  # bytes of one number in base64
SOURCES = "SOURCES-OF-SCRIPTS"  # in the template, until all scripts are there
SCRIPTS = re.compile(r"<script\b([^>]*)>(.*?)</script>", re.DOTALL)
LEAST = 120  # points a line below which a curve is no curve


def render_html(document: Document) -> str:
    """The whole page: style, script, data and words in one string."""
    limit = points_a_line(document)
    drawn = [_charts(part, limit) for part in document.parts]
    charts = {key: markup for _, found in drawn for key, markup in found.items()}
    scripts = [script for script, found in drawn if found]
    longest = max((row[0] for row in _rows(document)), default=0)
    environment = Environment(
        loader=PackageLoader("consistency.referee.show"), autoescape=True, undefined=StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    environment.filters |= {"kind": lambda block: type(block).__name__, "written": written}
    page = environment.get_template("report.html.j2").render(
        document=document,
        chart=lambda panel: charts[id(panel)],
        chart_scripts=scripts,
        thinned=limit if longest > limit else None,
        bokeh=Markup(Resources(mode="inline", components=["bokeh"]).render()) if scripts else "",
        script_sources=Markup(SOURCES),
    )
    return page.replace(SOURCES, " ".join(_sources(page)), 1)


def _sources(page: str) -> list[str]:
    """What the Content-Security-Policy allows to run: the scripts of the page as they are, by their hashes.

    Data in scripts of a type of their own (application/json) are not run.
    """
    texts = [text for kind, text in SCRIPTS.findall(page) if "json" not in kind]
    return [f"'sha256-{b64encode(sha256(text.encode()).digest()).decode()}'" for text in texts] or ["'none'"]


def _charts(part: Sequence[Block], limit: int) -> tuple[Markup, dict[int, Markup]]:
    """The script of all charts of a chapter, and the place of each panel, by its id."""
    panels = [panel for block in part if isinstance(block, Figure) for panel in block.panels]
    if not panels:
        return Markup(), {}
    screen = Screen(limit)
    roots = [screen.draw(panel) for panel in panels]
    # one document a chapter, its models collected once: Bokeh walks through a whole document for every chart added
    bokeh = BokehDocument()
    with bokeh.models.freeze():
        for root in roots:
            bokeh.add_root(root)
    script, places = components(roots)
    return Markup(script), {id(panel): Markup(place) for panel, place in zip(panels, places, strict=True)}


def _rows(document: Document) -> list[tuple[int, int]]:
    """Length and number of columns of what is drawn."""
    return [row for figure in document.figures for panel in figure.panels for row in map(numbers, panel.marks)]


def points_a_line(document: Document) -> int:
    """Points that a line may have so that the file stays below its greatest size."""
    rows = _rows(document)
    room: float = MAXIMUM - SCRIPT - CHART * sum(len(figure.panels) for figure in document.figures)

    def size(limit: int) -> float:
        return POINT * sum(columns * min(length, limit) for length, columns in rows)

    return LEAST + bisect_right(range(LEAST + 1, LIMIT + 1), room, key=size)
