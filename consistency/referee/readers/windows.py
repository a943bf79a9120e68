"""Windows of a log that are judged: consecutive ones of a number of steps, seconds or metres."""

from __future__ import annotations

import math
import re
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from consistency.referee.errors import InputError
from consistency.referee.types import Array, Indices

UNITS = {"": "step", "s": "s", "m": "m"}
FORMS = "a whole number of steps (100), seconds (10s) or metres along the true path (50m)"
ROUNDING = 1e-6  # of steps, s or m: a double holds the seconds since 1970 to a quarter of that
MARGINAL = (
    "covariances of two poses do not tell that of the motion between them; give their cross-covariances, or motions "
    "with --motions (docs/files.md, Relative poses)"
)
OVERSHOOT = 0.5  # of its size that a window may be too long, where rows or truth are missing


@dataclass(frozen=True)
class Relative:
    """Division of a log into windows, and the content of its file."""

    size: float
    unit: str  # step | s | m
    motions: bool = False  # each row is the motion since the row before, and errors of motions are independent
    independent: bool = False  # errors of windows are declared to be independent
    flag: str = "--relative"  # option that names the size, for messages

    @property
    def text(self) -> str:
        """100 steps, 10 s, 50 m."""
        unit = self.unit
        if unit == "step" and self.size != 1:
            unit = "steps"
        return f"{self.size:g} {unit}"

    @property
    def option(self) -> str:
        """Value of the option: 100, 10s, 50m."""
        if self.unit == "step":
            return f"{self.size:g}"
        return f"{self.size:g}{self.unit}"


def relative_of(size: str | float | None, motions: bool = False, windows: str | None = None) -> Relative | None:
    """Parse ``--relative``, ``--motions`` and ``--windows``; None without the first.

    Raises
    ------
    InputError
        The size is not valid, or another of the options is given without it.
    """
    if windows not in (None, "independent"):
        raise InputError(f"--windows must be 'independent', got '{windows}'")
    if size is None:
        if motions:
            raise InputError(
                "--motions: motions share no world with the truth; judge them with --relative 1, 10s or 50m"
            )
        if windows is not None:
            raise InputError("--windows goes with --relative, which cuts a log into windows")
        return None
    match = re.fullmatch(r"\s*([0-9.eE+-]+)\s*([sm]?)\s*", str(size))
    value = math.nan
    unit = "step"
    if match:
        unit = UNITS[match[2]]
        with suppress(ValueError):
            value = float(match[1])
    if not (math.isfinite(value) and value > 0) or (unit == "step" and value % 1):
        raise InputError(f"--relative {size}: must be {FORMS}")
    return Relative(value, unit, motions, motions or windows is not None)


def windows(t: Array, position: Array, rows: Indices, relative: Relative, file: str) -> tuple[Indices, Indices, int]:
    """First and last row (W,) of consecutive windows, and how many were left out because rows are missing.

    A window begins where the one before ends, and ends at the first row that is far enough. Steps, time and the true
    path decide, never an estimate, so that the choice does not depend on the errors.

    Parameters
    ----------
    t : (N,), s, NaN where it is not known
    position : (k, d), true positions at ``rows``, m
    rows : (k,), rows whose truth is known, increasing
    file : name of the file, for messages

    Raises
    ------
    InputError
        No window fits, or seconds are asked for and rows have no time.
    """
    place = _along(t, position, rows, relative, file)
    first = []
    last = []
    skipped = i = 0
    while (j := int(np.searchsorted(place, place[i] + relative.size - ROUNDING))) < len(place):
        if place[j] - place[i] > (1.0 + OVERSHOOT) * relative.size:
            skipped += 1
        else:
            first.append(rows[i])
            last.append(rows[j])
        i = j
    if not first:
        raise InputError(_none(place, relative, file))
    return np.array(first, np.int64), np.array(last, np.int64), skipped


def _along(t: Array, position: Array, rows: Indices, relative: Relative, file: str) -> Array:
    if relative.unit == "step":
        return rows.astype(float)
    if relative.unit == "s":
        if not np.isfinite(t[rows]).all():
            raise InputError(f"{file}: {relative.flag} {relative.option} needs a column t, in s")
        return t[rows]
    steps = np.linalg.norm(np.diff(position, axis=0), axis=1)
    return np.append(0.0, np.cumsum(steps))


def _none(place: Array, relative: Relative, file: str) -> str:
    length = float(place[-1] - place[0])
    unit = {"step": " steps"}.get(relative.unit, f" {relative.unit}")
    if length < relative.size - ROUNDING:
        return f"{file}: {relative.flag} {relative.option}: only {length:.4g}{unit} have truth; ask for shorter windows"
    gap = float(np.median(np.diff(place)))
    return (
        f"{file}: {relative.flag} {relative.option}: rows with truth are {gap:.4g}{unit} apart in the median; "
        "ask for longer windows, or give a truth of a higher rate"
    )
