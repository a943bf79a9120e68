"""What the referee asked and found, as a report shows it: the records of verdicts in order, nothing worked out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from consistency.diagnostics import Answer, Verdict
from consistency.diagnostics.coverage import TWO_SIGMA
from consistency.diagnostics.questions import ABOUT
from consistency.reporting.model import Study, Track
from consistency.reporting.plots import Interval
from consistency.types import Array

WHOLE, DIRECTION = "all axes", "worst direction"
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


@dataclass(frozen=True)
class Lags:
    """Autocorrelation of the innovations."""

    values: Array  # (lags,), of lag 1, 2, ...
    bound: float | None  # that 95 % of the lags stay within, if white; None where they are not judged


def asked(study: Study) -> list[tuple[str, str, list[Answer | None]]]:
    """Question, what is compared, and each filter's answer (None: could not be asked), in the referee's order."""
    by_filter = [{a.question: a for a in track.verdict.answers} for track in study.tracks]
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
    study: Study, read: Callable[[Verdict], dict[str, Interval]]
) -> tuple[tuple[str, tuple[Interval | None, ...]], ...]:
    by_filter = [{k: i for k, i in read(t.verdict).items() if np.isfinite(i[0])} for t in study.tracks]
    names = dict.fromkeys(name for intervals in by_filter for name in intervals)
    return tuple((name, tuple(intervals.get(name) for intervals in by_filter)) for name in names)


def _ratios(v: Verdict) -> dict[str, Interval]:
    found: dict[str, Interval] = {}
    if v.axes is not None:
        found |= v.axes.inflation
        if v.axes.largest is not None:
            found[DIRECTION] = v.axes.largest
    if v.scale is not None:
        found[WHOLE] = v.scale.inflation
    return {name: interval for name, interval in found.items() if interval[0] > 0}


def _biases(v: Verdict) -> dict[str, Interval]:
    return {} if v.bias is None else dict(v.bias.by_axis)


def _coverages(v: Verdict) -> dict[str, Interval]:
    if v.accuracy is None or v.axes is None:
        return {}
    rows = zip(v.axes.names, v.accuracy.coverage_one_step, v.accuracy.coverage_interval, strict=True)
    return {axis: (100.0 * float(share), 100.0 * float(low), 100.0 * float(high)) for axis, share, (low, high) in rows}


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
    tails = track.verdict.tails
    if tails is None or not len(tails.pit) or not np.isfinite(tails.half_width):
        return None
    values, height = tails.pit, np.arange(1, len(tails.pit) + 1) / len(tails.pit)
    rows = keep(values)
    x, y = (np.concatenate([[0.0], column[rows], [1.0]]) for column in (values, height))
    return Steps(x, y, tails.half_width)


def lags(track: Track) -> Lags | None:
    """Autocorrelation of lag 1, 2, ...; None with too few innovations."""
    found = track.verdict.innovations
    if found is None or not len(found.autocorrelation) or not np.isfinite(found.autocorrelation).all():
        return None
    return Lags(found.autocorrelation, found.bound if found.judged else None)
