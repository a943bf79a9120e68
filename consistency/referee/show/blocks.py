"""What a document is made of: text, tables, lists of facts, figures.

Numbers as words and colours are the same in every format, and a colour means one thing: vermilion, green and sky blue
of Okabe & Ito (2008) are verdicts, black is the truth, and no filter has them. Each style has a dash pattern and a
marker of its own as well, so that a grey print still reads.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np

from consistency.referee.diagnostics.number_words import short, with_subject

INTERVAL = re.compile(r"\[([^\s\[\]]+), ([^\s\[\]]+)\]")
SMALLEST = 1e-6  # p value below which digits say nothing
TRUTH, ODOMETRY, BAND = "#000000", "#7f7f7f", "#d9d9d9"
COLOURS = ("#0072B2", "#AA4499", "#8A8A1F", "#332288", "#DD77AA", "#6B4423")  # of filters
OVER, RIGHT, UNDER = "#D55E00", "#009E73", "#56B4E9"  # of the verdicts overconfident, consistent and conservative
# lengths in points, drawn and left out; 5 patterns and 6 colours repeat together only after 30
DASHES: tuple[tuple[float, ...], ...] = (
    (),
    (5.0, 2.0),
    (1.5, 1.5),
    (7.0, 2.0, 1.5, 2.0),
    (3.0, 1.5, 1.0, 1.5, 1.0, 1.5),
)
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "*")  # Matplotlib's names
FEW = 6  # verdicts that have a badge each
SIGMAS = 2.0  # stated standard deviations from 0 to the bounds of an error that are drawn


@dataclass(frozen=True)
class Heading:
    """Title of what follows."""

    text: str
    level: int = 3


@dataclass(frozen=True)
class Text:
    """A paragraph."""

    text: str
    lead: str = ""  # bold words before it
    style: Literal["", "note"] = ""


@dataclass(frozen=True)
class Name:
    """Cell with a filter's name and how it looks."""

    text: str
    look: Look


@dataclass(frozen=True)
class Status:
    """Cell with the word of a verdict."""

    text: str
    note: str = ""  # words after it, without its colour


@dataclass(frozen=True)
class Quantity:
    """Cell with a number and, where it has one, its interval; how both are written is up to a renderer."""

    value: float | None  # None or NaN where there is none
    interval: tuple[float, float] | None = None
    unit: str = ""  # stands after it
    digits: str = ""  # as a format says them, ".3f"; empty: three, as in a sentence
    limit: float = np.inf  # upper over lower end from which on the interval says nothing
    is_factor: bool = False  # something to multiply by
    is_aside: bool = False  # reported and not judged

    @property
    def is_empty(self) -> bool:
        """Whether there is no value; an infinite one is one only without an interval and without digits of its own."""
        if self.value is None or np.isnan(self.value):
            return True
        return np.isinf(self.value) and bool(self.digits or self.interval)


@dataclass(frozen=True)
class Reason:
    """The sentence of a verdict, and the figures behind it; also a cell."""

    name: str
    sentence: str
    others: tuple[str, ...] = ()
    look: Look | None = None
    has_passed: bool = True
    group: str = ""  # what it belongs to, such as a test


@dataclass(frozen=True)
class Answer:
    """Cell with a mark and a number."""

    mark: str
    meaning: str
    text: str
    emphasis: Literal["", "found", "tolerated"] = ""


@dataclass(frozen=True)
class Small:
    """A line in small print under the text of a cell."""

    text: str
    italic: bool = False


@dataclass(frozen=True)
class Stack:
    """Cell with small print under its text."""

    text: str
    below: tuple[Small, ...]
    bold: bool = False


Cell: TypeAlias = str | Name | Status | Answer | Stack | Quantity | Reason


@dataclass(frozen=True)
class Column:
    """Head of a column."""

    head: str
    paper: str = ""  # another head on paper, where a line break is one
    width: str = "auto"  # on paper, as Typst writes it
    number: bool = False  # set at the right
    most: int | None = None  # characters of it on a terminal


@dataclass(frozen=True)
class Table:
    """Rows of cells under heads; the first cell of a row is its name."""

    columns: tuple[Column, ...]
    groups: tuple[tuple[str, tuple[tuple[Cell, ...], ...]], ...]  # title, or none, and rows
    label: str  # what a screen reader says
    caption: str = ""
    style: Literal["", "narrow", "prose", "marks", "grouped", "plain"] = ""
    whole: bool = False  # not broken between pages

    @property
    def rows(self) -> Iterator[tuple[Cell, ...]]:
        return (row for _, rows in self.groups for row in rows)


@dataclass(frozen=True)
class Reasons:
    """Why each filter has its verdict."""

    entries: tuple[Reason, ...]


@dataclass(frozen=True)
class Facts:
    """Names and values."""

    rows: tuple[tuple[str, str], ...]
    heads: tuple[str, str] | None = None  # of the table on paper
    width: str = "3cm"  # of the names on paper


@dataclass(frozen=True)
class Settings:
    """A scenario as JSON text."""

    text: str


@dataclass(frozen=True)
class Details:
    """Blocks that a reader of the page unfolds; on paper, blocks under a heading."""

    summary: str
    blocks: tuple[Facts | Settings | Table | Figure, ...]  # figures are on the page only
    whole: bool = False  # not broken between pages


@dataclass(frozen=True)
class Bullets:
    """Short texts below each other."""

    texts: tuple[str, ...]


@dataclass(frozen=True)
class Figure:
    """Drawings with one caption; each is drawn when a page is made."""

    title: str
    caption: str
    drawings: tuple[Callable[[], Any], ...]  # each gives a figure of Matplotlib
    level: int = 3  # of the heading


@dataclass(frozen=True)
class Switch:
    """A filter that a reader of the page can hide."""

    text: str
    look: Look
    tag: str  # of the filter in one study


Block: TypeAlias = Figure | Heading | Text | Table | Reasons | Facts | Bullets | Settings | Details


@dataclass(frozen=True)
class Chapter:
    """Blocks under one heading of the first level."""

    anchor: str
    title: str
    link: str  # in the contents
    blocks: tuple[Block, ...]
    summary: str = ""
    switches: tuple[Switch, ...] = ()
    on_paper: tuple[Block, ...] | None = None  # in place of the blocks; without any the chapter is left out there

    @property
    def paper(self) -> tuple[Block, ...]:
        """What the PDF shows of the chapter."""
        return self.blocks if self.on_paper is None else self.on_paper


@dataclass(frozen=True)
class Document:
    """All that is said, ready to be shown."""

    title: str
    answer: str
    chapters: tuple[Chapter, ...]
    opening: tuple[Block, ...] = ()  # below the answer, before the contents
    data: Any = None  # the same for programs: names, numbers, texts, arrays and verdicts
    command: str = ""  # by which it is written
    badges: tuple[Status, ...] = ()  # above the answer: the word of each verdict, or how often it was given

    @property
    def parts(self) -> tuple[tuple[Block, ...], ...]:
        """Blocks of the opening, then of each chapter."""
        return (self.opening, *(chapter.blocks for chapter in self.chapters))

    @property
    def paper(self) -> tuple[Chapter, ...]:
        """Chapters as the PDF shows them."""
        return tuple(
            replace(chapter, blocks=chapter.paper, on_paper=None) for chapter in self.chapters if chapter.paper
        )

    @property
    def figures(self) -> tuple[Figure, ...]:
        shown = [block for part in self.parts for block in part]
        unfolded = [inner for block in shown if isinstance(block, Details) for inner in block.blocks]
        return tuple(block for block in (*shown, *unfolded) if isinstance(block, Figure))

    @property
    def reasons(self) -> Iterator[Reason]:
        """What was judged, wherever it stands: in lists of reasons and in the cells of tables."""
        for block in (block for part in self.parts for block in part):
            if isinstance(block, Reasons):
                yield from block.entries
            elif isinstance(block, Table):
                yield from (cell for row in block.rows for cell in row if isinstance(cell, Reason))


def table(columns: tuple[Column, ...], rows: Sequence[tuple[Cell, ...]], label: str, **options: str | bool) -> Table:
    """Table of rows without groups."""
    return Table(columns, (("", tuple(rows)),), label, **options)  # type: ignore[arg-type]


def badges(named: Sequence[tuple[str, str]]) -> tuple[Status, ...]:
    """A badge for each of a few names and words of verdicts; of many, one for each word with how often it was given."""
    if len(named) == 1:
        return (Status(named[0][1]),)
    if len(named) <= FEW:
        return tuple(Status(word, f" {name}") for name, word in named)
    return tuple(Status(word, f" {count}") for word, count in Counter(word for _, word in named).items())


NONE = Quantity(None)


class Signs(NamedTuple):
    """What stands for a number that is none, a factor, infinity, and an end of an interval that is not known."""

    none: str
    factor: str
    infinite: str
    unknown: str


PLAIN = Signs("-", "x", "inf", "nan")  # of a terminal and of text
PRINTED = Signs("–", "×", "∞", "–")


def written(cell: Cell, signs: Signs = PRINTED) -> str:
    """The text of a cell."""
    if isinstance(cell, str):
        return cell
    if isinstance(cell, Reason):
        return cell.sentence
    if isinstance(cell, Answer):
        return f"{cell.mark} {cell.text}"
    if isinstance(cell, Status):
        return cell.text + cell.note
    if not isinstance(cell, Quantity):
        return cell.text
    if cell.is_empty or cell.value is None:
        return signs.none
    text = f"{signs.factor * cell.is_factor}{_digits(cell.value, cell.digits, signs)}{cell.unit}"
    if cell.interval is not None:
        low, high = cell.interval
        if np.isfinite(cell.limit) and low > 1.0 and high >= cell.limit * low:
            return f"at least {signs.factor}{_digits(low, cell.digits, signs)}{cell.unit}"
        ends = "unknown"
        if np.isinf(cell.limit) or high < cell.limit * low:
            ends = f"{_digits(low, cell.digits, signs)}, {_digits(high, cell.digits, signs)}"
        text += f" [{ends}]"
    return f"({text})" if cell.is_aside else text


def _digits(value: float, digits: str, signs: Signs) -> str:
    if np.isnan(value):
        return signs.unknown
    if np.isinf(value):
        return signs.infinite
    if digits:
        return format(float(value), digits)
    return short(value) if value else "0"


def number(value: Any, digits: str) -> str:
    """A number with digits as a format says, or a dash where there is none."""
    return written(Quantity(value, digits=digits))


def brief(value: float | None) -> str:
    """A number in three digits, a dash where there is none."""
    return written(Quantity(value))


def p_cell(p: float) -> str:
    """A p value as a table has it."""
    return "< 1e-6" if p < SMALLEST else f"{p:.2g}"


def unbroken(text: str) -> str:
    """The text, in which no line ends inside an interval or before %."""
    return INTERVAL.sub("[\\1,\u00a0\\2]", text.replace(" %", "\u00a0%"))


# --- blocks ------------------------------------------------------------------------------------------


def fragment(*blocks: Block) -> str:
    """Lines of all blocks; figures and settings are left out."""
    return "\n".join(line for block in blocks for line in _lines(block))


def _lines(block: Block) -> list[str]:
    match block:
        case Reasons():
            lines = []
            for entry in block.entries:
                lines += [with_subject(entry.name, entry.sentence), *(f"  - {other}" for other in entry.others)]
            return lines
        case Facts():
            width = max(len(name) for name, _ in block.rows)
            return [f"  {name:<{width}}  {value}" for name, value in block.rows]
        case Table():
            return _table(block)
        case Bullets():
            return [f"  - {text}" for text in block.texts]
        case Text() | Heading():
            return [block.text]
        case _:
            return []


def _table(table: Table) -> list[str]:
    """Rows in columns; what did not pass is said below its row."""
    rows = [[column.head for column in table.columns]]
    below: list[list[str]] = [[]]
    for cells in table.rows:
        rows.append([written(cell, PLAIN) for cell in cells if not isinstance(cell, Reason)])
        failed = [cell for cell in cells if isinstance(cell, Reason) and not cell.has_passed]
        below.append([f"    {with_subject(cell.name, cell.sentence)}" for cell in failed])
    widths = [max(map(len, column)) for column in zip(*rows, strict=False)]
    lines = []
    for row, more in zip(rows, below, strict=True):
        lines += ["  ".join(text.ljust(width) for text, width in zip(row, widths, strict=False)).rstrip(), *more]
    return lines


@dataclass(frozen=True)
class Look:
    """How a mark or the entry of a legend looks; lengths in points."""

    colour: str
    dash: tuple[float, ...] = ()  # empty: solid
    marker: str = "o"
    width: float = 1.2
    size: float = 4.2  # of a marker
    alpha: float = 1.0
    edge: str = ""  # colour of a marker's outline; empty: none


EXPECTED = Look("#555555", width=0.8)
LIMIT = Look("#333333", (4.0, 3.0), width=0.9)
ZERO = Look("#555555", width=0.5)
ACCEPTED, REJECTED, LOW = Look(RIGHT), Look(OVER, marker="X"), Look(UNDER, marker="v")


def style(index: int) -> Look:
    """Look of the filter with this number; the same number always looks the same."""
    return Look(COLOURS[index % len(COLOURS)], DASHES[index % len(DASHES)], MARKERS[index % len(MARKERS)])


def solid(look: Look) -> Look:
    """A copy of this look without dashes, for panels of one filter each."""
    return replace(look, dash=())
