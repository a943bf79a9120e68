"""Degrees of freedom lost to a fit: the covariance of residuals whose steps depend on each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import fft, linalg, optimize

from consistency.referee.diagnostics import distributions
from consistency.referee.types import Array

ENOUGH = 20  # runs that show how their errors depend on each other
REACH = 10  # longest time constant that is looked for in a run with a fit of its own: this part of its steps
SHORTEST = 0.5  # steps; errors of a shorter time constant are white
MARGIN = 2.0  # standard errors by which more is taken to be left than seems: by simulation, benchmarks/alignment.py
DOUBT = 0.01  # probability that correlations are called oscillating though they are sums of exponentials
LONGEST, WIDER = (
    2,
    1.4,
)  # the longest lag that is looked at is this part of the steps; each bin of lags ends so much later


@dataclass(frozen=True)
class Left:
    """Covariances of the residuals of a fit."""

    covariances: list[Array]  # (T_i, n, n) for each run
    oscillating: bool = False  # the errors are not what is assumed of them; the covariances are I
    unseen: float = 0.0  # share of the NEES that the fit may have absorbed without a correction


def left_covariances(residuals: Sequence[Array], bases: Sequence[Array], shared: bool) -> Left:
    """Covariance of whitened residuals in each step, where that of whitened errors is I.

    A fit with d parameters projects whitened errors w of covariance C, all steps stacked, to r = (I - Q Q') w. Their
    covariance is (I - Q Q') C (I - Q Q'), whose diagonal blocks are returned; I - Q_k Q_k' where C is I. Components are
    taken to be independent and stationary, with correlations that are sums of exponentials. Their shares are found
    from the lagged products of the residuals, whose expectation is linear in C (the bias that the fit gives to them is
    so taken out), by non-negative least squares, in the same units whatever the size of the errors is.

    A fit for each run cannot be told from an error that is constant over the run. So correlations longer than a part of
    the run are not looked for then; the result is moved ``MARGIN`` standard errors (jackknife over runs) towards I, and
    is too large rather than too small where errors are correlated for longer. Errors that alternate or oscillate lose
    less to such a fit than the model says. They are detected by a correlation at some lag that is smaller than any sum
    of exponentials, of any length, allows: Student's t over runs for each bin of lags, in each component and in all
    together, at ``DOUBT`` (Bonferroni). Then I is returned, which is never too small.

    Parameters
    ----------
    residuals : (T_i, n) for each run
    bases : (T_i, n, d) for each run; columns of Q, orthonormal in each run, or over all runs where ``shared``
    shared : one fit for all runs; else each run has its own

    """
    longest = max(map(len, residuals))
    n = residuals[0].shape[1]
    kernels = _kernels(longest, shared)
    edges = _bins(longest)
    every = kernels
    if not shared:
        every = np.concatenate([kernels, _slower(longest)])
    # sums of r_k r_k+l, (N, n, bins)
    seen = np.array([_binned(_lags(np.square(np.abs(_spectrum(r))), len(r)), edges) for r in residuals])
    pairs = np.array([_binned(np.maximum(len(r) - np.arange(longest), 0.0), edges) for r in residuals])  # (N, bins)
    whole = _expected(bases, every, edges, shared)  # (N, n, bins, n, J)
    if not shared and _oscillate(seen, whole, pairs):
        return Left([np.tile(np.eye(n), (len(r), 1, 1)) for r in residuals], True, _at_most(residuals, bases))
    expected = whole[..., : len(kernels)]
    shares = _shares(*(values.sum(axis=0) for values in (seen, expected, pairs)))
    left = _left(bases, shares @ kernels, shared)
    if shared:
        return Left(left)
    taken = sum(float(np.trace(np.eye(n) - M, axis1=1, axis2=2).sum()) for M in left)
    error = MARGIN * _error(seen, expected, pairs) * (n * sum(map(len, residuals)) - taken)
    back = 0.0
    if taken > 0:
        back = min(error / taken, 1.0)
    return Left([M + back * (np.eye(n) - M) for M in left])


def inflation_of_mean(residuals: Sequence[Array], bases: Sequence[Array]) -> float:
    """Variance of the mean of all runs over what it is if runs are independent, in the worst direction.

    A fit to all runs has one error in all of them. With m_i the mean residual of run i and s_i = Q_i' r_i, run i adds
    m_i / N - q s_i to the mean, where q is the mean of the m_i that a unit of each parameter makes. The sum of the
    squares of these is the variance of the mean under any dependence of steps (Liang & Zeger 1986, eq. 7), and 1 / N
    of the sample covariance of the m_i is what a test of the mean takes it to be.

    Parameters
    ----------
    residuals : (T_i, n) for each run
    bases : (T_i, n, d) for each run; columns of Q, orthonormal over all runs
    """
    means = np.array([r.mean(axis=0) for r in residuals])
    scores = np.array([np.einsum("kap,ka->p", Q, r) for Q, r in zip(bases, residuals, strict=True)])
    q = np.mean([Q.mean(axis=0) for Q in bases], axis=0)
    parts = means / len(means) - scores @ q.T
    N = len(means)
    variance = N * parts.T @ parts
    assumed = np.atleast_2d(np.cov(means.T))
    little = np.finfo(float).eps * max(float(np.trace(variance)), np.finfo(float).tiny)
    return float(linalg.eigh(variance, assumed + little * np.eye(len(variance)), eigvals_only=True)[-1])


def _oscillate(seen: Array, expected: Array, pairs: Array) -> bool:
    """Is a lagged product smaller than those kernels of ``expected`` that fit best make it?"""
    N = len(seen)
    weights = _weights(*(values.sum(axis=0) for values in (seen, expected, pairs)))
    off = seen - np.einsum("iambj,bj->iam", expected, weights)
    for each in (off, off.sum(axis=1)):
        mean = each.mean(axis=0)
        spread = each.std(axis=0, ddof=1) / np.sqrt(N)
        t = mean[spread > 0] / spread[spread > 0]
        if (distributions.t.cdf(t, N - 1) * mean.size <= 0.5 * DOUBT).any():
            return True
    return False


def _at_most(residuals: Sequence[Array], bases: Sequence[Array]) -> float:
    """Largest share of the NEES that a fit can absorb: of each component the largest value of its mean periodogram."""
    size = _size(max(map(len, residuals)))
    periodograms = sum(np.square(np.abs(fft.rfft(r, size, axis=0))) for r in residuals)
    squares = sum(np.square(r).sum(axis=0) for r in residuals)
    largest = np.max(periodograms, axis=0) / np.where(squares > 0, squares, 1.0)
    directions = sum(np.square(Q).sum(axis=(0, 2)) for Q in bases)
    return min(float(directions @ largest) / sum(r.size for r in residuals), 1.0)


def _weights(seen: Array, expected: Array, pairs: Array) -> Array:
    """Sizes of the kernels in each component, (n, J), from sums over runs."""
    design = (expected / pairs[:, None, None]).reshape(seen.size, -1)
    return np.asarray(optimize.nnls(design, (seen / pairs).ravel())[0].reshape(len(seen), -1))


def _shares(seen: Array, expected: Array, pairs: Array) -> Array:
    """Shares of the kernels in the variance of each component, (n, J), from sums over runs."""
    weights = _weights(seen, expected, pairs)
    total = weights.sum(axis=1, keepdims=True)
    white = np.arange(weights.shape[1]) == 0
    return np.where(total > 0, weights / np.where(total > 0, total, 1.0), white)


def _error(seen: Array, expected: Array, pairs: Array) -> float:
    """Standard error of the logarithm of all variance that is left, by the jackknife over runs."""
    N = len(seen)
    parts = (seen, expected, pairs)
    at_lag_0 = expected[:, :, 0].sum(axis=(0, 1))
    logs = np.log([(_shares(*(v.sum(axis=0) - v[i] for v in parts)) * at_lag_0).sum() for i in range(N)])
    return float(np.sqrt((N - 1) / N * np.square(logs - logs.mean()).sum()))


def _kernels(longest: int, shared: bool) -> Array:
    """Correlations at lags 0 to ``longest`` - 1: white, exponentials, and where ``shared`` a constant; (J, longest)."""
    lag = np.arange(longest)
    most = max(longest if shared else longest / REACH, SHORTEST)
    times = most / 2.0 ** np.arange(np.floor(np.log2(most / SHORTEST)) + 1.0)
    rows = [lag == 0, *(np.exp(-lag / tau) for tau in times)]
    return np.array([*rows, np.ones(longest)] if shared else rows, float)


def _slower(longest: int) -> Array:
    """Exponentials longer than those of a run with a fit of its own, up to a constant; (J, longest)."""
    times = max(longest / REACH, SHORTEST) * 2.0 ** np.arange(1.0, np.ceil(np.log2(2 * REACH)) + 1.0)
    return np.exp(-np.arange(longest) / times[:, None])


# --- lags ---------------------------------------------------------------------------------------------------


def _bins(longest: int) -> Array:
    """First lag of each bin, and the end of the last: lags 0 and 1 by themselves, then wider and wider ones."""
    most = min(max(longest // LONGEST, 2), longest)
    edges = [0, 1]
    while edges[-1] < most:
        edges.append(min(int(np.ceil(edges[-1] * WIDER)), most))
    return np.array(edges)


def _binned(values: Array, edges: Array) -> Array:
    """Sums of values (..., lags) over the lags of each bin; lags beyond those given are 0."""
    padded = np.zeros((*values.shape[:-1], int(edges[-1])))
    some = min(values.shape[-1], int(edges[-1]))
    padded[..., :some] = values[..., :some]
    return np.asarray(np.add.reduceat(padded, edges[:-1], axis=-1))


def _spectrum(values: Array) -> Array:
    """Of (T, ...) with as many zeros behind."""
    return np.asarray(fft.rfft(values, _size(len(values)), axis=0))


def _size(T: int) -> int:
    return int(fft.next_fast_len(2 * T, True))


def _lags(spectrum: Array, T: int) -> Array:
    """Back from a product of spectra to lags, the last axis: (F, ...) -> (..., T)."""
    return np.moveaxis(fft.irfft(spectrum, _size(T), axis=0)[:T], 0, -1)


def _times(kernels: Array, Q: Array) -> Array:
    """Toeplitz matrices times Q, kernel i of ``kernels`` (n, longest) times component i: (T, n, d) -> (T, n, d)."""
    T = len(Q)
    size = _size(len(Q))
    around = np.zeros((size, len(kernels)))
    around[:T] = kernels[:, :T].T
    around[size - T + 1 :] = around[T - 1 : 0 : -1]
    return np.asarray(fft.irfft(_spectrum(Q) * fft.rfft(around, axis=0).real[:, :, None], size, axis=0)[:T])


# --- covariances --------------------------------------------------------------------------------------------


def _expected(bases: Sequence[Array], kernels: Array, edges: Array, shared: bool) -> Array:
    """Expected lagged products of each run and component, for each kernel in each component: (N, n, bins, n, J).

    With B = C Q and G = Q' B the covariance of residuals is C - Q B' - B Q' + Q G Q', in which G is that of all runs
    where they share the fit.
    """
    N = len(bases)
    (_, n, d) = bases[0].shape
    J = len(kernels)
    out = np.zeros((N, n, len(edges) - 1, n, J))
    G = np.zeros((N, J, n, d, d))
    for i, Q in enumerate(bases):
        T = len(Q)
        F = _spectrum(Q)
        plain = _binned((T - np.arange(T)) * kernels[:, :T], edges)
        for j, kernel in enumerate(kernels):
            B = _times(np.tile(kernel, (n, 1)), Q)
            G[i, j] = np.einsum("kbp,kbq->bpq", Q, B)
            cross = _binned(_lags(2.0 * (F.conj() * _spectrum(B)).real.sum(axis=2), T), edges)
            out[i, range(n), :, range(n), j] = plain[j] - cross
    if shared:
        G[:] = G.sum(axis=0)
    for i, Q in enumerate(bases):
        F = _spectrum(Q)
        pairs = _binned(_lags((F.conj()[:, :, :, None] * F[:, :, None, :]).real, len(Q)), edges)  # (n, d, d, bins)
        out[i] += np.einsum("apqm,jbpq->ambj", pairs, G[i], optimize=True)
    return out


def _left(bases: Sequence[Array], kernels: Array, shared: bool) -> list[Array]:
    """Diagonal blocks (T, n, n) of (I - Q Q') C (I - Q Q') of each run, for correlations (n, longest)."""
    B = [_times(kernels, Q) for Q in bases]
    G = [np.einsum("kbp,kbq->pq", Q, b) for Q, b in zip(bases, B, strict=True)]
    if shared:
        G = [np.sum(G, axis=0)] * len(G)
    out = []
    for Q, b, g in zip(bases, B, G, strict=True):
        cross = Q @ np.swapaxes(b, 1, 2)
        out.append(np.eye(Q.shape[1]) - cross - np.swapaxes(cross, 1, 2) + Q @ g @ np.swapaxes(Q, 1, 2))
    return out
