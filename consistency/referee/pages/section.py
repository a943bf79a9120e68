"""A section of a report: how it reads results into a record, and the blocks that show the record."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

from consistency.referee.document.blocks import Block

Source = TypeVar("Source")
Record = TypeVar("Record")


@dataclass(frozen=True)
class Part:
    """Heading of the first level that sections stand under."""

    anchor: str
    title: str
    link: str  # in the contents


OPENING = Part("", "", "")  # below the answer, before the contents
STUDY = Part("study", "", "")  # stands once for each study, under its name
FRONT_END = Part("front-end", "Stereo front-end", "Stereo front-end")


@dataclass(frozen=True)
class Section(Generic[Source, Record]):
    """One section.

    ``read`` takes a :class:`~consistency.bench.pages.report_input.Study` where ``part`` is ``STUDY``, else a
    :class:`~consistency.bench.pages.report_input.Report`. It gives a record, or None where the section does not apply.
    ``show`` gives the blocks of a record: figures with their captions, tables, text.
    """

    part: Part
    read: Callable[[Source], Record | None]
    show: Callable[[Record], tuple[Block, ...]]

    def blocks(self, source: Source) -> tuple[Block, ...]:
        """What the section shows of ``source``; nothing where it does not apply."""
        record = self.read(source)
        return () if record is None else self.show(record)
