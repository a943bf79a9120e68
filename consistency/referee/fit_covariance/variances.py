"""Variances of independent terms from the errors of windows, by maximum likelihood, and how well they are known."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import optimize, stats

from consistency.referee.defaults import CONFIDENCE
from consistency.referee.diagnostics.verdict.parts import Interval
from consistency.referee.fit_covariance.systematic_errors import carriers
from consistency.referee.fit_covariance.windows import turns, ways
from consistency.referee.types import Array, Indices

STEPS, CLOSE = 100, 1e-7  # of scoring; gain of the log likelihood of a window at which it ends
BLOCKS = 20  # of windows, where drives are too few for the jackknife
ENOUGH = 5  # drives for which they are the blocks


def terms_of(pieces: Array) -> Array:
    """F (W, 2 n, n, n): the covariance of a window's error for a variance of 1 a m, then a rad, in each axis.

    The noise of a piece stands half at each of its ends (trapezoidal rule), and is carried to the end of the window.
    """
    A = carriers(pieces)
    sizes = np.stack([ways(pieces), np.linalg.norm(turns(pieces), axis=-1)], axis=1)  # (W, 2, P)
    share = np.zeros((*sizes.shape[:2], sizes.shape[2] + 1))
    share[..., :-1] += 0.5 * sizes
    share[..., 1:] += 0.5 * sizes
    F = np.einsum("wsk,wkia,wkja->wsaij", share, A, A, optimize=True)
    return np.asarray(F.reshape(len(F), -1, *F.shape[-2:]))


def fit_terms(error: Array, F: Array, floor: Array, start: Array | None = None) -> Array:
    """Variances theta >= 0 (p,) with Cov e_w = diag(floor) + sum theta_p F_wp, by maximum likelihood.

    Scoring for covariances that are linear in their parameters (Anderson 1973, "Asymptotically efficient estimation of
    covariance matrices with linear structure", Ann. Statist. 1): each step is a least squares fit of e e', weighted by
    the inverse of the present covariance, with theta >= 0 (Lawson & Hanson 1974), halved until the likelihood grows.
    Windows are taken as independent: where they are not, it is a composite likelihood (Varin, Reid & Firth 2011).

    Parameters
    ----------
    error : (W, n)
    F : (W, p, n, n)
    floor : (n,), variances that are there in any case
    """
    base = np.diag(floor)
    theta = _start(error, F) if start is None else np.maximum(start, 1e-12 * start.max())
    value = _likelihood(error, base + np.tensordot(theta, F, (0, 1)))
    for _ in range(STEPS):
        C = base + np.tensordot(theta, F, (0, 1))
        inverse = np.linalg.inv(C)
        G = inverse[:, None] @ F  # (W, p, n, n)
        flat = G.reshape(*G.shape[:2], -1)
        turned = np.swapaxes(G, -1, -2).reshape(flat.shape)
        H = np.tensordot(flat, turned, ((0, 2), (0, 2)))
        u = inverse @ error[..., None]
        g = np.einsum("wi,wpij,wj->p", u[..., 0], F, u[..., 0], optimize=True)
        g = g - np.einsum("wpij,wji->p", G, inverse * floor[:, None], optimize=True)
        target, step = _nonnegative(H, g), 1.0
        while True:
            trial = theta + step * (target - theta)
            better = _likelihood(error, base + np.tensordot(trial, F, (0, 1)))
            if better >= value or step < 1e-3:
                break
            step *= 0.5
        gain = better - value
        if gain > 0:
            theta, value = trial, better
        if gain < CLOSE * len(error):
            break
    return np.asarray(theta)


def _start(error: Array, F: Array) -> Array:
    """The mean square of each axis, divided evenly among its terms."""
    n = error.shape[1]
    own = np.stack([np.diagonal(F, axis1=2, axis2=3)[:, p, p % n].mean() for p in range(F.shape[1])])
    return np.asarray((error**2).mean(axis=0)[np.arange(F.shape[1]) % n] / (2 * np.where(own > 0, own, np.inf)) + 1e-30)


def _likelihood(error: Array, C: Array) -> float:
    """Log density of the errors but for its constant; -inf where a covariance is not positive definite."""
    sign, logdet = np.linalg.slogdet(C)
    if not (sign > 0).all():
        return -np.inf
    return float(-0.5 * (logdet.sum() + nees_of(error, C).sum()))


def nees_of(error: Array, C: Array) -> Array:
    """e' C^-1 e, (W,)."""
    return np.asarray((error * np.linalg.solve(C, error[..., None])[..., 0]).sum(axis=1))


def _nonnegative(H: Array, g: Array) -> Array:
    """The minimum of x'Hx / 2 - g'x with x >= 0."""
    scale = np.sqrt(np.maximum(np.diag(H), 1e-300))
    scaled = H / np.outer(scale, scale)
    values, vectors = np.linalg.eigh(scaled)
    root = np.sqrt(np.maximum(values, 1e-9))
    return np.asarray(optimize.nnls(root[:, None] * vectors.T, (vectors.T @ (g / scale)) / root)[0] / scale)


def blocks_of(drive: Indices) -> list[Indices]:
    """Windows (W,) in blocks for the jackknife: drives where they are enough, otherwise consecutive windows."""
    names = np.unique(drive)
    if len(names) >= ENOUGH:
        return [np.flatnonzero(drive == name) for name in names]
    return [part for part in np.array_split(np.arange(len(drive)), min(BLOCKS, len(drive))) if len(part)]


def interval_of(value: float, left_out: Sequence[float]) -> Interval:
    """Interval of a variance from its values with each block left out, in cube roots (Wilson & Hilferty 1931)."""
    roots, k = np.cbrt(np.asarray(left_out)), len(left_out)
    error = float(np.sqrt((k - 1) / k * ((roots - roots.mean()) ** 2).sum()))
    reach = float(stats.t.isf(0.5 * (1.0 - CONFIDENCE), k - 1)) * error if k > 1 else np.inf
    if not error > 0:  # 0 with any block left out: its upper end is not known
        return Interval(value, 0.0, float("nan"))
    low, high = float(np.cbrt(value)) - reach, float(np.cbrt(value)) + reach
    return Interval(value, max(low, 0.0) ** 3, high**3)
