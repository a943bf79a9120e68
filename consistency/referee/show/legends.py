"""Legends, titles and grids on paper. Text is shown literally."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import Any

from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.axis import Axis as TickAxis
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import LogLocator, NullFormatter

from consistency.referee.document.colours import Look
from consistency.referee.document.drawing import Key, Sheet

LINE = 0.16  # inches, a line of a legend
SMALL = 0.14  # inches, a line of the legend of one panel
BESIDE = 0.66  # of the figure's width is left of a legend that stands beside the axes
WIDE = 200.0  # a log axis that spans more has room for powers of ten only


def stroke(look: Look) -> dict[str, Any]:
    """How Matplotlib draws a line of this look."""
    return {"color": look.colour, "linestyle": (0.0, look.dash) if look.dash else "-", "linewidth": look.width}


def dots(look: Look) -> dict[str, Any]:
    """How Matplotlib draws the markers of this look."""
    return {
        "linestyle": "", "marker": look.marker, "color": look.colour, "markersize": look.size, "alpha": look.alpha,
        "markeredgecolor": look.edge or look.colour, "markeredgewidth": 1.0 if look.edge else 0.0,
    }  # fmt: skip


def title(axes: Axes, text: str) -> None:
    """Title shown literally, dollar signs included."""
    axes.set_title(text, loc="left", parse_math=False)


def wrapped(label: str, width: int = 26) -> str:
    """The label in lines of at most ``width`` characters."""
    return "\n".join(textwrap.wrap(label, width)) or label


def plain_numbers(axis: TickAxis, low: float, high: float) -> None:
    """Labels of a log axis without powers of ten, as many as there is room for."""
    axis.set_major_locator(LogLocator(subs=(1.0,) if high > WIDE * low else (1.0, 2.0, 5.0)))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter(NullFormatter())


def frame(axes: Axes) -> None:
    """Grid behind the marks, and no lines at the top and the right."""
    axes.grid(visible=True, color="#ececec", linewidth=0.6, zorder=0)
    axes.set_axisbelow(True)
    axes.spines[["top", "right"]].set_visible(False)


def legend(figure: Figure, sheet: Sheet) -> None:
    """Legend in room that the layout leaves above the axes, or to their right."""
    labels = [wrapped(key.text) for key in sheet.keys]
    longest = max(len(line) for label in labels for line in label.split("\n"))
    columns = 1 if sheet.beside else max(1, min(len(labels), 5, int(118 / (longest + 9))))
    tall = [label.count("\n") + 1 for label in labels]
    lines = sum(tall) if sheet.beside else -(-len(labels) // columns) * max(tall)
    room, height = LINE * lines + 0.06, figure.get_figheight()
    # the axes keep their size: a long legend makes the figure taller
    height = max(height, room) if sheet.beside else height + room - LINE
    figure.set_figheight(height)
    engine: Any = figure.get_layout_engine()
    engine.set(rect=(0, 0, BESIDE, 1) if sheet.beside else (0, 0, 1, 1 - room / height))
    place: dict[str, Any] = {"loc": "upper center", "bbox_to_anchor": (0.5, 1.0)}
    if sheet.beside:
        place = {"loc": "center left", "bbox_to_anchor": (BESIDE, 0.5)}
    drawn = figure.legend(
        [_handle(key) for key in sheet.keys], [str(i) for i in range(len(labels))], ncols=columns, frameon=False,
        handlelength=2.6, columnspacing=1.4, borderaxespad=0.1, **place,
    )  # fmt: skip
    _literally(drawn, labels)


def panel_labels(keys: Sequence[Key], width: float) -> tuple[list[str], int, int]:
    """Entries of the legend of one panel that is ``width`` inches wide, in how many columns, and lines of all."""
    labels = [wrapped(key.text, 34) for key in keys]
    longest = max((len(line) for label in labels for line in label.split("\n")), default=0)
    columns = max(1, min(len(labels), int(19 * width / (longest + 9))))
    tallest = max((label.count("\n") + 1 for label in labels), default=0)
    return labels, columns, -(-len(labels) // columns) * tallest


def panel_legend(axes: Axes, keys: Sequence[Key], labels: Sequence[str], columns: int) -> None:
    """Legend above one panel; the layout makes room for it."""
    if not keys:
        return
    drawn = axes.legend(
        [_handle(key) for key in keys], [str(i) for i in range(len(keys))], ncols=columns, frameon=False,
        loc="lower left", bbox_to_anchor=(0.0, 1.0), handlelength=2.0, columnspacing=1.0, borderaxespad=0.1,
        borderpad=0.1, labelspacing=0.2, fontsize=6.5,
    )  # fmt: skip
    _literally(drawn, labels)


def _literally(drawn: Legend, labels: Sequence[str]) -> None:
    for text, label in zip(drawn.get_texts(), labels, strict=True):
        text.set_parse_math(False)
        text.set_text(label)


def _handle(key: Key) -> Artist:
    if key.kind == "band":
        return Patch(color=key.look.colour)
    if key.kind == "points":
        return Line2D([], [], **dots(key.look))
    options = stroke(key.look)
    if key.marked:
        options |= {"marker": key.look.marker, "markersize": key.look.size}
    return Line2D([], [], **options)
