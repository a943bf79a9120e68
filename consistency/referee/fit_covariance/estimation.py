"""Maximum likelihood of covariances by scoring, and intervals from values with each drive left out."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy import optimize, stats

from consistency.referee.defaults import CONFIDENCE
from consistency.referee.diagnostics.verdict_parts import Interval
from consistency.referee.types import Array

STEPS, SHORTEST = 100, 5e-4  # of scoring, and the part of a step that is tried last
TAIL = 0.5 * (1.0 - CONFIDENCE)
LEAST = 1e-12  # variance of the logarithm of a ratio


class Score(NamedTuple):
    """Log likelihood of p parameters but for its constant, and its derivatives."""

    value: float
    gradient: Array  # (p,)
    information: Array  # (p, p), expected


def solve_each(A: Array, b: Array) -> Array:
    """x of A x = b, of matrices A (..., n, n) and vectors b (..., n)."""
    return np.linalg.solve(A, b[..., None])[..., 0]


def nees_of(error: Array, C: Array) -> Array:
    """e' C^-1 e of errors (K, n) and covariances (K, n, n), (K,)."""
    return np.asarray((error * solve_each(C, error)).sum(axis=1))


def log_densities(error: Array, C: Array) -> Array:
    """Log density of each error (K, n) with its covariance (K, n, n), (K,)."""
    _, log_determinant = np.linalg.slogdet(2.0 * np.pi * C)
    return np.asarray(-0.5 * (nees_of(error, C) + log_determinant))


def score_of(error: Array, C: Array, F: Array) -> Score:
    """Score of Gaussian errors (K, n) with covariances C (K, n, n), whose derivatives are F (K, p, n, n)."""
    inverse = np.linalg.inv(C)
    u = (inverse @ error[..., None])[..., 0]
    G = inverse[:, None] @ F
    flat = G.reshape(*G.shape[:2], -1)
    turned = np.swapaxes(G, -1, -2).reshape(flat.shape)
    _, log_determinant = np.linalg.slogdet(C)
    value = -0.5 * float((error * u).sum() + log_determinant.sum())
    squares = np.einsum("ki,kpij,kj->p", u, F, u, optimize=True)
    gradient = 0.5 * (squares - np.einsum("kpii->p", G))
    information = 0.5 * np.tensordot(flat, turned, ((0, 2), (0, 2)))
    return Score(value, gradient, information)


def maximise(
    score: Callable[[Array], Score],
    theta: Array,
    least: Array | float,
    close: float,
) -> Array:
    """Parameters (p,) of at least ``least``, at least 0, with the largest likelihood.

    Each step solves the equations of the score with theta >= 0 (Lawson & Hanson 1974), and is halved until the
    likelihood grows. It ends where that gains less than ``close``.
    """
    here = score(theta)
    for _ in range(STEPS):
        target = np.maximum(nonnegative(here.information, here.gradient + here.information @ theta), least)
        step, gain = 1.0, -np.inf
        while gain < 0 and step >= SHORTEST:
            trial = theta + step * (target - theta)
            there = score(trial)
            gain = there.value - here.value
            step *= 0.5
        if gain > 0:
            theta, here = trial, there
        if gain < close:
            break
    return theta


def nonnegative(H: Array, g: Array) -> Array:
    """The minimum of x'Hx / 2 - g'x with x >= 0."""
    scale = np.sqrt(np.maximum(np.diag(H), 1e-300))
    values, vectors = np.linalg.eigh(H / np.outer(scale, scale))
    root = np.sqrt(np.maximum(values, 1e-9))
    target = (vectors.T @ (g / scale)) / root
    least, _ = optimize.nnls(root[:, None] * vectors.T, target)
    return np.asarray(least / scale)


def student(k: float, tail: float = TAIL) -> float:
    """Reach of an interval from k values, in standard errors."""
    return float(stats.t.isf(tail, k - 1))


def jackknife(left_out: Array) -> float:
    """Standard error of an estimate from its values with each of k units left out (k,) (Efron & Stein 1981)."""
    return float(np.sqrt(len(left_out) - 1) * left_out.std())


def interval_of(value: float, left_out: Sequence[float] | Array) -> Interval:
    """Interval of a variance from its values with each block left out, in cube roots (Wilson & Hilferty 1931)."""
    roots = np.cbrt(np.asarray(left_out))
    error = jackknife(roots)
    if not error > 0:  # 0 with any block left out: its upper end is not known
        return Interval(value, 0.0, float("nan"))
    reach = student(len(roots)) * error
    root = float(np.cbrt(value))
    return Interval(value, max(root - reach, 0.0) ** 3, (root + reach) ** 3)


def dof_of_ratio(left_out: Array) -> Array:
    """Degrees of freedom nu of ratios from their values with each of k runs left out, (k, ...) -> (...).

    A ratio spreads as chi-square(nu) / nu (Satterthwaite 1946), whose logarithm has a variance of 2 / nu.
    """
    variance = (len(left_out) - 1) * np.log(left_out).var(axis=0)
    return np.asarray(2.0 / np.maximum(variance, LEAST))


def effective_number(weights: Array) -> float:
    """Number of units of equal weight whose mean is known as well as that of units with ``weights`` (k,)."""
    return float(np.square(weights.sum()) / np.square(weights).sum())


def interval_of_ratio(value: float, left_out: Array, runs: float | None = None) -> Interval:
    """Interval of a positive ratio from its values with each run left out, (k,).

    The lower end is that of Student's t for the logarithm, the upper that of chi-square(nu) / nu at the same
    probability: each is the farther one of both, since few runs do not tell how a ratio is distributed. ``runs`` is the
    :func:`effective_number` of runs with unlike weights.
    """
    reach = student(runs or len(left_out))
    nu = float(dof_of_ratio(left_out))
    low = value * np.exp(-reach * jackknife(np.log(left_out)))
    least = float(stats.chi2.ppf(stats.norm.sf(reach), nu))
    return Interval(value, float(low), value * nu / max(least, 1e-300))


def chance_of_one(value: float, left_out: Array, runs: float | None = None) -> float:
    """Probability of a ratio as far from 1, or farther, where the right one is 1, by :func:`interval_of_ratio`."""
    nu = float(dof_of_ratio(left_out))
    errors = np.log(value) * np.sqrt(0.5 * nu)
    if value < 1.0:
        errors = stats.norm.isf(stats.chi2.cdf(nu * value, nu))
    return float(min(2.0 * stats.t.sf(errors, (runs or len(left_out)) - 1), 1.0))


def floor_interval(value: float, open_value: float, left_out: Array, runs: float | None = None) -> Interval:
    """Interval of a variance that may be 0 from its values with each run left out, (k,), which may lie below 0.

    It is that of a ratio where none of these is 0, and symmetric otherwise; of a variance of 0 it is one-sided.

    Parameters
    ----------
    open_value : the variance that fits best where it may lie below 0
    """
    if value > 0.0 and left_out.min() > 0.0:
        return interval_of_ratio(value, left_out, runs)
    tail = 2.0 * TAIL if value == 0.0 else TAIL
    reach = student(runs or len(left_out), tail) * jackknife(left_out)
    return Interval(value, max(value - reach, 0.0), max(open_value, 0.0) + reach)


def mean_over_runs(values: Array, tail: float = TAIL) -> Interval:
    """Mean of a value of each run, (R,), with Student's interval; of one run its ends are NaN."""
    mean = float(values.mean())
    if len(values) < 2:
        return Interval(mean, float("nan"), float("nan"))
    error = float(values.std(ddof=1) / np.sqrt(len(values)))
    reach = student(len(values), tail) * error
    return Interval(mean, mean - reach, mean + reach)
