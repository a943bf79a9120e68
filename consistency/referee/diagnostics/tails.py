"""What lies beyond a Gaussian: heavy tails, and lost runs, which failed, ended early or have a NEES beyond chance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import special

from consistency.referee.diagnostics import distributions
from consistency.referee.diagnostics.bias_and_shape import StepMoments, step_moments
from consistency.referee.diagnostics.nees import ever
from consistency.referee.diagnostics.number_of_runs import lost_runs, share_limit
from consistency.referee.diagnostics.record import Record
from consistency.referee.diagnostics.scale import run_means
from consistency.referee.diagnostics.verdict_parts import EarlyEnds, Lost, Settings
from consistency.referee.diagnostics.whitening import block_slices, squared_length
from consistency.referee.types import Array

PARTS = np.array([0.0, 0.125, 0.25, 0.5])  # of the share in question: what the bet takes the true share to be
HALVINGS = 40  # of the interval in which a limit is sought
FURTHEST = 100_000  # runs; more are not advice


@dataclass(frozen=True)
class Outlier:
    """The error that stands out most."""

    p_value: float  # over all runs and steps
    run: int  # row
    step: int  # column
    distance: float  # from the mean of the other runs in that step, in their standard deviations


def outliers(whitened: Array, known: StepMoments | None = None) -> Outlier:
    """Largest distance of any run in any step from the other runs, Wilks (1963).

    The squared Mahalanobis distance D^2 from the sample mean with the sample covariance has D^2 N / (N - 1)^2
    distributed as Beta(n / 2, (N - n - 1) / 2) for Gaussian errors of any mean and covariance; the
    smallest p value is multiplied by the number of runs and steps (Bonferroni). p is NaN where no step has
    n + 3 runs.

    Parameters
    ----------
    whitened : (runs, steps, n), NaN where a run has no value
    known : moments of ``whitened``, if already computed
    """
    if known is None:
        known = step_moments(whitened)
    N, mean, S = known
    n = whitened.shape[-1]
    usable = np.flatnonzero(n + 3 <= N)
    usable = usable[np.linalg.det(S[usable]) > 0]
    if not len(usable):
        return Outlier(float("nan"), -1, -1, float("nan"))
    precision = np.linalg.inv(S[usable])
    rows = np.empty(len(usable), np.int64)
    of_step = np.empty(len(usable))
    for here in block_slices(len(usable), len(whitened)):
        d2 = _distances(whitened[:, usable[here]] - mean[usable[here]], precision[here])
        rows[here] = d2.argmax(axis=0)
        of_step[here] = d2.max(axis=0)
    count = N[usable]
    with np.errstate(invalid="ignore"):
        p = distributions.beta.sf(np.minimum(of_step * count / (count - 1.0) ** 2, 1.0), n / 2, (count - n - 1) / 2)
    worst = int(p.argmin())
    p_value = min(1.0, float(p[worst]) * float(count.sum()))
    n_runs = float(count[worst])
    share = min(float(of_step[worst]) * n_runs / (n_runs - 1.0) ** 2, 1.0 - 1e-12)
    left_out = share / (1.0 - share) * n_runs * (n_runs - 2.0) / (n_runs - 1.0)  # without the run itself
    return Outlier(p_value, int(rows[worst]), int(usable[worst]), float(np.sqrt(left_out)))


def beyond_stated(whitened: Array) -> float:
    """Bonferroni's p value of the largest NEES of all runs and steps, (runs, steps, n), by the stated covariance.

    It is valid for a covariance that is too large as well: chi-square exceeds such a NEES in distribution.
    """
    nees = squared_length(whitened)
    count = int(np.isfinite(nees).sum())
    if not count:
        return float("nan")
    return min(1.0, count * float(distributions.chi2.sf(np.nanmax(nees), whitened.shape[-1])))


def _distances(gap: Array, precision: Array) -> Array:
    """gap' precision gap, (runs, steps, n) and (steps, n, n) -> (runs, steps); 0 where there is no value."""
    d2 = np.zeros(gap.shape[:2])
    for i in range(gap.shape[-1]):
        for j in range(gap.shape[-1]):
            d2 += gap[..., i] * precision[:, i, j] * gap[..., j]
    return np.where(np.isfinite(d2), np.maximum(d2, 0.0), 0.0)  # rounding may make it negative


def lost_bound(dof: int, rate: float | Array) -> Array:
    """Mean NEES that a right run exceeds with probability ``rate`` at most, however its steps depend on each other.

    E[X | X > q] of X = chi-square(n) with P(X > q) = rate: n P(chi-square(n + 2) > q) / rate. For any b > a,
    P(Y > b) <= E(Y - a)+ / (b - a); E(Y - a)+ is at most E(X - a)+ because (y - a)+ is convex and the mean NEES Y an
    average of such X (Jensen); with a = q and that b the right side is ``rate``. A chi-square quantile, the bound of
    steps that are all one and the same, is lower, and some kinds of dependence exceed it more often than stated.
    """
    q = special.chdtri(dof, rate)
    return np.asarray(dof * special.chdtrc(dof + 2, q) / rate)


def lost_evidence(is_lost: Array, share: float) -> Array:
    """E-values against 'a share of ``share`` or more is lost' after each run, (runs,) of bool -> (runs,).

    The mean over q in {0, 1/8, 1/4, 1/2} ``share`` of the likelihood ratio of q to ``share``. It falls with every lost
    run, so its mean is at most 1 for larger shares too, and it ever reaches 1 / alpha with probability alpha at most
    (Ville 1939).
    """
    q = PARTS * share
    with np.errstate(divide="ignore"):
        gains = np.where(np.asarray(is_lost)[:, None], np.log(q / share), np.log1p(-q) - np.log1p(-share))
    return np.asarray(np.exp(np.minimum(np.logaddexp.reduce(np.cumsum(gains, axis=0), axis=1) - np.log(len(q)), 700.0)))


def lost_of(record: Record, nees: Array, dof: int, settings: Settings, any_time: bool = False) -> Lost | None:
    """Lost runs among those that failed or have a NEES, and the share not excluded; None without such a run.

    Parameters
    ----------
    nees : (runs, steps), NaN where nothing counts
    any_time : the limit holds at any stopping time, and a run is lost or not regardless of that time: run i is judged
        at the rate / (i (i + 1))
    """
    means, counts = run_means(nees)
    numbers = np.asarray(record.run_numbers)
    failed = np.isin(numbers, [f.run for f in record.failures])
    there = failed | (counts > 0)
    runs = int(there.sum())
    if not runs:
        return None
    i = np.arange(1.0, runs + 1.0)
    rates = np.full(runs, settings.false_alarm / runs)
    if any_time:
        rates = settings.false_alarm / (i * (i + 1.0))
    is_lost = failed[there] | (np.nan_to_num(means[there]) > lost_bound(dof, rates))
    lost = int(is_lost.sum())
    level = settings.power
    needed = None
    if any_time:
        upper = _limit_at_any_time(is_lost, level)
        if settings.lost is not None:
            needed = _next(is_lost, settings.lost, level)
    else:
        upper = share_limit(lost, runs, level)
        if settings.lost is not None:
            needed = lost_runs(settings.lost, level, lost)
    return Lost(lost, runs, float(lost_bound(dof, rates[-1])), upper, level, needed)


def _limit_at_any_time(is_lost: Array, level: float) -> float:
    """Smallest share that the bet excludes: shares above it are excluded as well."""
    low = 0.0
    high = 1.0
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        if ever(lost_evidence(is_lost, middle)) <= 1.0 - level:
            high = middle
        else:
            low = middle
    return high


def _next(is_lost: Array, share: float, level: float) -> int | None:
    """Runs with which the bet excludes ``share``, if none of the further ones is lost; None beyond 100,000."""
    further = np.zeros(FURTHEST, bool)
    further[: len(is_lost)] = is_lost[:FURTHEST]
    reached = np.flatnonzero(lost_evidence(further, share) >= 1.0 / (1.0 - level))
    if not len(reached):
        return None
    return int(reached[0]) + 1


def early_ends(nees: Array) -> EarlyEnds:
    """Test whether runs that end early have a larger NEES in their last step than the runs that continue.

    In each step in which runs end, the NEES of all runs that have reached it are ranked. Given these values, each run
    is equally likely to end if ends do not depend on errors, however the steps depend on each other. So the sum of
    their ranks has the mean and variance of Wilcoxon (1945), and those of different steps are uncorrelated (Prentice
    1978, Biometrika 65). The sum over all steps is taken as normal, which for few runs is on the safe side.

    Parameters
    ----------
    nees : (runs, steps), NaN where a run has no value
    """
    there = np.isfinite(nees)
    last = np.where(there.any(axis=1), nees.shape[1] - 1 - np.argmax(there[:, ::-1], axis=1), -1)
    runs = 0
    above = 0.0
    gap = 0.0
    variance = 0.0
    for step in np.unique(last[(last >= 0) & (last < last.max(initial=-1))]):
        reached = there[:, step]
        ending = last[reached] == step
        R = int(reached.sum())
        d = int(ending.sum())
        if d == R:
            continue
        ranks = float(_ranks(nees[reached, step])[ending].sum())
        runs += d
        above += (ranks - 0.5 * d * (d + 1)) / (R - d)
        gap += ranks - 0.5 * d * (R + 1)
        variance += d * (R - d) * (R + 1) / 12.0
    if not runs:
        return EarlyEnds(0, float("nan"), float("nan"))
    return EarlyEnds(runs, above / runs, float(special.ndtr(-gap / np.sqrt(variance))))


def _ranks(values: Array) -> Array:
    """Ranks from 1, equal values sharing the mean of theirs."""
    _, place, count = np.unique(values, return_inverse=True, return_counts=True)
    return np.asarray((np.cumsum(count) - 0.5 * (count - 1))[place])
