"""Comparison of the consistency of two filters: run by run on the same trials, or against a stored baseline."""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import special

from consistency.referee.defaults import CONFIDENCE, DETECT, FALSE_ALARM, POWER
from consistency.referee.diagnostics.nees import Contrast, contrast, margin
from consistency.referee.diagnostics.record import Record, numbered_axes
from consistency.referee.diagnostics.scale import run_means
from consistency.referee.diagnostics.whitening import by_runs
from consistency.referee.types import Array, Indices

FEWEST = 8  # runs; below, a standard error is worth nothing
MOST = 10**15  # runs that a plan asks for; where these do not suffice, nothing does


@dataclass(frozen=True)
class RunSummary:
    """Data of a filter for a comparison, with one row for each run. NaN where a run has no value."""

    runs: Indices  # (R,), run numbers
    dof: int
    nees: Array  # (R,), mean NEES over dof
    squared: Array  # (R, n) or (R, 0), mean squared error of each axis
    covered: Array  # (R, n) or (R, 0), share of steps within 2 sigma
    kind: str = ""  # what the NEES are of, if not of errors and covariances; only the same kinds are compared


@dataclass(frozen=True)
class Difference:
    """Difference of two filters in one quantity, with its confidence interval."""

    name: str
    a: float
    b: float
    difference: float  # a against b: a ratio for ANEES and RMSE, a difference for coverage
    low: float
    high: float


class FailedRuns(NamedTuple):
    """Number of failed runs of each filter."""

    a: int
    b: int


@dataclass(frozen=True)
class Comparison:
    """``a`` against ``b``; worse means farther from consistent, in either direction."""

    runs: int
    paired: bool
    differences: tuple[Difference, ...]
    distance: float  # abs(log ratio_a) - abs(log ratio_b); above 0 a is farther from consistent
    standard_error: float  # of log ratio_a - log ratio_b: of the distance where both err to the same side
    p_value: float  # that a is not worse
    false_alarm: float
    at_most: float = float("inf")  # upper limit of the distance with confidence 1 - false_alarm
    sum_error: float = 0.0  # standard error of log ratio_a + log ratio_b
    reference: float = 0.0  # lower limit of abs(log ratio_b) with confidence 1 - false_alarm
    side: float = 0.0  # -1 where the p value is of an a that is farther off because its covariance is too large, or 1

    @property
    def conservative(self) -> bool:
        """Whether the p value is for an ``a`` that is farther off because its covariance is too large."""
        return self.side < 0.0

    @property
    def unseen(self) -> float:
        """Upper limit (95 %) of the share of a kind of run that does not occur among these runs."""
        return float(1.0 - 0.05 ** (1.0 / self.runs))

    @property
    def worse(self) -> bool:
        """Whether ``a`` is less consistent than ``b`` at the stated false-alarm rate."""
        return self.p_value <= self.false_alarm

    def needed_runs(self, detect: float = DETECT, power: float = POWER) -> int:
        """Runs with which a covariance ratio farther from 1 by ``detect`` is found with ``power``.

        Planned with the test of :func:`compare` and the spread between these runs, for an ``a`` that errs to the side
        to which ``b`` errs. Both logarithms have to be significant, so each may be missed with (1 - ``power``) / 2.
        If these runs already show that ``a`` is not farther by ``detect``, their own number is returned.
        """
        least = abs(float(np.log(detect)))
        sizes = (self.standard_error, least), (self.sum_error, least + 2.0 * self.reference)
        needed = max(_planned(error, self.runs, size, self.false_alarm, power) for error, size in sizes)
        if self.at_most < least:
            return min(needed, self.runs)
        return needed


def summary(
    nees: Array,
    dof: int,
    error: Array | None = None,
    covariance: Array | None = None,
    runs: Indices | None = None,
    kind: str = "",
) -> RunSummary:
    """One row for each run, from NEES (runs, steps) and, where known, error and covariance."""
    means, _ = run_means(nees)
    squared = covered = np.empty((len(nees), 0))
    if error is not None and covariance is not None:
        both = by_runs(_squared_and_covered, np.asarray(nees), np.asarray(error), np.asarray(covariance))
        squared = both[:, 0]
        covered = both[:, 1]
    if runs is None:
        runs = np.arange(len(nees))
    return RunSummary(runs, dof, means / dof, squared, covered, kind)


def summary_of_runs(record: Record) -> RunSummary:
    """A row for each run of a record that has NEES; numbers of ensembles have no RMSE, and say what they are."""
    nees = record.errors.nees
    assert nees is not None
    world = record.in_world.errors
    table = record.table()
    if record.errors.ensemble is None or table is None:
        return summary(nees, record.errors.dof, world.error, world.covariance, record.run_numbers)
    kind = (
        f"numbers of {record.errors.ensemble.members} members, in which a covariance ratio of 2 shows as "
        f"{table.mean_square(2.0):.2f}"
    )
    return summary(nees, record.errors.dof, runs=record.run_numbers, kind=kind)


def _squared_and_covered(nees: Array, error: Array, covariance: Array) -> Array:
    """Mean squared error and share of steps within 2 sigma of each axis, (runs, 2, n)."""
    counted = np.isfinite(nees)
    with np.errstate(invalid="ignore"):  # a variance below zero covers nothing
        sigma = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
    inside = np.abs(np.where(counted[..., None], error, 0.0)) <= 2.0 * np.where(counted[..., None], sigma, 0.0)
    count = counted.sum(axis=1)[:, None]
    with np.errstate(invalid="ignore", divide="ignore"):
        squared = np.where(counted[..., None], np.square(error), 0.0).sum(axis=1) / count
        covered = np.where(counted[..., None], inside, False).sum(axis=1) / count
    return np.stack([squared, covered], axis=1)


def compare(
    a: RunSummary,
    b: RunSummary,
    false_alarm: float = FALSE_ALARM,
    axes: tuple[str, ...] | None = None,
    paired: bool | None = None,
    confidence: float = CONFIDENCE,
) -> Comparison:
    """Paired intervals of the ratio of ANEES and RMSE and the difference of coverage, and a verdict on 'worse'.

    Runs are the unit. The same run numbers are the same trials (common random numbers) and are compared run by
    run; ``paired=False`` treats the runs as independent samples (Welch 1947). Ratios are studentised on
    the log scale with the jackknife's first-order influence of each run (Efron & Stein 1981) and Student's t.

    'Worse' compares abs(log ratio) with ratio = ANEES / dof: too small and too large a covariance count alike. It is
    an intersection-union test (Berger 1982) in both directions: ``a`` is worse if log ratio_a > log ratio_b and
    log ratio_a > -log ratio_b, or if both hold with < in place of >. For each direction the larger of its two one-sided
    p values counts, and the p value is twice the smaller of the two. So the false-alarm rate is ``false_alarm`` at most
    wherever the ratios are, and half of it where both filters err to the same side. The one-sided tests are those of
    ``consistency.referee.diagnostics.nees``.

    The comparison is of expectations. No such test holds for every distribution with heavy tails (Bahadur & Savage
    1956): if rare runs with a large NEES are missing from the sample, a covariance looks larger than it is. So a result
    that ``a`` is worse because it is ``conservative`` is valid only for run means without such tails.

    Parameters
    ----------
    axes : names of the components
    paired : default: wherever both have at least 8 runs in common

    Raises
    ------
    ValueError
        Different dimensions, too few runs, or ``paired`` without common runs; a filter whose NEES are all 0.
    """
    if a.dof != b.dof:
        raise ValueError(f"the errors have {a.dof} and {b.dof} dimensions; compare filters of the same state")
    if a.kind != b.kind:
        kinds = (one.kind or "errors with covariances" for one in (a, b))
        raise ValueError(f"{' cannot be compared with '.join(kinds)}; give both with as many members")
    common = np.intersect1d(a.runs[np.isfinite(a.nees)], b.runs[np.isfinite(b.nees)])
    if paired is None:
        paired = len(common) >= FEWEST
    which = ""
    if paired:
        which = " in common"
        a = _rows(a, np.isin(a.runs, common))
        b = _rows(b, np.isin(b.runs, common))
    else:
        a = _rows(a, np.isfinite(a.nees))
        b = _rows(b, np.isfinite(b.nees))
    fewest = min(len(a.runs), len(b.runs))
    if fewest < FEWEST:
        raise ValueError(f"a comparison needs at least {FEWEST} runs{which}, got {fewest}")
    differences = [_ratio("ANEES", a.nees * a.dof, b.nees * b.dof, 1.0, paired, confidence)]
    n = min(a.squared.shape[1], b.squared.shape[1])
    names = numbered_axes(n)
    if axes is not None and len(axes) == n:
        names = axes
    for i, axis in enumerate(names):
        differences.append(_ratio(f"RMSE {axis}", a.squared[:, i], b.squared[:, i], 0.5, paired, confidence))
    for i, axis in enumerate(names):
        differences.append(_share(f"2-sigma coverage {axis}", a.covered[:, i], b.covered[:, i], paired, confidence))
    for side, x in (("a", a), ("b", b)):
        if not x.nees.mean() > 0:
            raise ValueError(f"every NEES of {side} is 0; a filter without errors cannot be compared")
    gap, total = (contrast(a.nees, b.nees, sign, paired) for sign in (-1.0, 1.0))
    above, below = (max(p) for p in zip(gap.p_values, total.p_values, strict=True))
    log_a = 0.5 * (total.value + gap.value)
    log_b = 0.5 * (total.value - gap.value)
    tail = 0.5 * false_alarm
    width = 0.5 * (total.half_width(tail) + gap.half_width(tail))  # of log_b, at most
    return Comparison(
        runs=fewest, paired=paired, differences=tuple(differences), distance=abs(log_a) - abs(log_b),
        standard_error=gap.error, p_value=min(1.0, 2.0 * min(above, below)), false_alarm=false_alarm,
        at_most=_at_most(gap, total, tail), sum_error=total.error, reference=max(0.0, abs(log_b) - width),
        side=-1.0 if below < above else 1.0,
    )  # fmt: skip


def _rows(x: RunSummary, rows: Array) -> RunSummary:
    order = np.argsort(x.runs[rows])
    return RunSummary(x.runs[rows][order], x.dof, x.nees[rows][order], x.squared[rows][order], x.covered[rows][order])


def _at_most(gap: Contrast, total: Contrast, tail: float) -> float:
    """Upper limit of abs(log ratio_a) - abs(log ratio_b), missed with probability ``2 * tail`` at most.

    log ratio_a - abs(log ratio_b) is the smaller of gap and total, -log ratio_a - abs(log ratio_b) that of -gap and
    -total; one of the two is the distance, and its limit needs a one-sided limit of gap and of total.
    """
    a_high = min(gap.value + gap.half_width(tail), total.value + total.half_width(tail))
    a_low = min(gap.half_width(tail) - gap.value, total.half_width(tail) - total.value)
    return max(a_high, a_low)


def _planned(error: float, runs: int, size: float, false_alarm: float, power: float) -> int:
    """Runs with which a contrast of ``size`` is significant, from its standard error in ``runs`` runs.

    The margin of the test counts twice: what moves the variance costs about as much again.
    """

    def enough(count: int) -> bool:
        quantiles = special.stdtrit(count - 1.0, [0.5 * false_alarm, 0.5 * (1.0 - power)])
        return bool(-quantiles.sum() * error * np.sqrt(runs / count) * np.exp(margin(count - 1.0)) <= size)

    low = FEWEST - 1
    high = FEWEST
    while not enough(high) and high < MOST:
        low = high
        high = 2 * high
    return low + 1 + bisect_left(range(low + 1, high), True, key=enough)


def _ratio(name: str, a: Array, b: Array, power: float, paired: bool, confidence: float) -> Difference:
    """(mean a / mean b) ** power; power 1/2 makes an RMSE of squares."""
    mean_a = float(a.mean())
    mean_b = float(b.mean())
    if not (mean_a > 0 and mean_b > 0):
        return Difference(name, mean_a**power, mean_b**power, float("nan"), float("nan"), float("nan"))
    error, freedom = _error(power * a / mean_a, power * b / mean_b, paired)
    log = power * np.log(mean_a / mean_b)
    half = _half(error, freedom, confidence) * np.exp(0.5 * margin(freedom))
    low, ratio, high = (float(np.exp(x)) for x in (log - half, log, log + half))
    return Difference(name, mean_a**power, mean_b**power, ratio, low, high)


def _share(name: str, a: Array, b: Array, paired: bool, confidence: float) -> Difference:
    error, freedom = _error(a, b, paired)
    gap = float(a.mean() - b.mean())
    half = _half(error, freedom, confidence)
    missing = 1.0 - (0.5 * (1.0 - confidence)) ** (1.0 / min(len(a), len(b)))  # a share of runs that may not be drawn
    half = max(half, missing * (max(np.ptp(a), np.ptp(b)) or 1.0))  # and may differ as much as those that are
    return Difference(name, float(a.mean()), float(b.mean()), gap, max(gap - half, -1.0), min(gap + half, 1.0))


def _error(a: Array, b: Array, paired: bool) -> tuple[float, float]:
    """Standard error of mean a minus mean b, and its degrees of freedom."""
    if paired:
        return float((a - b).std(ddof=1) / np.sqrt(len(a))), float(len(a) - 1)
    of_a = a.var(ddof=1) / len(a)
    of_b = b.var(ddof=1) / len(b)
    if of_a + of_b == 0:
        return 0.0, 1.0
    freedom = (of_a + of_b) ** 2 / (of_a**2 / (len(a) - 1) + of_b**2 / (len(b) - 1))
    return float(np.sqrt(of_a + of_b)), float(freedom)


def _half(error: float, freedom: float, confidence: float) -> float:
    return -float(special.stdtrit(freedom, 0.5 * (1.0 - confidence))) * error
