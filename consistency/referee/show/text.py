"""Blocks as plain text: ``print`` of a verdict, and the summary of a test session."""

from __future__ import annotations

from consistency.referee.diagnostics.words.numbers import with_subject
from consistency.referee.document.blocks import Block, Bullets, Facts, Heading, Reason, Reasons, Table, Text
from consistency.referee.document.wording import PLAIN, written


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
