"""What a document is made of: text, tables, lists of facts, figures."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np

if TYPE_CHECKING:
    from consistency.referee.document.colours import Look


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
    blocks: tuple[Facts | Settings | Table, ...]
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
    data: Any = None  # the same for programs: names, numbers, texts and arrays

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
        return tuple(block for part in self.parts for block in part if isinstance(block, Figure))

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
