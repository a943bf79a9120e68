"""What a fit to the truth leaves of errors: the covariance of residuals whose steps depend on each other."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import fft, optimize

from consistency.types import Array

ENOUGH = 20  # runs that show how their errors depend on each other
REACH = 10  # longest time constant that is looked for in a run with a fit of its own: this part of its steps
SHORTEST = 0.5  # steps; errors of a shorter time constant are white
MARGIN = 2.0  # standard errors by which more is taken to be left than seems: by simulation, benchmarks/alignment.py
LONGEST, WIDER = (
    2,
    1.4,
)  # the longest lag that is looked at is this part of the steps; each bin of lags ends so much later


def left_covariances(residuals: Sequence[Array], bases: Sequence[Array], shared: bool) -> list[Array]:
    """Covariance of whitened residuals in each step, where that of whitened errors is I.

    A fit with d parameters projects whitened errors w of covariance C, all steps stacked, to r = (I - Q Q') w. Their
    covariance is (I - Q Q') C (I - Q Q'), whose diagonal blocks are returned; I - Q_k Q_k' where C is I. Components are
    taken to be independent and stationary, with correlations that are sums of exponentials. Their shares are found
    from the lagged products of the residuals, whose expectation is linear in C (the bias that the fit gives to them is
    so taken out), by non-negative least squares, in the same units whatever the size of the errors is.

    A fit of its own in each run looks as an error does that is constant over the run. So correlations longer than a
    part of the run are not looked for then; the result is moved ``MARGIN`` standard errors (jackknife over runs)
    towards I, and is too large rather than too small where errors are correlated for longer.

    Parameters
    ----------
    residuals : (T_i, n) for each run
    bases : (T_i, n, d) for each run; columns of Q, orthonormal in each run, or over all runs where ``shared``
    shared : one fit for all runs; else each run has its own

    Returns
    -------
    (T_i, n, n) for each run
    """
    longest, n = max(map(len, residuals)), residuals[0].shape[1]
    kernels, edges = _kernels(longest, shared), _bins(longest)
    seen = np.array([_binned(_products(r), edges) for r in residuals])  # (N, n, bins)
    pairs = np.array([_binned(np.maximum(len(r) - np.arange(longest), 0.0), edges) for r in residuals])  # (N, bins)
    expected = _expected(bases, kernels, edges, shared)  # (N, n, bins, n, J)
    shares = _shares(*(values.sum(axis=0) for values in (seen, expected, pairs)))
    left = _left(bases, shares @ kernels, shared)
    if shared:
        return left
    taken = sum(float(np.trace(np.eye(n) - M, axis1=1, axis2=2).sum()) for M in left)
    whole = n * sum(map(len, residuals))
    error = MARGIN * _error(seen, expected, pairs) * (whole - taken)
    back = min(error / taken, 1.0) if taken > 0 else 0.0
    return [M + back * (np.eye(n) - M) for M in left]


def _shares(seen: Array, expected: Array, pairs: Array) -> Array:
    """Shares of the kernels in the variance of each component, (n, J), from sums over runs."""
    design = (expected / pairs[:, None, None]).reshape(seen.size, -1)
    weights = optimize.nnls(design, (seen / pairs).ravel())[0].reshape(len(seen), -1)
    total = weights.sum(axis=1, keepdims=True)
    white = np.arange(weights.shape[1]) == 0
    return np.where(total > 0, weights / np.where(total > 0, total, 1.0), white)


def _error(seen: Array, expected: Array, pairs: Array) -> float:
    """Standard error of the logarithm of all variance that is left, by the jackknife over runs."""
    N, parts = len(seen), (seen, expected, pairs)
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


def _products(r: Array) -> Array:
    """Sums of r_k r_k+l by component and lag, (T, n) -> (n, T)."""
    return _lags(np.square(np.abs(_spectrum(r))), len(r))


def _times(kernels: Array, Q: Array) -> Array:
    """Toeplitz matrices times Q, kernel i of ``kernels`` (n, longest) times component i: (T, n, d) -> (T, n, d)."""
    T, size = len(Q), _size(len(Q))
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
    N, (_, n, d), J = len(bases), bases[0].shape, len(kernels)
    out = np.zeros((N, n, len(edges) - 1, n, J))
    G = np.zeros((N, J, n, d, d))
    for i, Q in enumerate(bases):
        T, F = len(Q), _spectrum(Q)
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
