"""Numbers as words, the same in every format."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from consistency.referee.diagnostics.wording import short

SMALLEST = 1e-6  # p value below which digits say nothing


def number(value: Any, form: str) -> str:
    """A number, or a dash where there is none."""
    return "–" if value is None or not np.isfinite(value) else format(float(value), form)


def brief(value: float | None) -> str:
    """A number in three digits, a dash where there is none."""
    if value is None or np.isnan(value):
        return "–"
    if value == 0 or not np.isfinite(value):
        return "∞" if value else "0"
    return short(value)


def p_cell(p: float) -> str:
    """A p value as a table has it."""
    return "< 1e-6" if p < SMALLEST else f"{p:.2g}"


def listed(words: Sequence[str]) -> str:
    """a, b and c."""
    return " and ".join([", ".join(words[:-1]), words[-1]]) if len(words) > 1 else "".join(words)
