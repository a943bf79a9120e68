"""Axis along the runs: seconds where steps have a time, otherwise steps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from consistency.referee.document.drawing import Axis
from consistency.referee.types import Array

EPOCH = 1e6  # s; times beyond are shown from the first on


@dataclass(frozen=True)
class Clock:
    """A place on the axis for each of T steps."""

    values: Array  # (T,)
    label: str
    word: str  # "s" or "step"
    note: str = ""  # where the clock begins, if not at zero

    @property
    def axis(self) -> Axis:
        """Shared by all panels along the runs."""
        return Axis(self.label, share="clock")

    @property
    def whole(self) -> Axis:
        """Axis over the range from zero to the last step."""
        last = float(self.values[-1]) if len(self.values) else 1.0
        return Axis(self.label, window=(min(0.0, float(self.values[:1].sum())), last), share="clock")

    @property
    def tips(self) -> tuple[tuple[str, str], ...]:
        """Time and step of a point whose columns hold ``step``."""
        return (("step", "@step"),) if self.word == "step" else (("time", "@x{0.00} s"), ("step", "@step"))


def clock_of(t: Array) -> Clock:
    """Seconds from the first step on, or steps where not all have an increasing time.

    Parameters
    ----------
    t : (T,), s; NaN where a step has none
    """
    if not len(t) or not np.isfinite(t).all() or (np.diff(t) <= 0.0).any():
        return Clock(np.arange(1.0, len(t) + 1), "step", "step")
    if abs(t[0]) < EPOCH:
        return Clock(t, "time (s)", "s")
    return Clock(t - t[0], "time (s)", "s", f" Time 0 is {t[0]:.2f} s.")
