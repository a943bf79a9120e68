"""Normalized estimation error squared, Bar-Shalom, Li & Kirubarajan (2001) sec. 5.4: intervals, tests, e-process.

The e-process is valid at any stopping time and under any dependence between steps.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from scipy import special

from consistency.referee.defaults import CONFIDENCE, FALSE_ALARM
from consistency.referee.diagnostics.records.large_arrays import by_steps
from consistency.referee.diagnostics.records.valid_covariances import asymmetric
from consistency.referee.diagnostics.records.whitening import mean_and_count, spread_steps, whiten
from consistency.referee.diagnostics.statistics import distributions
from consistency.referee.types import Array

UP = np.array([0.1, 0.25, 0.5, 1.0])  # stakes against a covariance too small
DOWN = np.array([0.25, 0.5, 1.0, 2.0, 4.0])  # against one too large
KEPT = 0.02  # of a stake, so that no single run ends the game


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


_half_width = lru_cache(distributions.kolmogorov.isf)


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
    return np.asarray(np.exp(np.minimum(special.logsumexp(totals, axis=1) - np.log(log_gains.shape[1]), 700.0)))
