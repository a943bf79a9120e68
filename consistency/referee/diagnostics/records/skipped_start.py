"""The first steps of each run left out of the statistics: a start that is not meant to be judged.

Values of skipped steps are NaN, so that every other step keeps its number. Alignment and time offsets use them before.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from consistency.referee.diagnostics.records.large_arrays import every_entry
from consistency.referee.types import Array

FORMS = "a whole number of steps (20) or seconds (2s)"
ROUNDING = 1e-6  # s: a double holds the seconds since 1970 to a quarter of that


@dataclass(frozen=True)
class Skip:
    """Length of the beginning of each run that is left out."""

    size: float
    unit: str = "step"  # or "s"

    @property
    def option(self) -> str:
        """Value of the option: 20, 2s."""
        if self.unit == "s":
            return f"{self.size:g}s"
        return f"{self.size:g}"

    @property
    def text(self) -> str:
        """The first 20 steps, the first 2 s."""
        if self.unit == "s":
            return f"the first {self.size:g} s"
        if self.size == 1:
            return "the first step"
        return f"the first {self.size:g} steps"

    def mask(self, shape: tuple[int, int], t: Array | None = None) -> Array:
        """Which of (runs, steps) are left out, of bool.

        Steps are counted from 1 as in sentences. Seconds are counted from the first time of each run; the step at their
        end is kept.

        Parameters
        ----------
        t : (steps,) or (runs, steps), s, NaN where a run has no step

        Raises
        ------
        ValueError
            Seconds are asked for, and a run has no times.
        """
        if self.unit == "step":
            return np.broadcast_to(np.arange(1, shape[1] + 1) <= self.size, shape)
        if t is None:
            t = np.full(shape, np.nan)
        times = np.broadcast_to(t, shape)
        is_known = np.isfinite(times)
        if not is_known.any(axis=1).all():
            raise ValueError(f"skip {self.option}: there are no times; give a number of steps, as --skip 20")
        start = times[np.arange(shape[0]), np.argmax(is_known, axis=1)]
        with np.errstate(invalid="ignore"):
            return np.asarray(times - start[:, None] < self.size - ROUNDING)


@dataclass(frozen=True)
class Skipped:
    """The steps that were left out."""

    skip: Skip
    steps: int  # of the run that lost most
    empty: int = 0  # runs of which nothing is left


def skip_of(given: str | float | Skip | None) -> Skip | None:
    """Parse the value of ``--skip``, such as 20 or "2s"; None for nothing.

    Raises
    ------
    ValueError
        It is neither a number of steps nor of seconds.
    """
    if given is None or isinstance(given, Skip):
        return given
    match = re.fullmatch(r"\s*(\d+|\d*\.\d+|\d+\.\d*)\s*(s?)\s*", str(given))
    if match is None or isinstance(given, bool) or not (match[2] == "s" or match[1].isdigit()):
        raise ValueError(f"skip {given}: must be {FORMS}")
    size = float(match[1])
    if size == 0:
        return None
    return Skip(size, match[2] or "step")


def without_first(
    skip: Skip | None, arrays: Mapping[str, Any], name: str, t: Array | None = None
) -> tuple[dict[str, Any], Skipped | None]:
    """Arrays over (runs, steps, ...) of one estimator without the first steps, and the record of those steps.

    Errors need not be among them: where covariance and NEES are NaN they do not count.

    Parameters
    ----------
    arrays : covariances, NEES, NIS, innovations, by any name; those that end in "dof"
        become 0, the others NaN. None is passed over.
    t : as in :meth:`Skip.mask`

    Raises
    ------
    ValueError
        Nothing is left, or seconds are asked for and there are no times.
    """
    given = {key: np.asarray(value) for key, value in arrays.items() if value is not None}
    if skip is None or not given:
        return dict(arrays), None
    runs, steps = next(iter(given.values())).shape[:2]
    mask = skip.mask((int(runs), int(steps)), t)
    counted = np.zeros(mask.shape, bool)
    for key, value in given.items():
        if value.ndim == 4:
            counted |= every_entry(np.isfinite, value)
        elif not key.endswith("dof"):
            counted |= np.isfinite(value).all(axis=tuple(range(2, value.ndim)))
    left = (counted & ~mask).any(axis=1)
    if not left.any():
        last = int(np.flatnonzero(counted.any(axis=0)).max(initial=-1)) + 1
        raise ValueError(f"skip {skip.option}: nothing of {name} is left, whose last step is {last}; leave out less")
    rest = dict(arrays)
    for key, value in given.items():
        beside = mask.reshape(*mask.shape, *[1] * (value.ndim - 2))
        if key.endswith("dof"):
            rest[key] = np.where(beside, np.asarray(0, value.dtype), value)
        else:
            rest[key] = np.where(beside, np.asarray(np.nan, value.dtype), value)
    return rest, Skipped(skip, int(mask.sum(axis=1).max()), int((counted.any(axis=1) & ~left).sum()))
