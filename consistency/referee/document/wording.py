"""Numbers as words, the same in every format."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from consistency.referee.diagnostics.words.numbers import short
from consistency.referee.document.blocks import Answer, Cell, Quantity, Reason, Status

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


def listed(words: Sequence[str]) -> str:
    """a, b and c."""
    return " and ".join([", ".join(words[:-1]), words[-1]]) if len(words) > 1 else "".join(words)
