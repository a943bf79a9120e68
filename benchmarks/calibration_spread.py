"""Does the question of the scale keep its rate where runs differ? And how often do intervals miss there?

Run means of right filters are drawn directly: in a share of the runs a group of axes has one error in all steps, and
all else is well mixed. The question is asked of many draws at once, by :func:`p_values`. Intervals of the ratio are
counted in the same worlds and where a tenth of the runs are larger, those of ``compare`` with few runs.
``calibration.py`` puts the rows into its table.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from calibration_gates import row
from scipy import special, stats

from consistency.diagnostics import Record, judge, make_record, ratio_interval
from consistency.referee.diagnostics import scale
from consistency.referee.diagnostics.comparison import RunSummary, compare
from consistency.referee.diagnostics.verdict_parts import SHARES
from consistency.referee.types import Array

STEPS, GATE_STEPS = 2000, 100
# dimension, axes of the group, share of the runs, runs
WORLDS = (
    (2, 1, 1.0, 21), (3, 1, 0.3, 34), (3, 1, 0.5, 102), (6, 1, 0.1, 50), (6, 1, 0.3, 50), (6, 1, 0.5, 21),
    (6, 1, 0.5, 50), (6, 1, 1.0, 21), (6, 2, 0.5, 50), (15, 1, 0.5, 102), (15, 1, 1.0, 25),
)  # fmt: skip
JUDGED = (6, 1, 0.5, 50)  # by whole verdicts
QUICK = (JUDGED,)
DRAWS = {1e-3: 100_000, 1e-4: 300_000}  # of the question, by the rate of the verdict
QUICK_DRAWS, BATCH = 100_000, 5000
GATES, INTERVALS, QUICK_COUNT = 2000, 2000, 300
GATE_RATE, MISSED = 0.05, 0.05
REACHED_OF_TWO = 0.06  # what intervals miss in where one of two axes is constant in all runs; 5.5 % of 5,000 measured
LARGER, TENTH = 6.0, 0.1  # times, of the runs
EVEN, SLOW = "10 % of the runs x6, the rest well mixed", "10 % of the runs x6, fully dependent"
NUMBERS = {EVEN: 60, SLOW: 3}  # degrees of freedom of a run
# The share in which intervals miss there, by the number of runs; measured with other seeds, and rounded up. A sample
# with few or none of the larger runs does not show them: with 21 runs, 11 % of the samples have none.
REACHED = {EVEN: {21: 0.14, 50: 0.06, 102: 0.07}, SLOW: {21: 0.14, 50: 0.11, 102: 0.08}}
PAIR, PAIR_RUNS, PAIR_RATIO = "one step, x1.5 against a right filter", (8, 21, 50), 1.5
QUESTION, INTERVAL, UNEVEN = "scale where runs differ", "interval misses", "interval misses, uneven runs"
COVERAGE = "interval of compare misses, coverage"


def _world(n: int, group: int, share: float) -> str:
    axes = "one axis" if group == 1 else f"{group} axes"
    return f"{axes} constant in {share:.0%} of runs, n = {n}"


ABOUT = {
    **{
        _world(n, group, share): f"{group} of {n} axes have one error in all steps of so many runs, the rest is white"
        for n, group, share, _ in WORLDS
    },
    EVEN: "n = 3; run means are chi-square(60), a tenth of them six times as large",
    SLOW: "n = 3; run means are chi-square(3), a tenth of them six times as large",
    PAIR: "one step a run, n = 1, filters with independent errors on the same trials",
    QUESTION: "a right filter's scale is found wrong, at the share of this question of 1e-3 and 1e-4",
    INTERVAL: "the 95 % interval of true / stated does not hold 1",
    UNEVEN: "the 95 % interval of true / stated does not hold the ratio; beyond 5 %, the rate that is reached",
    COVERAGE: "the 95 % interval of the difference in 2-sigma coverage does not hold it",
}


def rows(quick: bool, seed: int) -> list[dict[str, Any]]:
    return [*_question_rows(quick, seed), *_interval_rows(quick, seed), *_verdict_rows(quick, seed)]


def _question_rows(quick: bool, seed: int) -> Iterator[dict[str, Any]]:
    for n, group, share, runs in QUICK if quick else WORLDS:
        rng = np.random.default_rng((seed, 101, n, group, int(100 * share), runs))
        most = QUICK_DRAWS if quick else max(DRAWS.values())
        batches = [run_means(rng, n, group, share, (BATCH, runs)) for _ in range(most // BATCH)]
        p = np.concatenate([p_values(means, n, STEPS) for means in batches])
        for rate, draws in DRAWS.items():
            found = int((p[:draws] <= rate * SHARES["scale"]).sum())
            of_question = rate * SHARES["scale"]
            yield row(_world(n, group, share), QUESTION, 1.0, runs, of_question, "<=", min(draws, most), found)


def _interval_rows(quick: bool, seed: int) -> Iterator[dict[str, Any]]:
    count = QUICK_COUNT if quick else INTERVALS
    for n, group, share, runs in QUICK if quick else WORLDS:
        rng = np.random.default_rng((seed, 102, n, group, int(100 * share), runs))
        draws = run_means(rng, n, group, share, (count, runs))
        missed = sum(not ratio_interval(means, n).holds(1.0) for means in draws)
        rate = REACHED_OF_TWO if n == 2 else MISSED
        yield row(_world(n, group, share), INTERVAL, 1.0, runs, rate, "<=", count, missed)
    for k, (world, nu) in enumerate(NUMBERS.items()):
        for runs, rate in REACHED[world].items():
            rng = np.random.default_rng((seed, 103, k, runs))
            larger = np.where(rng.random((count, runs)) < TENTH, LARGER, 1.0)
            ratio = 1.0 + TENTH * (LARGER - 1.0)
            draws = rng.chisquare(nu, (count, runs)) / nu * larger
            missed = sum(not ratio_interval(means, 3).holds(ratio) for means in draws)
            yield row(world, UNEVEN, ratio, runs, rate, "<=", count, missed)
    for runs in PAIR_RUNS[1:2] if quick else PAIR_RUNS:
        rng = np.random.default_rng((seed, 104, runs))
        missed = sum(_misses_coverage(rng, runs) for _ in range(count))
        yield row(PAIR, COVERAGE, PAIR_RATIO, runs, MISSED, "<=", count, missed)


def _verdict_rows(quick: bool, seed: int) -> Iterator[dict[str, Any]]:
    if quick:
        return
    n, group, share, runs = JUDGED
    rng = np.random.default_rng((seed, 105))
    faults = sum(judge(_evidence(rng, n, group, share, runs)).p_value <= GATE_RATE for _ in range(GATES))
    yield row(_world(n, group, share), "false alarm", 1.0, runs, GATE_RATE, "<=", GATES, int(faults))


def run_means(rng: np.random.Generator, n: int, group: int, share: float, size: tuple[int, ...]) -> Array:
    """Mean NEES of runs over n, in the shape ``size``."""
    constant = rng.random(size) < share
    mixed = rng.chisquare(np.where(constant, n - group, n) * STEPS) / STEPS
    return np.asarray((mixed + np.where(constant, rng.chisquare(group, size), 0.0)) / n)


def _evidence(rng: np.random.Generator, n: int, group: int, share: float, runs: int) -> Record:
    error = rng.standard_normal((runs, GATE_STEPS, n))
    constant = rng.random(runs) < share
    error[constant, :, :group] = rng.standard_normal((int(constant.sum()), 1, group))
    return make_record("spread", error=error, covariance=np.broadcast_to(np.eye(n), (*error.shape, n)))


def _misses_coverage(rng: np.random.Generator, runs: int) -> bool:
    """Of two filters with independent errors, one right and one of which 1.5 times the variance is true."""
    squares = rng.chisquare(1, (2, runs, 1)) * [[[1.0]], [[PAIR_RATIO]]]
    right, wrong = (RunSummary(np.arange(runs), 1, x[:, 0], x, (x <= 4.0).astype(float)) for x in squares)
    difference = compare(right, wrong).differences[2]
    true = stats.chi2.cdf(4.0, 1) - stats.chi2.cdf(4.0 / PAIR_RATIO, 1)
    return not difference.low <= true <= difference.high


# --- the question, of many draws at once ----------------------------------------------------------------------


def p_values(means: Array, dof: int, steps: int) -> Array:
    """Two-sided p values of ``scale_test``, (draws, runs) -> (draws,); at least 20 runs and 2 steps."""
    above, below = tails(means, dof, steps)
    return np.asarray(np.minimum(1.0, 2.0 * np.minimum(above, below)))


def tails(means: Array, dof: int, steps: int) -> tuple[Array, Array]:
    """``above`` and ``below`` of ``scale_test``, (draws,) both."""
    runs, ratio = means.shape[1], means.mean(axis=1)
    by_spread, left_out = _log_nu_of_means(means, ratio)
    by_spread, variance = _at_mean_one(by_spread, left_out, means, ratio)
    by_spread = _at_most_skewness(by_spread, ratio, dof)
    by_likelihood, error = scale._log_nu_of_gamma(means.T)
    log_nu = np.minimum(np.minimum(by_spread - np.sqrt(variance), by_likelihood - error), np.log(dof * steps))
    estimated = log_nu > np.log(dof)
    k = runs * np.where(estimated, np.exp(log_nu), dof)
    exact = special.chdtrc(k, k * ratio), special.chdtr(k, k * ratio)
    above, below = (np.where(estimated, special.stdtr(2.0 / variance, special.ndtri(p)), p) for p in exact)
    return above, below


def _log_nu_of_means(means: Array, ratio: Array) -> tuple[Array, Array]:
    runs, left = means.shape[1], _left_out_mean(means)
    squares = np.square(means)
    cv = np.maximum(means.var(axis=1, ddof=1) / ratio**2, 1e-12)
    variance = (squares.sum(axis=1, keepdims=True) - squares - (runs - 1) * left**2) / (runs - 2)
    smallest = 1e-12 * ratio[:, None] ** 2
    return np.log(2.0 / cv) - np.log1p(cv / runs), np.log(2.0 * left**2 / np.maximum(variance, smallest))


def _at_mean_one(log_nu: Array, left_out: Array, means: Array, ratio: Array) -> tuple[Array, Array]:
    log_mean = np.log(_left_out_mean(means))
    of_mean, both = _jackknife(log_mean, log_mean), _jackknife(left_out, log_mean)
    slope, reach = both / of_mean, scale.REACH * np.sqrt(of_mean)
    variance = np.maximum(_jackknife(left_out, left_out) - slope * both, 2.0 / means.shape[1])
    return log_nu + np.minimum(-slope * np.clip(np.log(ratio), -reach, reach), 0.0), variance


def _at_most_skewness(log_nu: Array, ratio: Array, dof: int) -> Array:
    change = scale.SKEWNESS * 4.0 / dof * (1.0 - ratio)
    low = np.flatnonzero(change > 0.0)
    if dof == 1 or not len(low):
        return log_nu
    observed = 2.0 * ratio[low] ** 2 * np.exp(-log_nu[low])
    lambertw: Any = special.lambertw  # its stubs know no array of this kind
    bound = np.log(2.0 * lambertw(change[low] / observed).real / change[low])
    log_nu[low] = np.minimum(log_nu[low], bound)
    return log_nu


def _left_out_mean(means: Array) -> Array:
    return np.asarray((means.sum(axis=1, keepdims=True) - means) / (means.shape[1] - 1))


def _jackknife(a: Array, b: Array) -> Array:
    runs = a.shape[1]
    a, b = (x - x.mean(axis=1, keepdims=True) for x in (a, b))
    return np.asarray((runs - 1) / runs * (a * b).sum(axis=1))
