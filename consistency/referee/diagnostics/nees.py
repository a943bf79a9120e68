"""Normalized estimation error squared: intervals, bands over steps, tests, e-process, and two mean NEES compared.

After Bar-Shalom, Li & Kirubarajan (2001) sec. 5.4. Coverage, RMSE and noncredibility stand beside it.

The e-process is valid at any stopping time and under any dependence between steps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from scipy import optimize, special

from consistency.referee.defaults import CONFIDENCE, FALSE_ALARM
from consistency.referee.diagnostics import distributions
from consistency.referee.diagnostics.whitening import (
    all_finite,
    asymmetric,
    block_slices,
    by_runs,
    by_steps,
    mean_and_count,
    of_runs,
    spread_steps,
    squared_length,
    whiten,
)
from consistency.referee.types import Array, Indices

FEW = 20  # runs; below, the dependence between steps is not estimated but taken as complete
NOTHING = (float("nan"), float("nan"))
ZERO = 1e-12  # NEES of errors that differ from 0 by the rounding of numbers alone
UP = np.array([0.1, 0.25, 0.5, 1.0])  # stakes against a covariance too small
DOWN = np.array([0.25, 0.5, 1.0, 2.0, 4.0])  # against one too large
KEPT = 0.02  # of a stake, so that no single run ends the game
_half_width = lru_cache(distributions.kolmogorov.isf)
TWO_SIGMA = 0.9544997361036416  # P(|N(0, 1)| <= 2)
REACH = 4.0  # standard errors; a value farther from the hypothesis moves the variance no more than this one
LARGEST = 50.0  # growth of the log variance at most, so that the exponential is finite


def anees_interval(dof: int, runs: int, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """Two-sided interval [r1, r2] of the average NEES of one step, Herath et al. (2007) eq. 17.

    Parameters
    ----------
    dof : dimension of the error
    runs : number of independent runs averaged
    confidence : probability that a consistent filter's average lies inside

    Raises
    ------
    ValueError
        dof or runs below 1, confidence outside (0, 1).
    """
    if dof < 1 or runs < 1:
        raise ValueError(f"dof and runs must be at least 1, got {dof} and {runs}")
    low, high = chi2_mean_interval(dof * runs, confidence)
    return low * dof, high * dof


def chi2_mean_interval(dof: float, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """Two-sided interval of chi-square over its degrees of freedom, for example of summed NIS."""
    if not 0.0 < confidence < 1.0:
        raise ValueError(f"confidence must lie between 0 and 1, got {confidence}")
    tail = 0.5 * (1.0 - confidence)
    return float(distributions.chi2.ppf(tail, dof) / dof), float(distributions.chi2.isf(tail, dof) / dof)


def binomial_interval(count: Any, draws: Any, confidence: float = CONFIDENCE) -> tuple[Array, Array]:
    """Exact interval of a share, Clopper & Pearson (1934), of ``count`` in ``draws``.

    Numbers or arrays that broadcast, whole or not; low and high have their shape. Without draws the interval is [0, 1].
    """
    count, draws = np.broadcast_arrays(np.asarray(count, float), np.asarray(draws, float))
    tail = 0.5 * (1.0 - confidence)
    some = count > 0.0
    not_all = count < draws
    low = special.betaincinv(np.where(some, count, 1.0), draws - count + 1.0, tail)
    high = special.betaincinv(count + 1.0, np.where(not_all, draws - count, 1.0), 1.0 - tail)
    return np.where(some, low, 0.0), np.where(not_all, high, 1.0)


def nees(error: Array, covariance: Array) -> Array:
    """error' covariance^-1 error, Herath et al. (2007) eq. 14.

    Parameters
    ----------
    error : (..., n), truth minus estimate; wrap angles first
    covariance : (..., n, n)

    Returns
    -------
    (...), chi-square distributed with n degrees of freedom if the covariance is the error's

    Raises
    ------
    ValueError
        Shapes do not fit, a value is not finite, or a covariance is not symmetric or not positive
        definite; the message names the first index.
    """
    e = np.asarray(error, float)
    P = np.asarray(covariance, float)
    n = e.shape[-1] if e.ndim else 0
    try:
        if P.shape[-2:] != (n, n):
            raise ValueError
        batch = np.broadcast_shapes(e.shape[:-1], P.shape[:-2])
        e = np.broadcast_to(e, (*batch, n))
        P = np.broadcast_to(P, (*batch, n, n))
    except ValueError:
        raise ValueError(f"error {e.shape} and covariance {P.shape} must be (..., n) and (..., n, n)") from None
    _require(np.isfinite(e), "the error is not finite", 1)
    _require(np.isfinite(P), "the covariance is not finite", 2)
    if not (np.swapaxes(P, -1, -2) == P).all():
        _require(~asymmetric(P), "the covariance is not symmetric", 0)
    whitened = whiten(e, P)
    if not np.isfinite(whitened).all():
        _require(np.linalg.eigvalsh(P) > 0, "the covariance is not positive definite", 1)
        raise ValueError("a covariance is not positive definite")
    return np.asarray(np.einsum("...i,...i->...", whitened, whitened))


def anees(values: Array) -> Array:
    """Average over runs, Herath et al. (2007) eq. 16: (runs, steps) -> (steps,).

    A NaN is a run that has no value in that step (rank-deficient covariance, or failed earlier); where
    no run has one the average is NaN.
    """
    return by_steps(lambda block: mean_and_count(block, 0)[0], np.asarray(values, float))


def pointwise_band(alive: Indices, dof: int) -> Array:
    """95 % interval of the ANEES of each single step, (steps,) -> (steps, 2); NaN without a run."""
    counts, of_step = np.unique(alive, return_inverse=True)
    intervals = [anees_interval(dof, int(m), CONFIDENCE) if m > 0 else NOTHING for m in counts]
    return np.array(intervals).reshape(-1, 2)[of_step]


@dataclass(frozen=True)
class Band:
    """Band in which the ANEES curve of a consistent filter stays in all steps at once."""

    low: Array  # (steps,), NaN where no run has a value
    high: Array  # (steps,)
    p_value: float  # of the curve: the smallest false-alarm rate at which it leaves its band; NaN without a step
    above: Array  # (steps,) of bool
    below: Array  # (steps,) of bool

    @property
    def outside(self) -> Array:
        """Whether the curve is outside in a step, on either side, (steps,) of bool."""
        return np.asarray(self.above | self.below)


def simultaneous_band(
    nees: Array, dof: int, false_alarm: float = FALSE_ALARM, method: str = "max", allow: str | None = None
) -> Band:
    """Band that the ANEES of a consistent filter leaves in any step with probability ``false_alarm`` at most.

    In each step, runs times ANEES is chi-square with runs times ``dof`` degrees of freedom (Bar-Shalom, Li &
    Kirubarajan 2001, sec. 5.4), turned into a standard normal z. With ``method`` "bonferroni" the rate is
    divided by the number of steps: exact under any dependence. With "max", the maximum of abs(z), neighbours
    that move together are counted once: P(max > c) <= sum P(z_k > c) - sum P(z_k > c, z_k+1 > c) (Hunter
    1976; Worsley 1982), with the second term from the bivariate normal with the correlation of the NEES in
    neighbouring steps over the runs, in Owen's (1956) T function: 2 Q(c) + 4 sum T(c, a_k), a_k^2 =
    (1 - rho_k) / (1 + rho_k). Where runs have gaps or end early, step averages are over different runs, and correlate
    less than the NEES of a run that has both steps: rho_k is that times s / sqrt(N_k N_k+1), where s of the N_k and
    N_k+1 runs are in both.

    An error that is written with few decimals may be 0. For the lower side such a NEES counts as the smallest that is
    not 0, so that a step is not "too small" by rounding alone.

    Parameters
    ----------
    nees : (runs, steps), NaN where a run has no value
    allow : "conservative" leaves the lower side open

    Raises
    ------
    ValueError
        Unknown method.
    """
    if method not in ("max", "bonferroni"):
        raise ValueError(f"method must be 'max' or 'bonferroni', got '{method}'")
    alive = np.isfinite(nees).sum(axis=0)
    judged = np.flatnonzero(alive > 0)
    low = np.full(nees.shape[1], np.nan)
    high = np.full(nees.shape[1], np.nan)
    none = np.zeros(nees.shape[1], bool)
    if not len(judged):
        return Band(low, high, float("nan"), none, none)
    sides = 1 if allow == "conservative" else 2
    slopes = None
    if method == "max" and len(nees) >= FEW:
        parts = (nees[:, judged[b.start : b.stop + 1]] for b in block_slices(len(judged) - 1, len(nees)))
        slopes = np.concatenate([_slopes(part) for part in parts])

    def exceedance(c: float) -> float:
        if slopes is None:
            return sides * len(judged) * float(special.ndtr(-c))
        return sides * float(special.ndtr(-c) + 2.0 * special.owens_t(c, slopes).sum())

    c = float(optimize.brentq(lambda x: exceedance(x) - min(false_alarm, 0.999 * exceedance(0.0)), 0.0, 38.0))
    curve = anees(nees)
    least = curve + _rounded_to_zero(nees) / np.maximum(alive, 1)
    counts, of_step = np.unique(alive[judged], return_inverse=True)
    highest, lowest = np.full(len(counts), -np.inf), np.full(len(counts), np.inf)
    np.maximum.at(highest, of_step, curve[judged])
    np.minimum.at(lowest, of_step, least[judged])
    upper = distributions.chi2.sf(counts * highest, counts * dof)
    lower = distributions.chi2.cdf(counts * lowest, counts * dof)
    smallest = float(upper.min() if sides == 1 else min(upper.min(), lower.min()))
    p_value = min(1.0, exceedance(max(float(-special.ndtri(smallest)), 0.0))) if smallest > 0 else 0.0
    if sides == 2:
        low[judged] = (distributions.chi2.ppf(special.ndtr(-c), counts * dof) / counts)[of_step]
    else:
        low[judged] = 0.0
    high[judged] = (distributions.chi2.isf(special.ndtr(-c), counts * dof) / counts)[of_step]
    with np.errstate(invalid="ignore"):
        return Band(low, high, p_value, curve > high, least < low)


def _rounded_to_zero(nees: Array) -> Array:
    """Sum of the zeros of each step of (runs, steps), each taken as the smallest NEES that is not 0, (steps,)."""
    with np.errstate(invalid="ignore"):
        smallest = float(np.min(nees, initial=np.inf, where=nees > ZERO))
        zeros = (nees <= ZERO).sum(axis=0)
    return np.asarray(zeros * smallest if np.isfinite(smallest) else 0.0 * zeros)


def _slopes(nees: Array) -> Array:
    """sqrt((1 - rho) / (1 + rho)) of neighbours among the steps of (runs, steps); rho from 0 to 1."""
    present = np.isfinite(nees)
    both = present[:, 1:] & present[:, :-1]
    shared = both.sum(axis=0)
    alive = present.sum(axis=0)
    count = np.maximum(shared, 1)
    a, b = (np.where(both, part, 0.0) for part in (nees[:, :-1], nees[:, 1:]))
    a, b = (np.where(both, part - part.sum(axis=0) / count, 0.0) for part in (a, b))
    scale = np.sqrt((a * a).sum(axis=0) * (b * b).sum(axis=0))
    rho = np.where((scale > 0) & (shared >= FEW), (a * b).sum(axis=0) / np.where(scale > 0, scale, 1.0), 0.0)
    rho = np.clip(rho * shared / np.sqrt(alive[:-1] * alive[1:]), 0.0, 1.0)
    return np.asarray(np.sqrt((1.0 - rho) / (1.0 + rho)))


@dataclass(frozen=True)
class Pit:
    """Probability integral transform of the NEES against its band."""

    values: Array  # (N,), sorted: uniform between 0 and 1 if the covariance is right
    half_width: float  # of the simultaneous band around the diagonal
    statistic: float  # Kolmogorov's distance
    p_value: float


def pit(nees: Array, dof: int, false_alarm: float = FALSE_ALARM) -> Pit:
    """Distribution function of the chi-square at the NEES of one step of each run, and Kolmogorov's test.

    One value a run, at steps spread over the trajectory (:func:`spread_steps`), is an independent sample, so
    the exact distribution of Kolmogorov's distance holds (Marsaglia, Tsang & Wang 2003) and the band holds
    for the whole empirical distribution function at once.

    Parameters
    ----------
    nees : (runs, steps), NaN where a run has no value
    dof : degrees of freedom, not fitted to the data
    """
    steps = spread_steps(np.isfinite(nees))
    rows = np.flatnonzero(steps >= 0)
    u = np.sort(distributions.chi2.cdf(nees[rows, steps[rows]], dof))
    if len(u) == 0:
        return Pit(u, float("nan"), float("nan"), float("nan"))
    return Pit(u, _half_width(false_alarm, len(u)), *kolmogorov(u))


def kolmogorov(u: Array) -> tuple[float, float]:
    """Kolmogorov's distance of independent values (N,) from the uniform distribution on [0, 1], and its p value."""
    u, N = np.sort(u), len(u)
    grid = np.arange(N + 1) / N
    distance = float(max((grid[1:] - u).max(), (u - grid[:-1]).max()))
    return distance, float(distributions.kolmogorov.sf(distance, N))


def _require(good: Array, what: str, last: int) -> None:
    """Raise ValueError, with the first index of the batch, unless all is true over the ``last`` axes."""
    if not good.all():
        bad = ~good.all(axis=tuple(range(-last, 0)))
        index = tuple(int(i) for i in np.argwhere(np.atleast_1d(bad))[0])
        raise ValueError(f"{what} at index {index if np.ndim(bad) else ()}")


# --- growing numbers of runs --------------------------------------------------------------------------


@dataclass(frozen=True)
class EProcess:
    """Betting on run means of the NEES; N runs in the order in which they came.

    For a filter whose covariance is right, or errs in the other direction only, each of ``up`` and ``down`` ever
    reaches 1 / alpha with probability alpha at most (Ville 1939), and so does ``both``.
    """

    up: Array  # (N,), e-value against 'no covariance is too small' after each run
    down: Array  # (N,), against 'none is too large'

    @property
    def both(self) -> Array:
        """(N,), against 'the covariance is right'."""
        return np.asarray(0.5 * (self.up + self.down))


def e_process(means: Array, dof: int | Array, shares: Array | None = None) -> EProcess:
    """E-process on run means Y_i of the NEES over its degrees of freedom, or on 1 + s_i (Y_i - 1).

    Up: the mean over stakes l of prod(1 + l (Y_i - 1)). Down: the mean over l of
    prod(0.98 max(0, 1 - l (Y_i - 1)) / c_l + 0.02), with c_l the mean of max(0, 1 - l (Y - 1)) for
    Y = chi-square(n) / n: c_l = (1 + l) F_n(x) - l F_n+2(x), x = n (1 + 1 / l), F_k the distribution function of
    chi-square(k).

    Each factor is convex in Y_i, and Y_i is an average over steps of chi-squares over n, so by Jensen's inequality
    its mean is at most that of a single step, 1, however the steps depend on each other and however many there
    are. Runs only have to be independent; they may differ in length, in dependence and in dimension. (Waudby-Smith &
    Ramdas 2024 describe betting on means; the mixture over stakes is of this project.)

    Parameters
    ----------
    means : (runs,), mean NEES of each run over its degrees of freedom; a run without a value is left out beforehand
    dof : dimension of the error, one number or (runs,)
    shares : (runs,), s_i, with which a factor f is larger by (1 - s_i) (1 - f(1)), see :func:`e_processes`; None: all 1
    """
    y = np.asarray(means, float)
    if shares is not None:
        y = 1.0 + shares * (y - 1.0)
    n = np.broadcast_to(np.asarray(dof, float), y.shape)[:, None]
    x = n * (1.0 + 1.0 / DOWN)
    expected = (1.0 + DOWN) * special.chdtr(n, x) - DOWN * special.chdtr(n + 2.0, x)
    gain = np.maximum(0.0, 1.0 - DOWN * (y[:, None] - 1.0)) / expected
    if shares is not None:
        gain += (1.0 - shares[:, None]) * (1.0 - 1.0 / expected)
    with np.errstate(divide="ignore"):  # a run without any error loses all that was staked
        won = np.log1p(UP * (y[:, None] - 1.0))
    return EProcess(_mixture(won), _mixture(np.log((1.0 - KEPT) * gain + KEPT)))


class EarlyMeans(NamedTuple):
    """Mean NEES of runs in which step k of T has the weight 1 / k, less for later steps, and only if the run has it."""

    means: Array  # (runs,), over the degrees of freedom
    shares: Array  # (runs,), sum of a run's weights over that of all T steps


def e_processes(means: Array, dof: int, early: EarlyMeans | None = None, ratio: float = 1.0) -> list[EProcess]:
    """E-process on run means and, where runs have unlike numbers of steps, another one on 1 + s_i (Y_i - 1).

    With the means and shares s_i of ``early`` that is the weighted mean over all T steps of the NEES over its degrees
    of freedom, or 1 in a step that the run does not have. If a right filter states its covariance given what it has
    measured, and that decides whether a step counts, such a value has the mean 1 and, by Jensen's inequality, factors
    f of :func:`e_process` with a mean of at most s_i + (1 - s_i) f(1). A run mean does not have the mean 1 then.

    Parameters
    ----------
    means : (runs,), mean NEES of each run over ``dof``
    early : its T and weights do not depend on the data; None where runs have equally many steps
    ratio : of true to stated covariance that the processes bet against
    """
    bets = [e_process(means / ratio, dof)]
    if early is not None:
        bets.append(e_process(early.means / ratio, dof, early.shares))
    return bets


def ever(values: Array) -> float:
    """p value of an e-process (N,) looked at after every run: 1 over the largest value so far."""
    return min(1.0, 1.0 / float(np.max(values, initial=1.0)))


def _mixture(log_gains: Array) -> Array:
    """Mean over stakes of the product up to each run, (N, stakes) -> (N,)."""
    totals = np.cumsum(log_gains, axis=0)
    return np.asarray(np.exp(np.minimum(np.logaddexp.reduce(totals, axis=1) - np.log(log_gains.shape[1]), 700.0)))


def coverage(error: Array, covariance: Array, bound: float = 2.0, counted: Array | None = None) -> Array:
    """Share of errors within ``bound`` standard deviations, for each axis.

    Shapes (..., n) and (..., n, n) -> (n,); rows with NaN, or not ``counted`` (...), do not count.
    """
    error = np.asarray(error, float)
    P = np.asarray(covariance, float)
    if error.ndim == 1:
        error = error[None]
        P = P[None]
    P = np.broadcast_to(P, (*error.shape, error.shape[-1]))
    n = error.shape[-1]
    inside = np.zeros(n, np.int64)
    count = np.zeros(n, np.int64)
    for here in of_runs(error):
        for i in range(n):
            e = error[here][..., i]
            sigma = _sigma(P[here][..., i, i])
            valid = np.isfinite(e) & np.isfinite(sigma)
            if counted is not None:
                valid &= counted[here]
            within = np.abs(np.where(valid, e, 0.0)) <= bound * np.where(valid, sigma, 0.0)
            inside[i] += (valid & within).sum()
            count[i] += valid.sum()
    return np.where(count > 0, inside / np.maximum(count, 1), np.nan)


def _sigma(variance: Array) -> Array:
    return np.sqrt(np.where(variance >= 0, variance, np.nan))


def rmse(error: Array, axes: Sequence[int] | None = None, counted: Array | None = None) -> float:
    """Root of the mean squared length of errors (..., n) over all runs and steps.

    NaN rows do not count.

    Parameters
    ----------
    axes : components of the length; all of them where None
    counted : (...) of bool, rows that count
    """
    e = np.asarray(error, float)
    if axes is None:
        axes = range(e.shape[-1])
    squared = np.empty(e[..., 0].size)
    count = 0
    for here in of_runs(e):
        part = squared_length(e[here][..., list(axes)])
        known = np.isfinite(part)
        if counted is not None:
            known &= counted[here]
        part = part[known]
        squared[count : count + len(part)] = part
        count += len(part)
    if not count:
        return float("nan")
    return float(np.sqrt(squared[:count].mean()))


def coverage_interval(
    error: Array,
    covariance: Array,
    bound: float = 2.0,
    confidence: float = CONFIDENCE,
    counted: Array | None = None,
) -> tuple[Array, Array]:
    """Coverage of one step of each run and its exact binomial interval (Clopper & Pearson 1934), for each axis.

    One step of each run, spread over the trajectory (:func:`spread_steps`), gives independent draws; pooled steps would
    not. Shapes (runs, steps, n), (runs, steps, n, n) -> (n,), (n, 2); rows with NaN, or not ``counted`` (runs, steps),
    are not drawn.
    """
    error = np.asarray(error, float)
    P = np.asarray(covariance, float)

    def usable(error: Array, P: Array) -> Array:
        out = np.ones(error.shape[:-1], bool)
        for i in range(error.shape[-1]):
            out &= np.isfinite(error[..., i]) & np.isfinite(P[..., i, i]) & (P[..., i, i] >= 0)
        return out

    there = by_runs(usable, error, P)
    if counted is not None:
        there &= counted
    steps = spread_steps(there)
    rows = np.flatnonzero(steps >= 0)
    if not len(rows):
        n = error.shape[-1]
        return np.full(n, np.nan), np.tile([0.0, 1.0], (n, 1))
    variance = np.diagonal(P[rows, steps[rows]], axis1=-2, axis2=-1)
    inside = (np.abs(error[rows, steps[rows]]) <= bound * _sigma(variance)).sum(axis=0)
    return inside / len(rows), np.stack(binomial_interval(inside, len(rows), confidence), axis=-1)


def noncredibility(error: Array, nees: Array) -> tuple[Array, Array]:
    """Noncredibility index and inclination index of every step, Li & Zhao (2006).

    10 / N times the sum over runs of log10(NEES / NEES*), with absolute value for the first and with sign for
    the second; NEES* is that with the actual mean squared error matrix of the step in place of the stated
    covariance. 0 is credible; 10 is a covariance wrong by a factor of 10. Inclination above 0 is
    overconfident. Both are relative to errors of the same runs, so they need many more runs than dimensions.

    Parameters
    ----------
    error : (runs, steps, n)
    nees : (runs, steps); NaN where a run has no value

    Returns
    -------
    (steps,) and (steps,) in dB; NaN where fewer than 2 n runs have a value
    """
    runs, steps = nees.shape
    n = error.shape[-1]
    index = np.full(steps, np.nan)
    inclination = np.full(steps, np.nan)
    if runs < 2 * n:
        return index, inclination
    for here in block_slices(steps, runs):
        present = np.isfinite(nees[:, here]) & all_finite(error[:, here]) & (nees[:, here] > 0)
        runs_in_step = present.sum(axis=0)
        e = np.where(present[..., None], error[:, here], 0.0)
        by_step = np.ascontiguousarray(np.moveaxis(e, 1, 0))
        mse = np.swapaxes(by_step, -1, -2) @ by_step / np.maximum(runs_in_step, 1)[:, None, None]
        scale = np.sqrt(np.diagonal(mse, axis1=-2, axis2=-1))
        scored = (runs_in_step >= 2 * n) & (scale > 0).all(axis=-1)
        unit = np.where(scored[:, None], scale, 1.0)
        correlation = mse / (unit[:, :, None] * unit[:, None, :])
        scored &= np.linalg.cond(np.where(scored[:, None, None], correlation, np.eye(n))) < 1e12
        if not scored.any():
            continue
        actual = squared_length(whiten(e[:, scored] / unit[scored], correlation[scored]))
        with np.errstate(divide="ignore", invalid="ignore"):
            over_actual = np.where(present[:, scored], nees[:, here][:, scored] / actual, 1.0)
            ratio = 10.0 * np.log10(over_actual)
        index[here][scored] = np.abs(ratio).sum(axis=0) / runs_in_step[scored]
        inclination[here][scored] = ratio.sum(axis=0) / runs_in_step[scored]
    return index, inclination


@dataclass(frozen=True)
class Contrast:
    """log ratio_a plus or minus log ratio_b, with its variance."""

    value: float
    variance: float
    slope: float  # change of the log variance with the value
    freedom: float  # degrees of freedom of Student's t

    @property
    def error(self) -> float:
        """Standard error of the value."""
        return float(np.sqrt(self.variance))

    @property
    def p_values(self) -> tuple[float, float]:
        """One-sided p values: of a true value that is not above 0, and of one that is not below 0."""
        if self.variance == 0.0:
            return float(self.value <= 0.0), float(self.value >= 0.0)
        move = min(abs(self.value), REACH * self.error)  # to the hypothesis
        t = self.value / self._error(-self.slope * move if self.value > 0.0 else self.slope * move)
        return float(special.stdtr(self.freedom, -t)), float(special.stdtr(self.freedom, t))

    def half_width(self, tail: float) -> float:
        """Distance from the value to a one-sided confidence limit, missed with probability ``tail`` at most."""
        widest = self._error(abs(self.slope) * REACH * self.error)
        return -float(special.stdtrit(self.freedom, tail)) * widest

    def _error(self, growth: float) -> float:
        """Standard error, to the safe side, where the log variance is larger by ``growth``."""
        return self.error * float(np.exp(0.5 * (min(max(growth, 0.0), LARGEST) + margin(self.freedom))))


def contrast(a: Array, b: Array, sign: float, paired: bool) -> Contrast:
    """log mean a - log mean b (``sign`` -1) or log mean a + log mean b (``sign`` 1) of run means.

    The variance comes from each run's first-order influence on the logarithms (Efron & Stein 1981). With few runs
    Student's t of it errs too often, because run means are skewed: a sample without large values has a small mean
    and a small spread. Therefore

    - the spread of the run means of a filter is at least that of a gamma distribution with their mean and mean
      logarithm, which reveals slow runs by their small values;
    - the variance is replaced by its value under the tested hypothesis, if that is larger. To first order its logarithm
      changes by ``slope`` times the value (Johnson 1978 corrects t for the same dependence);
    - it is taken one standard error to the safe side, see :func:`margin`.

    These corrections were chosen by simulation and then measured on fresh draws; they are not derived.

    Parameters
    ----------
    a, b : (R,), (S,), mean NEES of each run over dof; their means are positive
    paired : row i of both is the same trial (R = S); otherwise the runs are independent, and Student's t has as many
        degrees of freedom as the filter with fewer runs allows
    """
    x = a / a.mean() - 1.0
    y = sign * (b / b.mean() - 1.0)
    of_a = x.var(ddof=1) / len(x)
    of_b = y.var(ddof=1) / len(y)
    if paired:
        z = x + y
        variance = z.var(ddof=1) / len(z)
        change = z * z - 2.0 * x * _product(z, x) - 2.0 * sign * y * _product(z, y)
        bend = _third_moment(change, z)
    else:
        variance = of_a + of_b
        change_a = x * x - 2.0 * x * _product(x, x)
        change_b = y * y - 2.0 * sign * y * _product(y, y)
        bend = _third_moment(change_a, x) + _third_moment(change_b, y)
    value = float(np.log(a.mean()) + sign * np.log(b.mean()))
    freedom = min(len(a), len(b)) - 1.0
    if variance == 0.0:
        return Contrast(value, 0.0, 0.0, freedom)
    hidden = max(of_a, _gamma_spread(a) / len(a)) + max(of_b, _gamma_spread(b) / len(b))
    return Contrast(value, float(variance * hidden / (of_a + of_b)), float(bend / variance**2), freedom)


def margin(freedom: float) -> float:
    """Standard error of the logarithm of a variance with this many degrees of freedom, for Gaussian values."""
    return float(np.sqrt(2.0 / freedom))


def _product(x: Array, y: Array) -> float:
    return float(x @ y) / (len(x) - 1)


def _third_moment(change: Array, z: Array) -> float:
    """Covariance of the variance of the mean of ``z`` with this mean."""
    n = len(z)
    return float(change @ z) / (n * (n - 1) * (n - 2))


def _gamma_spread(means: Array) -> float:
    """Squared coefficient of variation of the gamma distribution with this mean and mean logarithm.

    1 / a with log a - digamma(a) = log mean - mean log, to within 1.5 %.
    """
    s = max(float(np.log(means.mean()) - np.log(np.maximum(means, np.finfo(float).tiny)).mean()), 0.0)
    return float(12.0 * s / (3.0 - s + np.sqrt((s - 3.0) ** 2 + 24.0 * s)))
