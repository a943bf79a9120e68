"""The size of the covariance: is it wrong, and is it shown to be right?

Runs are the unit: they are independent, steps are not.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy import special

from consistency.referee.defaults import CONFIDENCE
from consistency.referee.diagnostics import distributions
from consistency.referee.diagnostics.distributions import combined_p_value, weighted_chi_square_tail
from consistency.referee.diagnostics.nees import FEW, EarlyMeans, e_processes, ever
from consistency.referee.diagnostics.number_of_runs import LARGEST
from consistency.referee.diagnostics.verdict_parts import MAIN, SHARES, Equivalence, Interval, Settings
from consistency.referee.diagnostics.whitening import (
    are_unlike,
    by_runs,
    by_steps,
    mean_and_count,
)
from consistency.referee.types import Array, Indices

LARGE = 1e6  # shape of a Gamma distribution beyond which its information is 1/2 and rounding would rule
LEAST = 4.0  # degrees of freedom of Student's t in an interval: with fewer it says nothing at all
SKEWNESS = 0.4  # of the bound on it, that the spread is adjusted by
# 0.2 errs too often where one of 3 axes is constant in half of 102 runs (1.4 times at 1e-3). 0.3 would keep the rates
# of the question; intervals need more, most where one of 2 axes is constant in all of 21 runs (miss 6.7 %, here 5.5).
EARLY = 0.75  # weight of the first steps in the evidence, where runs have unlike numbers of steps
REACH = 4.0  # standard errors that chance may carry the mean, where nu is moved to a mean of 1
ITERATIONS = 5  # of the upper end of an interval and the spread there
UNKNOWN = Interval(float("nan"), float("nan"), float("nan"))
FARTHEST = 15.0  # log of a ratio, beyond which an interval has no end
HALVINGS = 16  # of an interval in which an end is looked for


@dataclass(frozen=True)
class MeanTest:
    """Test that the mean NEES of whole trajectories is the degrees of freedom."""

    runs: int
    ratio: float  # mean NEES over dof
    effective_dof: float  # nu of one run: its mean NEES spreads as chi-square(nu) / nu
    spread: float  # degrees of freedom with which nu is known
    above: float  # one-sided p value against a covariance too small
    below: float  # one-sided p value against a covariance too large

    @property
    def p_value(self) -> float:
        """Two-sided; NaN where there is nothing to judge."""
        return float(np.minimum(1.0, 2.0 * np.minimum(self.above, self.below)))


def mean_test(nees: Array, dof: int) -> MeanTest:
    """Test of the mean NEES over whole trajectories, with each run one observation; see :func:`scale_test`.

    Parameters
    ----------
    nees : (runs, steps), NaN where a run has no value
    dof : dimension of the error
    """
    means, counts = run_means(nees)
    return scale_test(means[counts > 0] / dof, dof, int(counts.max(initial=0)))


def scale_test(means: Array, dof: int, steps: int, gaussian: bool = True, weights: Array | None = None) -> MeanTest:
    """Test that run means of the NEES over its degrees of freedom, Y_i (runs,), have the mean 1.

    A run's mean NEES is a sum of dependent chi-squares. It is approximated by chi-square(nu) / nu with
    the same mean and variance (Satterthwaite 1946; Box 1954, Theorem 3.1). No assumption is made about the dependence
    between the steps of a run, which may differ from run to run: nu comes from the run means alone, which are
    independent. Two estimates are taken, each one standard error to the safe side, and the smaller counts:

    - from the coefficient of variation, nu = 2 / CV^2 less its first-order bias. The jackknife over runs gives its
      variance and its change with the mean; where that lowers nu, its value at a mean of 1 is used.
      Where the mean is below 1, the skewness may be larger than that of a Gamma distribution of this spread, see
      :func:`_at_most_skewness`;
    - from the likelihood of a Gamma distribution of shape a = nu / 2, log a - digamma(a) = log mean Y - mean log Y
      (Fisher 1922), which small values enter as strongly as large ones.

    Student's t in place of the normal allows for the remaining uncertainty. nu lies between ``dof``, its value where
    all steps of a run are one and the same, and that times ``steps``. With fewer than 20 runs nu is ``dof``: the test
    is the chi-square of one step.

    Parameters
    ----------
    means : (runs,), mean NEES of each run over ``dof``
    dof : dimension of the error
    steps : of the longest run
    gaussian : False lets nu fall below ``dof``, where only errors with heavy tails can have it
    weights : (runs,), of the runs in the mean, see :class:`Weighted`; None where they are equal
    """
    return scale_tests(means, dof, steps, gaussian, weights)(1.0)


def scale_tests(
    means: Array, dof: int, steps: int, gaussian: bool = True, weights: Array | None = None
) -> Callable[[float], MeanTest]:
    """:func:`scale_test` of ``means`` over any number: their spread relative to their mean is worked out once."""
    runs = len(means)
    if runs == 0:
        return lambda _: MeanTest(0, float("nan"), float("nan"), float("inf"), float("nan"), float("nan"))
    weighted = weighted_of(means, weights)
    least = dof / weighted.squares
    spread = None
    if runs >= FEW * weighted.squares and (steps > 1 or not gaussian) and means.min() > 0:
        spread = _spread_of(means, weighted)

    def test(size: float) -> MeanTest:
        ratio = weighted.ratio / size
        nu = float(least)
        known = float("inf")
        if spread is not None:
            log_nu = spread.log_nu(ratio, size, dof * weighted.squares / weighted.cubes)
            log_nu = min(log_nu, float(np.log(dof * steps)))
            if log_nu > np.log(least) or not gaussian:
                nu = float(np.exp(log_nu))
                known = 2.0 / spread.variance
        above, below = _tails(ratio, runs * nu, known)
        if weighted.weights is not None:
            above = max(above, _skewed_tail(weighted, ratio, dof, nu, known))
        return MeanTest(runs, ratio, nu, known, above, below)

    return test


@dataclass(frozen=True)
class RunMeans:
    """Mean NEES Y_i of runs over their degrees of freedom, with tests that also hold where runs differ in length.

    If a right filter states P_k given its measurements up to step k, and these decide whether a step counts, then
    E Y_i is not 1: runs that end early have other errors than runs that end late. The sum of counts_i (Y_i - 1) has the
    mean 0 (optional stopping). So a fault is *found* only if a test with runs weighted by their steps finds it, too.
    Weighted so, runs that end early hardly count. Therefore the evidence of the first steps, which nearly all runs
    have, is part of that test. Once a fault is found, runs of equal weight *name* it. Where all runs have equally many
    steps there is one test.
    """

    values: Array  # (runs,)
    counts: Indices  # (runs,), steps of each
    dof: int
    early: RunMeans | None = None  # of the first steps

    @property
    def steps(self) -> int:
        """Steps of the longest run."""
        return int(self.counts.max(initial=0))

    @cached_property
    def named(self) -> MeanTest:
        """:func:`scale_test` of runs of equal weight."""
        return scale_test(self.values, self.dof, self.steps)

    def find(self) -> MeanTest:
        """The same, with the larger p values of both tests."""
        return self.tests()(1.0) if are_unlike(self.counts) else self.named

    def tests(self, gaussian: bool = True) -> Callable[[float], MeanTest]:
        """:meth:`find` of the means over any number."""
        by_runs = scale_tests(self.values, self.dof, self.steps, gaussian)
        if not are_unlike(self.counts):
            return by_runs
        by_steps = self.by_steps(gaussian)
        by_first_steps = None if self.early is None else self.early.by_steps(gaussian)

        def test(size: float) -> MeanTest:
            test, long = by_runs(size), by_steps(size)
            above, below = long.above, long.below
            if by_first_steps is not None:
                first = by_first_steps(size)
                above = combined_p_value((above, first.above), (1.0 - EARLY, EARLY))
                below = combined_p_value((below, first.below), (1.0 - EARLY, EARLY))
            return replace(test, above=max(test.above, above), below=max(test.below, below))

        return test

    def by_steps(self, gaussian: bool = True) -> Callable[[float], MeanTest]:
        """:func:`scale_tests` of runs weighted by their steps."""
        return scale_tests(self.values, self.dof, self.steps, gaussian, self.counts)

    def interval(self, confidence: float = CONFIDENCE) -> Interval:
        """:func:`ratio_interval` that holds 1 if that of either weights does."""
        ratio = ratio_interval(self.values, self.dof, confidence)
        if not are_unlike(self.counts):
            return ratio
        by_steps = ratio_interval(self.values, self.dof, confidence, self.counts)
        return Interval(ratio.value, min(ratio.low, by_steps.low), max(ratio.high, by_steps.high))


@dataclass(frozen=True)
class Weighted:
    """Run means Y_i that count with weights w_i of mean 1.

    Where the number of a run's steps that count depends on what is measured later, the mean of all Y_i does not have
    the mean of Y, but the sum of w_i (Y_i - 1) has the mean 0 if w_i is proportional to that number.
    """

    ratio: float  # R, mean of w Y
    values: Array  # (runs,), R + w (Y - R), which spread as the terms of R do
    squares: float = 1.0  # mean of w^2: as many runs of equal weight would spread so much less
    cubes: float = 1.0  # mean of w^3
    weights: Array | None = None  # (runs,), w; None where all are 1


def weighted_of(means: Array, weights: Array | None = None) -> Weighted:
    """Run means (runs,) with their weights (runs,), or with equal ones."""
    if weights is None or weights.min() == weights.max():
        return Weighted(float(means.mean()), means)
    w = weights / weights.mean()
    ratio = float((w * means).mean())
    return Weighted(ratio, ratio + w * (means - ratio), float(np.square(w).mean()), float((w**3).mean()), w)


def spreads_more(means: Array, dof: float, errors: float = 1.0) -> bool:
    """Whether run means (runs,) differ more than those of Gaussian errors can, for which nu is ``dof`` at least.

    Either estimate of nu (:func:`scale_test`) lies more than ``errors`` standard errors below; not asked of fewer than
    20 runs.
    """
    if len(means) < FEW or not means.min() > 0:
        return False
    spread = _spread_of(means, weighted_of(means))
    by_spread = spread.by_spread + errors * np.sqrt(spread.variance)
    return bool(min(by_spread, spread.by_likelihood + errors * spread.error) < np.log(dof))


def spreads_more_in_steps(nees: Array, dof: int) -> bool:
    """Whether the NEES (runs, steps) differs more between runs, step by step, than that of Gaussian errors can.

    The mean of log nu over the steps is compared, with the standard error of one step. Steps need not be independent.
    Those in which a run has no value, or none of the runs an error, do not count.
    """
    whole = by_steps(lambda part: (np.isfinite(part) & (part > 0)).all(axis=0), nees)
    if len(nees) < FEW or not whole.any():
        return False
    nees = nees if whole.all() else nees[:, whole]
    return bool(by_steps(lambda part: np.add(*_log_nu_of_gamma(part)), nees).mean() < np.log(dof))


def run_means(nees: Array) -> tuple[Array, Array]:
    """Mean NEES of each run over the steps it has, and how many those are: (runs, steps) -> (runs,), (runs,)."""
    means, count = by_runs(means_and_counts, nees).T
    return np.ascontiguousarray(means), count.astype(np.int64)


def means_and_counts(nees: Array) -> Array:
    """Means and counts of :func:`run_means` as one array, (runs, steps) -> (runs, 2)."""
    return np.stack(mean_and_count(nees, 1), axis=-1)


def acceptance(test: MeanTest, dof: int, false_alarm: float, allow: str | None = None) -> tuple[float, float]:
    """Interval of the mean NEES that :func:`mean_test` accepts at ``false_alarm``."""
    if not test.runs:
        return float("nan"), float("nan")
    z = float(distributions.t.isf(false_alarm if allow else false_alarm / 2, test.spread))
    k = test.runs * test.effective_dof
    low = 0.0 if allow == "conservative" else float(distributions.chi2.ppf(special.ndtr(-z), k)) * dof / k
    return low, float(distributions.chi2.isf(special.ndtr(-z), k)) * dof / k


def ratio_interval(
    means: Array, dof: int = 1, confidence: float = CONFIDENCE, weights: Array | None = None
) -> Interval:
    """Ratio of true to stated covariance (1 is right) and its interval, from the runs' mean NEES over dof (runs,).

    From 20 runs on the spread between the runs is taken as it is, so that neither dependence between steps nor heavy
    tails make the interval too short. Fewer runs do not determine their spread well: then the spread of runs whose
    steps are all the same is used, or the observed one if it is larger. Without a run the interval is NaN.
    ``weights`` (runs,) are those of :class:`Weighted`.
    """
    means = np.asarray(means, float)
    if not len(means):
        return UNKNOWN
    weighted = weighted_of(means, weights)
    ratio = weighted.ratio
    tail = 0.5 * (1.0 - confidence)
    least = dof / weighted.squares
    if not means.max() > 0:
        return Interval(ratio, ratio, ratio)
    nu = float(least)
    spread = float("inf")
    enough = len(means) >= FEW * weighted.squares
    if len(means) > 1 and means.max() > means.min():
        log_nu, left_out = _log_nu_of_means(weighted.values)
        if enough:
            variance = max(_jackknife(left_out, left_out), 2.0 / len(means))
            nu = float(np.exp(log_nu))
            spread = max(2.0 / variance, LEAST)
        else:
            nu = min(nu, float(np.exp(log_nu)))
    elif enough:
        return Interval(ratio, ratio, ratio)
    z = float(distributions.t.isf(tail, spread))
    k = len(means) * nu
    low, high = (float(distributions.chi2.ppf(special.ndtr(s), k)) for s in (z, -z))
    upper = ratio * k / max(high, 1e-300)
    for _ in range(ITERATIONS if enough and nu > least else 0):  # the spread of means whose ratio is upper
        log_nu = _at_most_skewness(np.log(nu), ratio / upper, dof * weighted.squares / weighted.cubes)
        skewed = len(means) * max(float(least), float(np.exp(log_nu)))
        upper = ratio * skewed / max(float(distributions.chi2.ppf(special.ndtr(-z), skewed)), 1e-300)
    return Interval(ratio, ratio * k / low, upper)


def _log_nu_of_means(means: Array) -> tuple[float, Array]:
    """log(2 / CV^2) of the runs' means (runs,), less its first-order bias, and the same with each run left out."""
    means = np.ldexp(means, -np.frexp(means.max())[1])  # exact, and no square leaves the range of numbers
    runs = len(means)
    mean = means.mean()
    left = _left_out_mean(means)
    squares = np.square(means).sum()
    cv = max(means.var(ddof=1) / mean**2, 1e-12)
    variance = (squares - np.square(means) - (runs - 1) * left**2) / max(runs - 2, 1)
    smallest = 1e-12 * mean**2
    return float(np.log(2.0 / cv) - np.log1p(cv / runs)), np.log(2.0 * left**2 / np.maximum(variance, smallest))


def _log_nu_of_gamma(means: Array, weights: Array | None = None) -> tuple[Array, Array]:
    """log(2 a) of the Gamma distribution of shape a most likely to have made ``means`` (runs, ...), and its error.

    The error is the standard error by the expected information, 1 / (N (a^2 trigamma(a) - a)); (...) both. With
    ``weights`` (runs,) of a mean each run counts by its weight squared, as in the variance of the mean.
    """
    runs: float = len(means)
    if weights is None:
        gap = np.log(means.mean(axis=0)) - np.log(means).mean(axis=0)
    else:
        share = np.square(weights) / np.square(weights).sum()
        gap = np.log(share @ means) - share @ np.log(means)
        runs = 1.0 / np.square(share).sum()
    gap = np.maximum(gap, 1e-12)
    log_a = np.log((3.0 - gap + np.sqrt((gap - 3.0) ** 2 + 24.0 * gap)) / (12.0 * gap))  # Minka (2002), to 1.5 %
    for _ in range(5):  # Newton in log a; zeta(2, a) is the trigamma function, in a sixth of the time of polygamma
        a = np.exp(log_a)
        log_a = log_a - np.clip((log_a - special.psi(a) - gap) / (1.0 - a * special.zeta(2.0, a)), -2.0, 2.0)
    a = np.exp(np.minimum(log_a, np.log(LARGE)))
    information = np.where(a < LARGE, a * a * special.zeta(2.0, a) - a, 0.5)
    return np.log(2.0) + log_a, 1.0 / np.sqrt(runs * information)


def _left_out_mean(means: Array) -> Array:
    """Mean without each run; what is left beside a run that diverged is no smaller than its rounding."""
    total = means.sum()
    return np.asarray(np.maximum(total - means, np.finfo(float).eps * total) / (len(means) - 1))


def _jackknife(a: Array, b: Array) -> float:
    """Covariance of two estimates from their values with each run left out (Efron & Stein 1981)."""
    return float((len(a) - 1) / len(a) * ((a - a.mean()) * (b - b.mean())).sum())


class _Spread(NamedTuple):
    """How much run means differ, relative to their mean: estimates of log nu and what is known of them."""

    by_spread: float
    variance: float  # of that at a mean of 1
    log_mean: float
    slope: float  # of ``by_spread`` with the log of the mean
    reach: float  # of the log of the mean, no farther than chance carries it
    by_likelihood: float
    error: float

    def log_nu(self, ratio: float, size: float, dof: float) -> float:
        """The smaller estimate for means over ``size``, with the mean ``ratio``, each one error to the safe side.

        The first is moved down to where it would be at a mean of 1, never up.
        """
        off = max(-self.reach, min(self.log_mean - float(np.log(size)), self.reach))
        by_spread = _at_most_skewness(self.by_spread + min(-self.slope * off, 0.0), ratio, dof)
        return min(by_spread - float(np.sqrt(self.variance)), self.by_likelihood - self.error)


def _spread_of(means: Array, weighted: Weighted) -> _Spread:
    """Spread of run means (runs,), all above 0."""
    by_spread, left_out = _log_nu_of_means(weighted.values)
    log_mean = np.log(_left_out_mean(weighted.values))
    of_mean = _jackknife(log_mean, log_mean)
    both = _jackknife(left_out, log_mean)
    slope = both / of_mean if of_mean > 0 else 0.0
    variance = max(_jackknife(left_out, left_out) - slope * both, 2.0 / len(means))
    by_likelihood, error = _log_nu_of_gamma(means, weighted.weights)
    return _Spread(
        by_spread,
        variance,
        log_mean=float(np.log(weighted.values.mean())),
        slope=slope,
        reach=REACH * float(np.sqrt(of_mean)),
        by_likelihood=float(by_likelihood - np.log(weighted.squares)),
        error=float(error),
    )


def _at_most_skewness(log_nu: float, ratio: float, dof: float) -> float:
    """log nu at a mean of 1, where ``ratio`` below 1 was seen and some runs may have errors that do not change.

    A run mean is a sum of chi-squares whose weights are 1 / dof at most, so that its third cumulant is at most 4 / dof
    times its variance v, also where runs differ. The log of the observed variance thus falls by up to 4 / (dof v) for
    each unit by which the mean falls. With ``SKEWNESS`` of that, v log(v / observed) = change. One degree of freedom
    needs no adjustment: the Gamma distribution is as skewed.
    """
    change = SKEWNESS * 4.0 / dof * (1.0 - ratio)
    if dof == 1 or not change > 0.0:
        return log_nu
    observed = max(2.0 * ratio**2 * float(np.exp(-log_nu)), 1e-300)
    return min(log_nu, float(np.log(2.0 * special.lambertw(change / observed).real / change)))


def _tails(ratio: float, k: float, spread: float) -> tuple[float, float]:
    """Upper and lower p value of ``ratio`` = chi-square(k) / k, widened from normal to Student's t."""
    if not np.isfinite(k):
        return float(ratio <= 1.0), float(ratio >= 1.0)
    upper = special.chdtrc(k, k * ratio)
    lower = special.chdtr(k, k * ratio)
    if not np.isfinite(spread):
        return float(upper), float(lower)
    above, below = (special.stdtr(spread, float(special.ndtri(p))) for p in (upper, lower))
    return float(above), float(below)


def _skewed_tail(weighted: Weighted, ratio: float, dof: int, nu: float, spread: float) -> float:
    """Upper p value of a ``ratio`` with unlike weights of runs, which is more skewed than chi-square(k) / k.

    Runs whose steps are all one and the same are a weighted sum of chi-squares. Otherwise the gamma distribution has
    the variance 2 / (runs nu) of the mean, and the largest third cumulant that Gaussian errors can have at this
    variance: 4 / dof times the variance of a run.
    """
    assert weighted.weights is not None
    runs = len(weighted.weights)
    if nu == dof / weighted.squares:
        upper = weighted_chi_square_tail(ratio, np.repeat(weighted.weights / (runs * dof), dof))
    else:
        k = runs * (weighted.squares / weighted.cubes) ** 2 * min(dof**2 / nu, nu * weighted.squares**2)
        upper = float(special.chdtrc(k, max(k + (ratio - 1.0) * np.sqrt(k * runs * nu), 0.0)))
    if not np.isfinite(spread):
        return upper
    return float(special.stdtr(spread, float(special.ndtri(upper))))


def equivalence(
    means: Array,
    dof: int,
    steps: int,
    settings: Settings,
    factor: float | None = None,
    low_is_fault: bool = True,
    unseen: float = 0.0,
    share: float = 0.0,
    weights: Array | None = None,
    is_whole: bool = False,
    test: Callable[[float], MeanTest] | None = None,
) -> Equivalence:
    """Two one-sided tests that the ratio of true to stated covariance lies in [1 / factor, factor].

    The ratio is below ``factor`` if the test of run means Y / factor finds them too small, and above its inverse if
    that of Y factor finds them too large; both at ``1 - power`` (Schuirmann 1987). A ratio at either end, or beyond,
    is called equivalent with that probability at most.

    The covariance may be right in some runs and wrong in others, which then differ more than Gaussian errors of one
    covariance: the effective degrees of freedom of a run may be fewer than ``dof``.

    Parameters
    ----------
    means : (runs,), mean NEES of each run over ``dof``
    steps : of the longest run
    factor : ``settings.factor`` where it is not given
    low_is_fault : whether a ratio below 1 is a fault, which more runs may find
    unseen : share of the NEES that ``means`` may lack; the ratio is then as much larger on its upper side
    share : of errors of the truth in the covariances of ``means``; the ratio is of the others
    weights : (runs,), of the runs in the mean; None where they are equal
    is_whole : the interval of the two tests is worked out, too
    test : that of the means over a number, in place of :func:`scale_tests`
    """
    factor = settings.factor if factor is None else factor
    top = (share + (1.0 - share) * factor) * (1.0 - unseen)
    bottom = share + (1.0 - share) / factor

    scaled = scale_tests(means, dof, steps, False, weights) if test is None else test

    def p_below(ratio: float) -> float:
        size = (share + (1.0 - share) * ratio) * (1.0 - unseen)
        return scaled(size).below if size > 0 else 1.0

    def p_above(ratio: float) -> float:
        return scaled(share + (1.0 - share) * ratio).above

    ratio = float("nan")
    if is_whole and len(means):
        ratio = (float(np.average(means, weights=weights)) - share) / (1.0 - share)
    runs = None
    if top > 1.0:
        nearer = min(top, 1.0 / bottom) if share and not settings.one_sided else top
        runs = deciding_runs(scaled(1.0), nearer, settings, low_is_fault)
    return equivalent(p_below, p_above, ratio, factor, settings, runs)


def equivalent(
    below: Callable[[float], float],
    above: Callable[[float], float],
    ratio: float,
    factor: float,
    settings: Settings,
    runs: int | None = None,
) -> Equivalence:
    """Equivalence by two one-sided tests, with the interval of the ratios that neither excludes.

    The interval lies inside [1 / factor, factor] where equivalence is shown.

    Parameters
    ----------
    below, above : p values of the ratio being as large as a number, or as small
    ratio : the estimated one; the interval needs one above 0
    """
    p_value = below(factor)
    if not settings.one_sided:
        p_value = max(p_value, above(1.0 / factor))
    level = 1.0 - settings.power
    interval = None
    if ratio > 0 and np.isfinite(ratio):
        interval = _end(above, ratio, -1.0, level), _end(below, ratio, 1.0, level)
    return Equivalence(factor, float(p_value), level, runs, settings.one_sided, interval)


def _end(p_value: Callable[[float], float], ratio: float, sign: float, level: float) -> float:
    """The ratio from which on, upwards or downwards, a test excludes all."""
    inside = 0.0
    step = 0.1
    while p_value(ratio * float(np.exp(sign * step))) > level:
        inside = step
        step = 2.0 * step
        if step > FARTHEST:
            return float("inf") if sign > 0 else 0.0
    outside = step
    for _ in range(HALVINGS):
        middle = 0.5 * (inside + outside)
        if p_value(ratio * float(np.exp(sign * middle))) > level:
            inside = middle
        else:
            outside = middle
    return ratio * float(np.exp(sign * outside))


def equivalence_by_betting(means: Array, dof: int, settings: Settings, early: EarlyMeans | None = None) -> Equivalence:
    """Equivalence of the scale from the inverted e-process: valid at any look, and under any dependence.

    Parameters
    ----------
    means : (runs,), mean over its steps of each run's NEES over ``dof``
    dof : components of the error
    early : see :func:`e_processes`; None where runs have equally many steps
    """

    def below(ratio: float) -> float:
        return max(ever(bets.down) for bets in e_processes(means, dof, early, ratio))

    def above(ratio: float) -> float:
        return max(ever(bets.up) for bets in e_processes(means, dof, early, ratio))

    mean = float("nan")
    if len(means):
        mean = float(means.mean())
    return equivalent(below, above, mean, settings.factor, settings)


def equivalence_of_total(total: float, dof: int, settings: Settings, factor: float) -> Equivalence:
    """Equivalence of the scale from a total that is chi-square with ``dof`` degrees of freedom if the ratio is 1.

    The total NIS is, as innovations are independent over steps too, and so is the joint NEES of pose and map.
    """
    if not dof:
        return Equivalence(factor, float("nan"), 1.0 - settings.power, None)

    def below(ratio: float) -> float:
        return float(distributions.chi2.cdf(total / ratio, dof))

    def above(ratio: float) -> float:
        return float(distributions.chi2.sf(total / ratio, dof))

    return equivalent(below, above, total / dof, factor, settings)


def is_tolerated(total: float, dof: int, settings: Settings) -> bool:
    """Whether the ratio is shown to lie within the tolerance, see :func:`equivalence_of_total`."""
    return settings.tolerance is not None and equivalence_of_total(total, dof, settings, settings.tolerated).shown


def worst(parts: Sequence[Equivalence]) -> Equivalence:
    """Equivalence of all parts: shown where each of them is, by the runs that decide for each."""
    last = max(parts, key=lambda e: np.nan_to_num(e.p_value, nan=np.inf))
    runs = [e.runs for e in parts if not e.shown]
    return replace(last, runs=None if None in runs else max((r for r in runs if r is not None), default=last.runs))


def deciding_runs(test: MeanTest, factor: float, settings: Settings, low_is_fault: bool = True) -> int | None:
    """Number of runs that would probably show the ratio inside, or find it at fault, at its present estimate.

    From fewer than 20 runs the ratio is not known and is assumed to be right. Chi-square of k degrees of freedom
    is judged by its logarithm, of variance 2 / k; each with probability ``power``.
    """
    if not test.runs or not test.ratio > 0:
        return None
    off = float(np.log(test.ratio)) if test.runs >= FEW else 0.0
    gap = off if settings.one_sided else abs(off)  # one-sided, a ratio below 1 is not a fault and farther from the end
    tail = SHARES[MAIN] * settings.false_alarm / (1 if settings.one_sided else 2)
    power = float(special.ndtri(settings.power))
    room = float(np.log(factor)) - gap
    fault = gap if low_is_fault or off > 0 else 0.0

    def runs(quantile: float, distance: float) -> float:
        return 2.0 / test.effective_dof * ((quantile + power) / distance) ** 2 if distance > 0 else float("inf")

    least = min(runs(power, room), runs(float(special.ndtri(1.0 - tail)), fault))
    return None if least > LARGEST else max(int(np.ceil(least)), FEW)
