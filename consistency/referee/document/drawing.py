"""What a figure shows, described once for two painters: ``with_bokeh`` and ``with_matplotlib`` in ``show``.

A figure has panels, a panel has two axes and marks on them, in the order in which they are drawn. Nothing here draws
and nothing is worked out, but which points are left out; all records are plain data.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Literal, TypeAlias

import numpy as np

from consistency.referee.document.colours import Look
from consistency.referee.types import Array, Indices

LIMIT = 2000  # points a line: more than a chart is wide in pixels


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


Tips: TypeAlias = tuple[tuple[str, str], ...]  # what is pointed at, and its value with @column{digits} for numbers
Columns: TypeAlias = Mapping[str, Array | Sequence[str]]
Side: TypeAlias = Literal["x", "y"]


@dataclass(frozen=True)
class Owner:
    """The filter that a mark belongs to: a checkbox of the page hides all its marks."""

    name: str
    tag: str  # of the filter in one study


@dataclass(frozen=True)
class Line:
    """Curve through N points; the row of a NaN is a gap."""

    x: Array  # (N,)
    y: Array  # (N,)
    look: Look
    owner: Owner | None = None
    tips: Tips = ()
    columns: Columns = field(default_factory=dict)  # (N,) each, for the tips beside x, y and bound
    bound: Array | None = None  # (N,), drawn as two dashed lines at plus and minus bound
    path: bool = False  # x goes back and forth
    steps: bool = False  # y stays until the next x


@dataclass(frozen=True)
class Points:
    """Markers at N points."""

    x: Array  # (N,)
    y: Array  # (N,)
    look: Look
    owner: Owner | None = None
    tips: Tips = ()
    columns: Columns = field(default_factory=dict)
    whole: bool = False  # every point is drawn, however many


@dataclass(frozen=True)
class Stems:
    """Markers at N points, each with a line down to zero."""

    x: Array  # (N,)
    y: Array  # (N,)
    look: Look
    owner: Owner | None = None
    tips: Tips = ()
    columns: Columns = field(default_factory=dict)


@dataclass(frozen=True)
class Intervals:
    """Values with intervals, lying; an end beyond the window of the x axis becomes an arrow."""

    y: Array  # (N,)
    x: Array  # (N,), the values
    low: Array  # (N,), may be infinite
    high: Array
    look: Look
    owner: Owner | None = None
    tips: Tips = ()
    columns: Columns = field(default_factory=dict)


@dataclass(frozen=True)
class Band:
    """Region between two curves: shaded, or with ``outline`` its two edges."""

    x: Array  # (N,)
    low: Array  # (N,)
    high: Array
    look: Look
    owner: Owner | None = None
    outline: bool = False


@dataclass(frozen=True)
class Bars:
    """Histogram of N bars."""

    edges: Array  # (N + 1,)
    height: Array  # (N,)
    look: Look
    tips: Tips = ()  # may name @left, @right and @height


@dataclass(frozen=True)
class Tiles:
    """Coloured squares around N points of whole numbers, with two lines of text in each."""

    x: Array  # (N,)
    y: Array  # (N,)
    text: tuple[str, ...]  # (N,)
    below: tuple[str, ...]  # (N,), smaller
    faces: tuple[str, ...]  # (N,), colours
    inks: tuple[str, ...]  # (N,), of the text
    tips: Tips = ()
    columns: Columns = field(default_factory=dict)


@dataclass(frozen=True)
class Rule:
    """Line across the whole panel at one value of an axis."""

    side: Side
    at: float
    look: Look


@dataclass(frozen=True)
class Span:
    """Shading across the whole panel between two values of an axis."""

    side: Side
    low: float
    high: float
    look: Look


Mark: TypeAlias = Line | Points | Stems | Intervals | Band | Bars | Tiles | Rule | Span


@dataclass(frozen=True)
class Axis:
    """One axis of a panel."""

    label: str
    short: str = ""  # label on paper, where panels are small
    log: bool = False
    window: tuple[float, float] | None = None  # drawn range; None: what the marks need
    start: float | None = None  # least value drawn
    most: float | None = None  # on paper: greatest value drawn, at most
    least: float = 0.0  # of the drawn range, at least
    follows: bool = False  # on a screen the range is that of the filters that are shown
    share: str = ""  # axes of one name move together
    rows: tuple[str, ...] = ()  # names at 0, 1, ... from the top
    names: tuple[str, ...] = ()  # names at 0, 1, ... from the left
    ticks: tuple[float, ...] = ()
    whole: bool = False  # ticks at whole numbers only
    digits: tuple[int, ...] = ()  # of a log axis on a screen: leading digits of its ticks, written out


@dataclass(frozen=True)
class Panel:
    """Marks on one pair of axes."""

    x: Axis
    y: Axis
    marks: tuple[Mark, ...]
    alt: str  # what a screen reader says
    height: int = 280  # pixels
    shape: Literal["", "map", "square"] = ""  # narrower than the page
    equal: bool = False  # one metre is as long on both axes
    title: str = ""
    empty: str = ""  # said on paper in place of values where there are none
    keys: tuple[Key, ...] = ()  # on paper: a legend of its own above the panel

    @property
    def has_values(self) -> bool:
        return any(np.isfinite(mark.y).any() for mark in self.marks if isinstance(mark, Line | Points | Stems | Tiles))


@dataclass(frozen=True)
class Key:
    """Entry of a legend."""

    text: str
    look: Look
    kind: Literal["line", "band", "points"] = "line"
    marked: bool = False  # a line with the marker on it
    owner: Owner | None = None


@dataclass(frozen=True)
class Sheet:
    """Panels side by side on paper."""

    panels: tuple[Panel, ...]
    height: float  # inches
    width: float = 6.7  # inches, the text width of the page
    columns: int = 0  # panels in a row; 0: all in one
    widths: tuple[float, ...] = ()  # of the panels, relative
    title: str = ""
    keys: tuple[Key, ...] = ()
    beside: bool = False  # the legend stands to the right of the panels, not above


@dataclass(frozen=True)
class Figure:
    """A figure with its caption: panels for a screen, and the same marks arranged on sheets for paper."""

    title: str
    caption: str
    panels: tuple[Panel, ...]
    sheets: tuple[Sheet, ...]
    keys: tuple[Key, ...] = ()
    layout: Literal["", "pair", "three"] = ""  # panels beside each other on a wide screen
    level: int = 3  # of the heading
    stacked: bool = False  # one sheet under the other, on the next page if need be
    paper: str = ""  # another caption on paper


def xy(points: Array) -> tuple[Array, Array]:
    """Columns of points (N, 2)."""
    return points[:, 0], points[:, 1]


def dodge(slot: int, slots: int) -> float:
    """Place of a filter beside the others, from -0.5 to 0.5 around a common mark."""
    return 0.76 * ((slot + 0.5) / slots - 0.5)


def kept(mark: Line | Points | Band, limit: int) -> Indices:
    """Rows of a mark that are drawn, about ``limit``, its extremes kept."""
    if isinstance(mark, Band):
        return thin(mark.high, limit=limit)
    if isinstance(mark, Points) and mark.whole:
        return np.arange(len(mark.y))
    lines = [mark.y]
    if isinstance(mark, Line):
        lines += [mark.x] if mark.path else []
        lines += [] if mark.bound is None else [mark.bound]
    return thin(*lines, limit=limit)


def numbers(mark: Mark) -> tuple[int, int]:
    """Length and number of the columns that a mark needs on a screen."""
    match mark:
        case Rule() | Span():
            return 0, 0
        case Bars():
            return len(mark.height), 3
        case Band():
            return len(mark.x), 3
    own = {Tiles: 6, Intervals: 4}.get(type(mark), 2) + 2 * (isinstance(mark, Line) and mark.bound is not None)
    return len(mark.x), own + len(mark.columns)
