"""Test of bias: Hotelling's T-squared, which is not affected by a wrong scale."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import special

from consistency.referee.defaults import CONFIDENCE
from consistency.referee.diagnostics.records.large_arrays import block_slices
from consistency.referee.diagnostics.records.whitening import all_finite
from consistency.referee.diagnostics.statistics import distributions
from consistency.referee.types import Array, Indices


@dataclass(frozen=True)
class Hotelling:
    """Test that a sample of vectors has mean zero, Hotelling (1931)."""

    mean: Array  # (n,)
    interval: Array  # (n, 2), simultaneous, Bonferroni over the components
    statistic: float  # T-squared
    p_value: float


def hotelling(sample: Array, confidence: float = CONFIDENCE) -> Hotelling:
    """T-squared test of a sample (N, n), exact for independent Gaussian rows, N > n.

    Raises
    ------
    ValueError
        Too few rows, or a value that is not finite.
    """
    x = np.asarray(sample, float)
    if x.ndim != 2 or len(x) <= x.shape[1] or not np.isfinite(x).all():
        raise ValueError(f"needs more finite rows than columns, got shape {x.shape}")
    (statistic,), (p_value,) = t_squared(x[:, None, :])
    N, n = x.shape
    half = distributions.t.isf(0.5 * (1.0 - confidence) / n, N - 1) * x.std(axis=0, ddof=1) / np.sqrt(N)
    mean = x.mean(axis=0)
    return Hotelling(mean, np.stack([mean - half, mean + half], axis=-1), float(statistic), float(p_value))


def t_squared(whitened: Array, known: StepMoments | None = None) -> tuple[Array, Array]:
    """T-squared and p value of each step, (runs, steps, n) -> (steps,), (steps,).

    T^2 (N - n) / (n (N - 1)) is F(n, N - n) distributed (Anderson 2003, Theorem 5.2.2). NaN where fewer
    than n + 1 runs are left. ``known`` are the moments, if already computed.
    """
    if known is None:
        known = step_moments(whitened)
    N, mean, S = known
    n = whitened.shape[-1]
    statistic = np.full(len(N), np.nan)
    p_value = np.full(len(N), np.nan)
    good = n + 1 <= N
    with np.errstate(all="ignore"):
        good &= np.linalg.det(np.where(good[:, None, None], S, np.eye(n))) > 0
    if good.any():
        m = mean[good]
        scatter = S[good]
        t2 = N[good] * np.einsum("ki,ki->k", m, np.linalg.solve(scatter, m[..., None])[..., 0])
        statistic[good] = t2
        p_value[good] = special.fdtrc(n, N[good] - n, t2 * (N[good] - n) / (n * (N[good] - 1)))
    return statistic, p_value


class StepMoments(NamedTuple):
    """Runs, mean and sample covariance of every step."""

    runs: Indices  # (steps,)
    mean: Array  # (steps, n)
    covariance: Array  # (steps, n, n)


def step_moments(whitened: Array) -> StepMoments:
    """Moments of whitened errors (runs, steps, n)."""
    runs, steps = whitened.shape[:2]
    N, mean, S = zip(*(_moments(whitened[:, here]) for here in block_slices(steps, runs)), strict=True)
    return StepMoments(np.concatenate(N), np.concatenate(mean), np.concatenate(S))


def _moments(whitened: Array) -> tuple[Array, Array, Array]:
    present = all_finite(whitened)
    N = present.sum(axis=0)
    w = np.where(present[..., None], whitened, 0.0)
    mean = w.sum(axis=0) / np.maximum(N, 1)[:, None]
    w = np.where(present[..., None], w - mean, 0.0)
    by_step = np.ascontiguousarray(np.moveaxis(w, 1, 0))  # (steps, runs, n)
    S = np.swapaxes(by_step, -1, -2) @ by_step / np.maximum(N - 1, 1)[:, None, None]
    return N, mean, S
