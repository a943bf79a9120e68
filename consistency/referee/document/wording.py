"""Numbers as words, the same in every format, and blocks as plain text."""

from __future__ import annotations

import re
from typing import Any, NamedTuple

import numpy as np

from consistency.referee.diagnostics.words.numbers import short, with_subject
from consistency.referee.document.blocks import (
    Answer,
    Block,
    Bullets,
    Cell,
    Facts,
    Heading,
    Quantity,
    Reason,
    Reasons,
    Status,
    Table,
    Text,
)

NONE = Quantity(None)
INTERVAL = re.compile(r"\[([^\s\[\]]+), ([^\s\[\]]+)\]")
SMALLEST = 1e-6  # p value below which digits say nothing


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
    return _quantity(cell, signs) if isinstance(cell, Quantity) else cell.text


def _quantity(q: Quantity, signs: Signs) -> str:
    if q.is_empty or q.value is None:
        return signs.none
    text = f"{signs.factor * q.is_factor}{_digits(q.value, q.digits, signs)}{q.unit}"
    if q.interval is not None:
        low, high = q.interval
        if np.isfinite(q.limit) and low > 1.0 and high >= q.limit * low:
            return f"at least {signs.factor}{_digits(low, q.digits, signs)}{q.unit}"
        known = np.isinf(q.limit) or high < q.limit * low
        text += f" [{', '.join(_digits(end, q.digits, signs) for end in (low, high)) if known else 'unknown'}]"
    return f"({text})" if q.is_aside else text


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
