"""What the referee asked and found, as a report shows it: the statistics of verdicts in order, nothing worked out."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from consistency.diagnostics.coverage import TWO_SIGMA
from consistency.diagnostics.questions import ABOUT
from consistency.plots import Interval
from consistency.reporting.model import Study, Track
from consistency.types import Array

WHOLE = "all axes"
FAR = 30.0  # an interval that reaches further than this factor beyond all values is cut off


@dataclass(frozen=True)
class Forest:
    """One quantity of the axes, with intervals."""

    name: str
    label: str  # of the axis with its unit
    form: str  # of a number
    expected: float
    window: tuple[float, float]  # drawn range
    log: bool
    rows: tuple[tuple[str, tuple[Interval | None, ...]], ...]  # an axis, and an interval or None a filter

    def only(self) -> tuple[tuple[str, tuple[Interval | None, ...]], ...]:
        """The rows that hold something."""
        return tuple(row for row in self.rows if any(row[1]))

    def roomy(self) -> tuple[float, float]:
        """The drawn range with room for arrows at its ends."""
        low, high = self.window
        if self.log:
            room = (high / low) ** 0.03
            return low / room, high * room
        return low - 0.03 * (high - low), high + 0.03 * (high - low)


@dataclass(frozen=True)
class Steps:
    """Empirical distribution function of N values between 0 and 1, and its simultaneous band."""

    x: Array  # (N + 2,), with 0 and 1
    y: Array  # (N + 2,)
    half_width: float


def asked(study: Study) -> list[tuple[str, str, list[dict[str, Any] | None]]]:
    """Question, what is compared, and each filter's answer (None: could not be asked), in the referee's order."""
    by_filter = [{a["question"]: a for a in track.verdict.statistics.get("answers", ())} for track in study.tracks]
    known = list(ABOUT) + [q for answers in by_filter for q in answers if q not in ABOUT]
    questions = [q for q in dict.fromkeys(known) if any(q in answers for answers in by_filter)]
    return [(q, ABOUT.get(q, ""), [answers.get(q) for answers in by_filter]) for q in questions]


def forests(study: Study) -> tuple[Forest, ...]:
    """Covariance ratio, bias and coverage by axis; those that no filter has are left out."""
    made = (
        ("ratio", "covariance ratio (truth / stated)", ".3g", 1.0, _ratio_window, True, _ratios),
        ("bias", "mean error (stated sigma)", "+.2f", 0.0, _bias_window, False, _biases),
        ("coverage", "within 2 sigma (%)", ".0f", 100.0 * TWO_SIGMA, _coverage_window, False, _coverages),
    )
    result = []
    for name, label, form, expected, window, log, read in made:
        rows = _rows(study, read)
        if rows:
            intervals = [i for _, row in rows for i in row if i is not None]
            result.append(Forest(name, label, form, expected, window(intervals), log, rows))
    return tuple(result)


def aligned(parts: tuple[Forest, ...]) -> list[str]:
    """Labels of all rows, in one order."""
    names = dict.fromkeys(name for part in parts for name, _ in part.rows)
    return sorted(names, key=lambda name: name == WHOLE)


def _rows(
    study: Study, read: Callable[[Mapping[str, Any]], dict[str, Interval]]
) -> tuple[tuple[str, tuple[Interval | None, ...]], ...]:
    by_filter = [{k: i for k, i in read(t.verdict.statistics).items() if np.isfinite(i[0])} for t in study.tracks]
    names = dict.fromkeys(name for intervals in by_filter for name in intervals)
    return tuple((name, tuple(intervals.get(name) for intervals in by_filter)) for name in names)


def _ratios(s: Mapping[str, Any]) -> dict[str, Interval]:
    found = {name: _interval(*values) for name, values in s.get("of_axes", {}).items()}
    if "ratio" in s:
        found[WHOLE] = _interval(s["ratio"], *s.get("ratio_interval", (0.0, np.inf)))
    return {name: interval for name, interval in found.items() if interval[0] > 0}


def _biases(s: Mapping[str, Any]) -> dict[str, Interval]:
    return {axis: _interval(*values) for axis, values in s.get("bias", {}).items()}


def _coverages(s: Mapping[str, Any]) -> dict[str, Interval]:
    if "coverage_one_step" not in s or "coverage_interval" not in s:
        return {}
    rows = zip(s["axes"], s["coverage_one_step"], s["coverage_interval"], strict=True)
    return {axis: _interval(*(100.0 * float(v) for v in (share, *ends))) for axis, share, ends in rows}


def _interval(value: float, low: float, high: float) -> Interval:
    return float(value), float(low), float(high)


def _ratio_window(intervals: list[Interval]) -> tuple[float, float]:
    values = [value for value, _, _ in intervals] + [1.0]
    ends = [end for interval in intervals for end in interval if np.isfinite(end) and end > 0] + [1.0]
    return max(min(ends), min(values) / FAR) / 1.3, min(max(ends), max(values) * FAR) * 1.3


def _bias_window(intervals: list[Interval]) -> tuple[float, float]:
    most = 3.0 * max(abs(value) for value, _, _ in intervals) + 3.0
    ends = [float(np.clip(end, -most, most)) for interval in intervals for end in interval if np.isfinite(end)]
    room = 0.06 * (max([*ends, 0.0]) - min([*ends, 0.0])) or 1.0
    return min([*ends, 0.0]) - room, max([*ends, 0.0]) + room


def _coverage_window(intervals: list[Interval]) -> tuple[float, float]:
    return max(min(low for _, low, _ in intervals) - 5.0, -3.0), 103.0


def steps(track: Track, keep: Callable[[Array], Array]) -> Steps | None:
    """Empirical distribution of chi-square's distribution function at the NEES; ``keep`` chooses rows to draw."""
    values = np.asarray(track.verdict.statistics.get("pit", ()), float)
    half = float(track.verdict.statistics.get("pit_half_width", np.nan))
    if not len(values) or not np.isfinite(half):
        return None
    height = np.arange(1, len(values) + 1) / len(values)
    rows = keep(values)
    return Steps(np.concatenate([[0.0], values[rows], [1.0]]), np.concatenate([[0.0], height[rows], [1.0]]), half)


def lags(track: Track) -> tuple[Array, float] | None:
    """Autocorrelation of lag 1, 2, ... and the bound of each."""
    values = np.asarray(track.verdict.statistics.get("autocorrelation", ()), float)
    if not len(values) or not np.isfinite(values).all():
        return None
    return values, float(track.verdict.statistics["autocorrelation_bound"])
