"""Likelihood of errors under one reading of the covariance, and under simple faults of a filter instead of a mix-up."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from consistency.referee.diagnostics.records.validity import Validity, classify
from consistency.referee.diagnostics.statistics import distributions
from consistency.referee.readers.poses import Poses
from consistency.referee.types import Array

FACTOR = 6.0  # by which a wrong filter's covariance is off without a mix-up: the table of benchmarks/hints.py has 4
ODD = 1e-3  # chance that errors with the stated covariance are not taken for such
GROUPS = {3: ([0, 1],), 6: ([0, 1, 2], [3, 4, 5])}  # position and attitude, of poses


@dataclass(frozen=True)
class ReadingFit:
    """Errors of K estimates in n components under one reading; those that cannot be whitened are left out."""

    whitened: Sequence[Array]  # of each run, (k, n)
    root: Array  # (K, n, n), L^-1 of P = L L'
    error: Array  # (K, n)
    own: Array  # (K, n), errors over their standard deviations
    log_det: float  # of P, the mean

    @property
    def n(self) -> int:
        return int(self.error.shape[1])

    @cached_property
    def w(self) -> Array:
        """(K, n)."""
        return np.concatenate(self.whitened)

    @cached_property
    def likelihood(self) -> float:
        """Mean log likelihood of an estimate, but for a constant."""
        return -0.5 * (float(np.square(self.w).sum(axis=1).mean()) + self.log_det)

    @cached_property
    def size(self) -> float:
        """Effective number of independent estimates, for the scale.

        Squares of Gaussian errors with the autocorrelation rho have that of rho^2, so that K of them say as much as
        K / (1 + 2 sum (1 - l / k) rho_l^2) independent ones; the mean is 0 by assumption, and an error that is constant
        over a run counts once. Chance in the rho of a single run leaves down to a third of that. It is no more than the
        spread of the NEES over estimates, and over 8 or more runs, allows.
        """
        K, n = self.w.shape
        size = K / max(_memory(self.whitened, j) for j in range(n))
        nees = np.square(self.w).sum(axis=1) / n
        size *= min(1.0, 2.0 * float(nees.mean()) ** 2 / (n * max(float(nees.var()), 1e-300)))
        means = np.array([np.square(w).mean() for w in self.whitened])
        if len(means) >= 8 and means.std() > 0:
            size = min(size, 2.0 * float(means.mean()) ** 2 * len(means) / (n * float(means.var(ddof=1))))
        return max(float(size), 1.0)

    def right(self) -> bool:
        n, size = self.n, self.size
        ratios = np.append(np.square(self.own).mean(axis=0), np.square(self.w).mean())
        pairs = np.triu_indices(n, 1)
        asked = n + 1 + n + len(pairs[0]) + 1
        scale = np.append(np.full(n, size), n * size) * (ratios - np.log(np.maximum(ratios, 1e-300)) - 1.0)
        products = (self.w.T @ self.w / len(self.w))[pairs]
        below = float((np.square(self.w).sum(axis=1) < distributions.chi2.ppf(0.5, n)).mean())
        normal = np.concatenate([self.w.mean(axis=0), products, [2.0 * below - 1.0]]) * np.sqrt(size)
        limit = distributions.chi2.isf(ODD / asked, 1)
        return bool((scale <= limit).all() and (np.square(normal) <= limit).all())

    def fault(self) -> float:
        """Log likelihood of an estimate that another covariance, the same for all whitened errors, would gain."""
        M = self.w.T @ self.w / len(self.w)
        sign, log_det = np.linalg.slogdet(M)
        return 0.5 * float(np.trace(M) - (log_det if sign > 0 else -np.inf) - self.n)

    def simple(self) -> float:
        """Log likelihood of an estimate with the simple fault that explains the errors best.

        That is a bias, or a factor of at most ``FACTOR`` on the covariance of all components, of one, of position or of
        attitude.
        """
        n, w = self.n, self.w
        before = float(np.square(w).sum(axis=1).mean())
        shift = self.root @ self.error.mean(axis=0)
        best = 0.5 * float((2.0 * w * shift - shift**2).sum(axis=1).mean())
        f = np.exp(np.linspace(-np.log(FACTOR), np.log(FACTOR), 61))
        for group in [list(range(n)), *([j] for j in range(n)), *GROUPS.get(n, ())]:
            part = (self.root[:, :, group] @ self.error[:, group, None])[..., 0]
            a = f**-0.5 - 1.0
            after = before + 2.0 * a * float((w * part).sum(axis=1).mean()) + a**2 * float((part**2).sum(axis=1).mean())
            best = max(best, float((0.5 * (before - after - len(group) * np.log(f))).max()))
        return self.likelihood + best


def fit_of(runs: Sequence[Poses], errors: Array | None = None) -> ReadingFit | None:
    """Errors of some runs; None without any that can be whitened.

    ``errors`` (K, n) are those of all estimates, where they are known.
    """
    errors = np.concatenate([p.errors() for p in runs]) if errors is None else errors
    P = np.concatenate([p.covariance for p in runs])
    ends = np.cumsum([len(p.t) for p in runs])[:-1]
    with np.errstate(invalid="ignore"):
        variance = np.diagonal(P, axis1=1, axis2=2)
        good = np.isfinite(errors).all(axis=1) & np.isfinite(P).all(axis=(1, 2)) & (variance > 0).all(axis=1)
    if not good.any():
        return None
    sigma = np.sqrt(variance[good])
    R = P[good] / sigma[:, :, None] / sigma[:, None, :]
    try:
        L = np.linalg.cholesky(R)
    except np.linalg.LinAlgError:
        definite = classify(R) == Validity.VALID
        if not definite.any():
            return None
        good[good], sigma = definite, sigma[definite]
        L = np.linalg.cholesky(R[definite])
    error, root = errors[good], np.linalg.inv(L) / sigma[:, None, :]
    w = np.full(errors.shape, np.nan)
    w[good] = (root @ error[..., None])[..., 0]
    whitened = [part[np.isfinite(part).all(axis=1)] for part in np.split(w, ends)]
    log_det = 2.0 * (np.log(np.diagonal(L, axis1=1, axis2=2)).sum(axis=1) + np.log(sigma).sum(axis=1))
    return ReadingFit([part for part in whitened if len(part)], root, error, error / sigma, float(log_det.mean()))


def _memory(runs: Sequence[Array], axis: int) -> float:
    """1 + 2 sum over lags l of (1 - l / k) rho_l^2 of one component, over all runs; k is the longest of them."""
    k = max(map(len, runs))
    total, pairs = np.zeros(k), np.zeros(k)
    for run in runs:
        x, own = run[:, axis], len(run)
        transform = np.fft.rfft(x, 2 * own)
        total[:own] += np.fft.irfft(transform * transform.conj(), 2 * own)[:own]
        pairs[:own] += own - np.arange(own)
    if not total[0] > 0:
        return float(k)
    rho = total / np.maximum(pairs, 1) * (pairs[0] / total[0])
    square = rho**2 - 1.0 / np.maximum(pairs, 1)  # less what chance makes
    return max(1.0, float(1.0 + 2.0 * ((1.0 - np.arange(1, k) / k) * square[1:]).sum()))
