"""Estimators that were judged on the same runs, as pages show them, and the axis along the runs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from consistency.referee.diagnostics.verdict.verdict import Verdict
from consistency.referee.document.blocks import Switch
from consistency.referee.document.colours import Look, style
from consistency.referee.types import Array, Failure, Indices

if TYPE_CHECKING:
    from matplotlib.axes import Axes

EPOCH = 1e6  # s; times beyond are shown from the first on


@dataclass(frozen=True)
class Clock:
    """A place on the axis for each of T steps."""

    values: Array  # (T,)
    label: str
    word: str  # "s" or "step"
    note: str = ""  # where the clock begins, if not at zero

    def name(self, axes: Axes) -> None:
        """The name of the axis of time, below a panel."""
        axes.set_xlabel(self.label)

    def span(self, axes: Axes) -> None:
        """Draw the axis from zero to the last step."""
        self.name(axes)
        if len(self.values):
            axes.set_xlim(min(0.0, float(self.values[0])), float(self.values[-1]))


def time_axis_of(t: Array) -> Clock:
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


DECADE = 10.0  # values that span more are drawn on a log axis


@dataclass(frozen=True)
class Estimator:
    """One filter or estimator in one study, with the verdict on it."""

    name: str
    style: int  # the same number for the same filter in the whole report
    tag: str  # of the filter in this study, which its checkbox has
    verdict: Verdict
    failures: tuple[Failure, ...]  # of all runs, also of those after the look that decided

    @property
    def look(self) -> Look:
        return style(self.style)

    @property
    def innovations_judged(self) -> bool:
        """Whether the filter declares an optimal gain; innovations of any other are reported only."""
        return self.verdict.innovations is not None and self.verdict.innovations.judged


@dataclass(frozen=True)
class Judged:
    """Estimators that were judged on the same runs."""

    name: str
    summary: str
    runs: int
    shown_run: int  # the one that is drawn where only one can be
    clock: Clock
    steps: Indices  # (T,), 1..T
    tracks: tuple[Estimator, ...]
    until_decided: bool  # each verdict is that of the look that decided it

    @property
    def has_truth(self) -> bool:
        return any(track.verdict.scale is not None for track in self.tracks)

    @property
    def single(self) -> bool:
        """One run: the curve is a NEES, no average."""
        return self.runs == 1

    @property
    def statistic(self) -> str:
        return "NEES" if self.single else "ANEES"

    @property
    def judged(self) -> list[str]:
        """Filters whose innovations are judged."""
        return [track.name for track in self.tracks if track.innovations_judged]

    @property
    def own_errors(self) -> list[str]:
        """Filters that are judged in an error of their own, with its convention."""
        return [f"{t.name} ({t.verdict.convention})" for t in self.tracks if t.verdict.world is not None]

    @property
    def failures(self) -> list[tuple[str, int, int, str]]:
        """Filter, run, step and reason of every failed run."""
        return [
            (track.name, int(failure.run), int(failure.step), failure.reason)
            for track in self.tracks
            for failure in track.failures
        ]

    @property
    def switches(self) -> tuple[Switch, ...]:
        """Filters that a reader can hide."""
        return tuple(Switch(track.name, track.look, track.tag) for track in self.tracks)


def wide(values: list[Array]) -> bool:
    """Whether the values above zero, in arrays of any shape, span more than a decade."""
    flat = np.concatenate([v.ravel() for v in values]) if values else np.empty(0)
    flat = flat[np.isfinite(flat) & (flat > 0)]
    return bool(flat.size) and bool(flat.max() > DECADE * flat.min())
