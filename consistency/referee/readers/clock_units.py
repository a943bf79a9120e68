"""Units of timestamps: told by their size, or by two files that have nothing in common."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from consistency.referee.errors import InputError
from consistency.referee.types import Array

UNIT_NAMES = {1: "seconds", 10**3: "milliseconds", 10**6: "microseconds", 10**9: "nanoseconds"}
EPOCHS = ((1e17, 10**9), (1e14, 10**6), (1e11, 10**3))  # times since 1970 are larger than this in ns, us and ms


def unit_of(t: Array, unit: int | None = None) -> int:
    """How many units of times are a second: what their name says, or what times since 1970 are large enough for."""
    if unit is not None:
        return unit
    middle = float(np.median(np.abs(t))) if len(t) else 0.0
    return next((each for least, each in EPOCHS if middle > least), 1)


def unit_apart(t: Array, other_t: Array, names: Sequence[Path | str]) -> str:
    """Which of two files seems to have times in another unit than seconds, as the end of a sentence; "" of neither."""
    units = unit_of(t), unit_of(other_t)
    for unit in sorted(UNIT_NAMES, reverse=True):  # the smallest that makes them overlap, 1 where they do
        if _overlap(t / unit, other_t):
            units = unit, 1
        elif _overlap(t, other_t / unit):
            units = 1, unit
    if units[0] == units[1]:
        return ""
    return f"; {names[units[0] < units[1]]} seems to be in {UNIT_NAMES[max(units)]}, and has to be in seconds"


def _overlap(t: Array, other_t: Array) -> bool:
    return bool(t[0] <= other_t[-1] and t[-1] >= other_t[0])


def nothing_near(
    files: Sequence[Path | str], t: Array, other_t: Array, tolerance: float, what: str, of: str
) -> InputError:
    """Message that no time ``t`` of one file is near one of the other."""
    own, other = (f"{each[0]:.15g} to {each[-1]:.15g}" for each in (t, other_t))
    where = f"t is {own}, but {other} in {files[1]}{unit_apart(t, other_t, files)}"
    return InputError(f"{files[0]}: no {what} has a {of} within {tolerance:g} s (--max-dt): {where}")
