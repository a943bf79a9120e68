"""What a fit to the truth leaves of errors: the covariance of residuals whose steps depend on each other."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import fft, optimize

from consistency.types import Array

ENOUGH = 20  # runs that show how their errors depend on each other
REACH = 10  # longest time constant that a run shows is this part of its steps
SHORTEST = 0.5  # steps; errors of a shorter time constant are white
MARGIN = 2.0  # standard errors by which more is taken to be left than seems
LONGEST = 2  # and the longest lag that is looked at is this part


def left_covariances(residuals: Sequence[Array], bases: Sequence[Array], shared: bool) -> list[Array]:
    """Covariance of whitened residuals in each step, as a share of that of the errors before the fit.

    A fit with d parameters projects whitened errors w of covariance C, all steps stacked, to r = (I - Q Q') w. Their
    covariance is (I - Q Q') C (I - Q Q'), of which the blocks (n, n) on the diagonal are returned for a C of unit
    variance: where C is I, that is I - Q_k Q_k'. Components of the whitened errors are taken to be independent of each
    other, stationary, with correlations that are sums of exponentials; these are found from the lagged products of
    the residuals, whose expectation is linear in C (so that the bias that the fit gives to them is taken out), by
    non-negative least squares.

    Parameters
    ----------
    residuals : (T_i, n) for each run
    bases : (T_i, n, d) for each run; columns of Q, orthonormal in each run, or over all runs where ``shared``
    shared : the parameters are those of all runs together, else each run has its own. Then a correlation that is
        longer than a tenth of the run is not looked for, because it looks as the fit does.

    Returns
    -------
    (T_i, n, n) for each run
    """
    longest, n = max(map(len, residuals)), residuals[0].shape[1]
    kernels, edges = _kernels(longest, shared), _bins(longest)
    seen = np.array([_binned(_products(r), edges) for r in residuals])  # (N, n, bins)
    expected = np.array([_expected(Q, kernels, edges) for Q in bases])  # (N, n, bins, n, J)
    if shared:
        expected += _of_shared(bases, kernels, edges)
    pairs = np.array([_binned(np.maximum(len(r) - np.arange(longest), 0.0), edges) for r in residuals])
    shares = _shares(seen.sum(axis=0), expected.sum(axis=0), pairs.sum(axis=0))
    left = _left(bases, shares @ kernels, shared)
    if shared:
        return left
    error = _error(seen, expected, pairs)
    whole = n * sum(map(len, residuals))
    traces = sum(float(np.trace(M, axis1=1, axis2=2).sum()) for M in left)
    back = min(np.expm1(MARGIN * error) * traces / max(whole - traces, 1e-12), 1.0)
    return [M + back * (np.eye(n) - M) for M in left]


def _shares(seen: Array, expected: Array, pairs: Array) -> Array:
    """Shares of the kernels in the variance of each component, (n, J), from sums over runs."""
    n = len(seen)
    design = (expected / pairs[None, :, None, None]).reshape(seen.size, -1)
    weights = optimize.nnls(design, (seen / pairs).ravel())[0].reshape(n, -1)
    return weights / np.maximum(weights.sum(axis=1, keepdims=True), 1e-300)


def _error(seen: Array, expected: Array, pairs: Array) -> float:
    """Standard error of the logarithm of the whole variance that is left, by the jackknife over runs."""
    N = len(seen)
    whole = expected[:, :, 0].sum(axis=(0, 1))
    sums = [each.sum(axis=0) for each in (seen, expected, pairs)]
    logs = np.array([
        np.log((_shares(*(total - each[i] for total, each in zip(sums, (seen, expected, pairs), strict=True))) * whole).sum())
        for i in range(N)
    ])
    return float(np.sqrt((N - 1) / N * np.square(logs - logs.mean()).sum()))


def _kernels(longest: int, shared: bool) -> Array:
    """Correlations at lags 0 to ``longest`` - 1: white, exponentials, and where ``shared`` a constant; (J, longest)."""
    lag = np.arange(longest)
    most = longest if shared else longest / REACH
    times = max(most, SHORTEST) / 2.0 ** np.arange(max(np.floor(np.log2(most / SHORTEST)), 0.0) + 1.0)
    rows = [lag == 0, *(np.exp(-lag / tau) for tau in times)]
    return np.array([*rows, np.ones(longest)] if shared else rows, float)


def _bins(longest: int) -> Array:
    most = max(longest // LONGEST, 1)
    edges = [0, 1, 2]
    while edges[-1] < most:
        edges.append(min(int(np.ceil(edges[-1] * 1.4)), most))
    return np.unique(np.minimum(edges, longest))


def _binned(values: Array, edges: Array) -> Array:
    """Sums of values (..., lags) over lags from each of the ``edges`` to the next."""
    padded = np.zeros((*values.shape[:-1], int(edges[-1])))
    some = min(values.shape[-1], int(edges[-1]))
    padded[..., :some] = values[..., :some]
    return np.add.reduceat(padded, edges[:-1], axis=-1)


def _spectrum(values: Array) -> Array:
    return fft.rfft(values, fft.next_fast_len(2 * len(values), True), axis=0)


def _products(r: Array) -> Array:
    """Sums of r_k r_k+l by component and lag, (T, n) -> (n, T)."""
    F = _spectrum(r)
    return fft.irfft(np.abs(F) ** 2, fft.next_fast_len(2 * len(r), True), axis=0)[: len(r)].T


def _times(kernels: Array, Q: Array, own: bool) -> Array:
    """Toeplitz matrices of kernels times Q: (J, T) and (T, n, d) -> (J, T, n, d); ``own``: kernel i, component i."""
    T = len(Q)
    size = fft.next_fast_len(2 * T, True)
    F = fft.rfft(Q, size, axis=0)
    around = np.zeros((len(kernels), size))
    around[:, :T] = kernels[:, :T]
    around[:, size - T + 1 :] = kernels[:, T - 1 : 0 : -1]
    K = fft.rfft(around, axis=1).real
    if own:
        return fft.irfft(F * K.T[:, :, None], size, axis=0)[:T]
    return np.stack([fft.irfft(F * k[:, None, None], size, axis=0)[:T] for k in K])


def _expected(Q: Array, kernels: Array, edges: Array) -> Array:
    """Expected lagged products of one run for unit kernels: (n, bins, n, J)."""
    T, n, d = Q.shape
    J = len(kernels)
    size = fft.next_fast_len(2 * T, True)
    F = fft.rfft(Q, size, axis=0)
    B = _times(kernels, Q, False)
    out = np.zeros((n, len(edges) - 1, n, J))
    X = fft.irfft(F.conj()[:, :, :, None] * F[:, :, None, :], size, axis=0)[:T]  # (T, n, d, d)
    X = np.moveaxis(X, 0, -1)
    X = _binned(X, edges)  # (n, d, d, bins)
    X = 0.5 * (X + np.swapaxes(X, 1, 2))
    plain = _binned(np.maximum(T - np.arange(T), 0) * kernels[:, :T], edges)  # (J, bins)
    for j in range(J):
        H = fft.rfft(B[j], size, axis=0)
        cross = fft.irfft((F.conj() * H + H.conj() * F).sum(axis=2), size, axis=0)[:T].T  # (n, T)
        cross = _binned(cross, edges)
        G = np.einsum("kbp,kbq->bpq", Q, B[j])
        out[:, :, :, j] += np.einsum("apqm,bpq->amb", X, G)
        for a in range(n):
            out[a, :, a, j] += plain[j] - cross[a]
    return out


def _of_shared(bases: Sequence[Array], kernels: Array, edges: Array) -> Array:
    """Further expected products where the parameters are shared: what other runs add to G."""
    parts = []
    for Q in bases:
        B = _times(kernels, Q, False)
        parts.append(np.einsum("kbp,jkbq->jbpq", Q, B))
    total = np.sum(parts, axis=0)
    out = []
    for Q, own in zip(bases, parts, strict=True):
        F = _spectrum(Q)
        size = fft.next_fast_len(2 * len(Q), True)
        X = fft.irfft(F.conj()[:, :, :, None] * F[:, :, None, :], size, axis=0)[: len(Q)]
        X = _binned(np.moveaxis(X, 0, -1), edges)
        out.append(np.einsum("apqm,jbpq->ambj", 0.5 * (X + np.swapaxes(X, 1, 2)), total - own))
    return np.array(out)


def _left(bases: Sequence[Array], kernel: Array, shared: bool) -> list[Array]:
    n = bases[0].shape[1]
    B = [_times(kernel, Q, True) for Q in bases]
    G = [np.einsum("kbp,kbq->pq", Q, b) for Q, b in zip(bases, B, strict=True)]
    if shared:
        G = [np.sum(G, axis=0)] * len(G)
    out = []
    for Q, b, g in zip(bases, B, G, strict=True):
        cross = np.einsum("kap,kbp->kab", Q, b)
        out.append(np.eye(n) - cross - np.swapaxes(cross, 1, 2) + np.einsum("kap,pq,kbq->kab", Q, g, Q))
    return out
