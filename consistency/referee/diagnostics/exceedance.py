"""Tests of how often errors leave their stated bounds, and of the factor by which a bound has to grow.

A bound with a level q holds if the error leaves it in 1 - q of the steps. The share of steps outside is a number in
[0, 1] for each run. Runs are independent, and nothing is assumed about steps of one run. Every test here asks whether
the expected share is at most ``a``; whether it is at least ``a`` is the same question about 1 - share and 1 - ``a``.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy import special

from consistency.referee.defaults import CONFIDENCE, DETECT, FALSE_ALARM, POWER
from consistency.referee.diagnostics.distributions import chi2
from consistency.referee.diagnostics.verdict_parts import Interval
from consistency.referee.types import Array, Indices

BETS = np.r_[0.002, 0.005, 0.01, 0.02, 0.05, np.linspace(0.1, 0.99, 19)]  # of the largest bet that cannot lose all
HALVINGS = 60  # of an interval: more than a double resolves
NEAR = 1e-3  # saddle points nearer to 0 than this take the limit there
TAIL = (1.0 - CONFIDENCE) / 2.0  # of each side of an interval
ROUNDING = 1e-9  # of sums of shares
LARGEST = 10**6  # runs; more are not planned
TRIED, TEETH = 600, 8  # numbers of runs up to that, and how many of their gaps are looked through
Test = Callable[[Array, float], Array]


def betting(shares: Array, a: float) -> Array:
    """p value of an expected share of at most ``a``, of shares (..., runs), by a bet (Waudby-Smith & Ramdas 2024).

    The mean over constant bets of the product of 1 + bet (share - a) is a test martingale, so that the inverse of its
    last value is a p value for any law of the shares (Markov).
    """
    logs = np.stack([np.log1p(bet / a * (shares - a)).sum(axis=-1) for bet in BETS])
    wealth = special.logsumexp(logs, axis=0) - np.log(len(BETS))
    return np.asarray(np.minimum(1.0, np.exp(-wealth)))


def gaffke(shares: Array, a: float) -> Array:
    """p value of an expected share of at most ``a`` of shares (..., runs), by Gaffke's test.

    Gaffke (2005), Three test statistics for a nonparametric one-sided hypothesis on the mean of a nonnegative variable.
    It is the probability that a mean of the shares and a zero, with weights that are uniform on the simplex, is at most
    ``a``. Shares of 0 and 1 alone give the exact binomial p value. For other laws no proof is known; docs/reference/
    rates.md has the measured rates.
    """
    ones = (shares == 1.0).sum(axis=-1)
    are_whole = ((shares == 0.0) | (shares == 1.0)).all(axis=-1)
    exact = np.where(ones > 0, special.betainc(np.maximum(ones, 1), shares.shape[-1] - ones + 1, a), 1.0)
    if are_whole.all():
        return np.asarray(exact)
    zero = np.full((*shares.shape[:-1], 1), -a)
    return np.where(are_whole, exact, _below_zero(np.concatenate([shares - a, zero], axis=-1)))


def _below_zero(c: Array) -> Array:
    """Probability that sum c_i E_i <= 0, E_i exponential, by the saddle point (Lugannani & Rice 1980); c (..., N)."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        low = 1.0 / c.min(axis=-1)
        high = np.where(c.max(axis=-1) > 0.0, 1.0 / c.max(axis=-1), 0.0)
        for _ in range(HALVINGS):
            t = 0.5 * (low + high)
            rises = (c / (1.0 - t[..., None] * c)).sum(axis=-1) > 0.0
            low, high = np.where(rises, low, t), np.where(rises, t, high)
        t = 0.5 * (low + high)
        part = c / (1.0 - t[..., None] * c)
        K = -np.log1p(-t[..., None] * c).sum(axis=-1)
        spread = np.sqrt(np.square(part).sum(axis=-1))
        w = np.sign(t) * np.sqrt(np.maximum(-2.0 * K, 0.0))
        density = np.exp(-0.5 * np.square(w)) / np.sqrt(2.0 * np.pi)
        tail = special.ndtr(w) + density * (1.0 / w - 1.0 / (t * spread))
        skew = 2.0 * (part**3).sum(axis=-1) / spread**3
    tail = np.where(np.abs(w) < NEAR, 0.5 + skew / (6.0 * np.sqrt(2.0 * np.pi)), tail)
    return np.clip(np.where(c.max(axis=-1) > 0.0, tail, 1.0), 0.0, 1.0)


# --- errors over their bounds --------------------------------------------------------------------------


@dataclass(frozen=True)
class Exceedance:
    """Errors of runs over their bounds: how often they leave it, and the factor by which it has to grow."""

    ratios: Array  # (runs, steps), size of the error over the bound; NaN where a step does not count
    missing: Indices  # (runs,), steps after the end of each run
    level: float

    @property
    def a(self) -> float:
        """Share of the steps in which the error may leave the bound."""
        return 1.0 - self.level

    @cached_property
    def _counts(self) -> Array:
        return np.asarray((~np.isnan(self.ratios)).sum(axis=1))

    @property
    def runs(self) -> int:
        """Number of runs with a step, or that should have had one."""
        return int((self._counts + self.missing > 0).sum())

    def shares(self, factor: float = 1.0) -> tuple[Array, Array]:
        """Share of steps outside the bound times ``factor``, (runs,): missing steps as inside, and as outside."""
        total = self._counts + self.missing
        some = total > 0
        with np.errstate(invalid="ignore"):
            outside = (self.ratios > factor).sum(axis=1)[some]
        return outside / total[some], (outside + self.missing[some]) / total[some]

    def rate(self, factor: float = 1.0) -> float:
        """Mean over runs of the share of their steps that are outside; NaN without a step."""
        some = self._counts > 0
        if not some.any():
            return float("nan")
        with np.errstate(invalid="ignore"):
            return float(((self.ratios[some] > factor).sum(axis=1) / self._counts[some]).mean())

    def p_small(self, factor: float = 1.0, test: Test = gaffke) -> float:
        """p value that the bound times ``factor`` is not too small."""
        return float(test(self.shares(factor)[0], self.a))

    def p_large(self, factor: float = 1.0, test: Test = gaffke) -> float:
        """p value that the bound times ``factor`` is not too large."""
        return float(test(1.0 - self.shares(factor)[1], self.level))

    def factor(self, tail: float = TAIL) -> Interval:
        """Factor by which the bound has to grow for its level to hold, and the factors that neither side rejects.

        Both p values change at ratios of the data alone and are monotone in the factor, so the set is an interval. Its
        upper end is infinite where the runs are too few to show any bound too large.
        """
        at = np.unique(np.r_[0.0, self.ratios[~np.isnan(self.ratios)]])
        small = bisect_left(at, True, key=lambda factor: self.p_small(factor) > tail)
        large = bisect_left(at, True, key=lambda factor: self.p_large(factor) <= tail)
        right = bisect_left(at, True, key=lambda factor: self.rate(factor) <= self.a)
        ends = np.append(at, np.inf)
        low, high = float(ends[small]), float(ends[large])
        return Interval(float(np.clip(ends[right], low, high)), low, high)

    def covering_factors(self) -> tuple[float, Array]:
        """The smallest factor that is sure to hold its level for one more run, and that without each run, (R,).

        The expected share of steps of a new exchangeable run that are outside is at most ``a`` if the shares of those
        known add up to a (N + 1) - 1 at most: the new run is counted as outside throughout (conformal risk control,
        Angelopoulos et al. 2024). Infinite for fewer runs than :func:`fewest_fitted`. Without a run that has no step
        it is the factor of all.
        """
        sizes = self.ratios
        some = self._counts > 0
        weight = np.where(some, 1.0 / np.maximum(self._counts, 1), 0.0)
        there = ~np.isnan(sizes)
        order = np.argsort(sizes[there], kind="stable")
        at = np.r_[0.0, sizes[there][order]]
        inside = np.r_[0.0, np.cumsum(np.broadcast_to(weight[:, None], sizes.shape)[there][order])]
        runs = int(some.sum())

        def outside(i: Indices) -> tuple[Array, Array]:
            """Shares outside of all runs together, and of each, (R,), with one factor for each run."""
            factor = at[i]
            last = np.searchsorted(at, factor, side="right") - 1
            with np.errstate(invalid="ignore"):
                return inside[-1] - inside[last], weight * (sizes > factor[:, None]).sum(axis=1)

        def least(left: Indices) -> Array:
            """The factor of all runs, or without each; ``left`` (R,) is 0 or 1."""
            room = self.a * (runs - left + 1) - 1.0 + ROUNDING
            low, high = np.zeros(len(sizes), int), np.full(len(sizes), len(at) - 1)
            while (low < high).any():
                middle = (low + high) // 2
                total, own = outside(middle)
                fits = total - left * own <= room
                high = np.where(fits, middle, high)
                low = np.where(fits, low, np.minimum(middle + 1, high))
            return np.where(room >= 0.0, at[high], np.inf)

        return float(least(np.zeros(len(sizes), int))[0]), least(some.astype(int))

    def rate_limit(self) -> float:
        """Rate of steps outside that the runs exclude, with all larger ones: 3 / N where N runs never leave."""
        return self._end(1.0 - self.shares()[1], 1.0 - CONFIDENCE)

    def rate_interval(self) -> Interval:
        """Share of steps outside, and the rates that neither side rejects."""
        high = self._end(1.0 - self.shares()[1], TAIL)
        low = 1.0 - self._end(self.shares()[0], TAIL)
        rate = self.rate()
        return Interval(rate, min(low, rate), max(high, rate))

    def _end(self, shares: Array, tail: float) -> float:
        """The smallest rate so that a mean of ``shares`` above 1 less that rate is not believed."""
        low, high = 0.0, 1.0
        for _ in range(HALVINGS // 2):
            rate = 0.5 * (low + high)
            if rate < 1.0 and gaffke(shares, 1.0 - rate) <= tail:
                high = rate
            else:
                low = rate
        return high


def missing_steps(ratios: Array) -> Indices:
    """Steps after the last one of each run, (runs,), up to the last of any run; ratios (runs, steps), NaN if absent.

    A step that no run has, and a gap within a run, is none. A run without any step lacks all that others have.
    """
    there = ~np.isnan(ratios)
    steps = there.any(axis=0)
    has_ended = ~np.flip(np.logical_or.accumulate(np.flip(there, axis=1), axis=1), axis=1)
    return np.asarray((has_ended & steps).sum(axis=1))


# --- numbers of runs -----------------------------------------------------------------------------------


class BoundRuns(NamedTuple):
    """Runs that bounds take, however steps of a run depend on each other; None for more than a million."""

    fewest: int  # below, neither consistent nor conservative can be reached
    consistent: int | None  # a right bound is shown to be right
    small: int | None  # a bound too small by ``detect`` is found
    large: int | None  # a bound too large by it is found


def fewest_runs(level: float, tail: float = 1.0 - CONFIDENCE) -> int:
    """Runs that may all stay inside a bound of this level with a probability of at most ``tail``: 59 at 95 %."""
    return int(np.ceil(np.log(tail) / np.log(level) - 1e-9))


def fewest_fitted(level: float) -> int:
    """Runs with which a factor is sure to hold this level for one more: 19 at 95 %."""
    return int(np.ceil(1.0 / (1.0 - level) - 1.0 - ROUNDING))


def bound_runs(
    level: float, detect: float = DETECT, false_alarm: float = FALSE_ALARM, power: float = POWER
) -> BoundRuns:
    """Runs of Gaussian errors with which a verdict on a bound of this level decides with ``power``.

    In the worst case all steps of a run are alike, and the number of runs outside is binomial. Shown to be right is a
    factor of the bound within the root of ``detect``; found is a bound that is wrong by the factor ``detect``.
    """
    a = 1.0 - level
    wrong = max(detect, 1.0 / detect)
    side = false_alarm / 2.0
    return BoundRuns(
        fewest_runs(level, 1.0 - power),
        runs_to_show(level, detect, power),
        _least(lambda n: _found_small(n, a, _rate(level, 1.0 / wrong), side) >= power),
        _least(lambda n: _found_large(n, a, _rate(level, wrong), side) >= power),
    )


def runs_to_show(level: float, detect: float = DETECT, power: float = POWER) -> int | None:
    """Runs that show a right bound to be right, as ``consistent`` of :func:`bound_runs`."""
    a, tail = 1.0 - level, 1.0 - power
    alike = max(detect, 1.0 / detect) ** 0.5
    below, above = _rate(level, alike), _rate(level, 1.0 / alike)
    return _least(lambda n: _found_large(n, a, below, tail) + _found_small(n, a, above, tail) - 1.0 >= power)


def _rate(level: float, factor: float) -> float:
    """Rate at which a Gaussian error leaves a right bound times ``factor``."""
    return float(2.0 * special.ndtr(special.ndtri((1.0 - level) / 2.0) * factor))


def _found_large(n: Indices, a: float, rate: float, tail: float) -> Array:
    """Probability that runs (N,) that leave at ``rate`` are shown to leave at less than ``a``."""
    k = np.floor(special.bdtrik(tail, n, a) + 1e-9)
    k = np.where(special.bdtr(np.maximum(k, 0.0), n, a) <= tail, k, k - 1.0)
    possible = (k >= 0.0) & (special.bdtr(0.0, n, a) <= tail)
    return np.where(possible, special.bdtr(np.maximum(k, 0.0), n, rate), 0.0)


def _found_small(n: Indices, a: float, rate: float, tail: float) -> Array:
    """Probability that runs (N,) that leave at ``rate`` are shown to leave at more than ``a``."""
    k = np.floor(special.bdtrik(1.0 - tail, n, a)) + 1.0  # above it, at most ``tail`` is left
    k = np.where(special.bdtrc(np.maximum(k - 2.0, 0.0), n, a) <= tail, k - 1.0, k)
    k = np.where(special.bdtrc(np.maximum(k - 1.0, 0.0), n, a) <= tail, k, k + 1.0)
    return np.where(k <= n, special.bdtrc(np.minimum(np.maximum(k - 1.0, 0.0), n), n, rate), 0.0)


def _least(enough: Callable[[Indices], Array]) -> int | None:
    """The smallest number of runs from which on all are enough; None above a million.

    Few numbers are tried first, then all near the last that is not enough: the power of a binomial test is a saw.
    """
    tried = np.unique(np.geomspace(1, LARGEST, TRIED).astype(int))
    short = np.flatnonzero(~enough(tried))
    if not len(short):
        return 1
    last = int(short[-1])
    if last == len(tried) - 1:
        return None
    near = np.arange(tried[last], tried[min(last + TEETH, len(tried) - 1)] + 1)
    return int(near[np.flatnonzero(~enough(near))[-1]]) + 1


# --- levels that mean a covariance ------------------------------------------------------------------------


def deviations_of(level: float, dimensions: int) -> float:
    """Standard deviations of a Gaussian in the radius of a level: 1.960 at 95 % of one component, 2.448 of two."""
    return float(np.sqrt(chi2.ppf(level, dimensions)))


def level_of(deviations: float, dimensions: int) -> float:
    """Level of a radius of so many standard deviations: 2 sigma is 95.4 % of one component, 86.5 % of two."""
    return float(chi2.cdf(deviations**2, dimensions))
