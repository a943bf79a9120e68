"""Heavy tails: errors that lie farther from the other runs than a Gaussian allows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from consistency.referee.diagnostics.questions.bias import StepMoments, step_moments
from consistency.referee.diagnostics.records.large_arrays import block_slices
from consistency.referee.diagnostics.records.whitening import squared_length
from consistency.referee.diagnostics.statistics import distributions
from consistency.referee.types import Array


@dataclass(frozen=True)
class Outlier:
    """The error that stands out most."""

    p_value: float  # over all runs and steps
    run: int  # row
    step: int  # column
    distance: float  # from the mean of the other runs in that step, in their standard deviations


def outliers(whitened: Array, known: StepMoments | None = None) -> Outlier:
    """Largest distance of any run in any step from the other runs, Wilks (1963).

    The squared Mahalanobis distance D^2 from the sample mean with the sample covariance has D^2 N / (N - 1)^2
    distributed as Beta(n / 2, (N - n - 1) / 2) for Gaussian errors of any mean and covariance; the
    smallest p value is multiplied by the number of runs and steps (Bonferroni). p is NaN where no step has
    n + 3 runs.

    Parameters
    ----------
    whitened : (runs, steps, n), NaN where a run has no value
    known : moments of ``whitened``, if already computed
    """
    if known is None:
        known = step_moments(whitened)
    N, mean, S = known
    n = whitened.shape[-1]
    usable = np.flatnonzero(n + 3 <= N)
    usable = usable[np.linalg.det(S[usable]) > 0]
    if not len(usable):
        return Outlier(float("nan"), -1, -1, float("nan"))
    precision = np.linalg.inv(S[usable])
    rows = np.empty(len(usable), np.int64)
    of_step = np.empty(len(usable))
    for here in block_slices(len(usable), len(whitened)):
        d2 = _distances(whitened[:, usable[here]] - mean[usable[here]], precision[here])
        rows[here] = d2.argmax(axis=0)
        of_step[here] = d2.max(axis=0)
    count = N[usable]
    with np.errstate(invalid="ignore"):
        p = distributions.beta.sf(np.minimum(of_step * count / (count - 1.0) ** 2, 1.0), n / 2, (count - n - 1) / 2)
    worst = int(p.argmin())
    p_value = min(1.0, float(p[worst]) * float(count.sum()))
    n_runs = float(count[worst])
    share = min(float(of_step[worst]) * n_runs / (n_runs - 1.0) ** 2, 1.0 - 1e-12)
    left_out = share / (1.0 - share) * n_runs * (n_runs - 2.0) / (n_runs - 1.0)  # without the run itself
    return Outlier(p_value, int(rows[worst]), int(usable[worst]), float(np.sqrt(left_out)))


def beyond_stated(whitened: Array) -> float:
    """Bonferroni's p value of the largest NEES of all runs and steps, (runs, steps, n), by the stated covariance.

    It is valid for a covariance that is too large as well: chi-square exceeds such a NEES in distribution.
    """
    nees = squared_length(whitened)
    count = int(np.isfinite(nees).sum())
    if not count:
        return float("nan")
    return min(1.0, count * float(distributions.chi2.sf(np.nanmax(nees), whitened.shape[-1])))


def _distances(gap: Array, precision: Array) -> Array:
    """gap' precision gap, (runs, steps, n) and (steps, n, n) -> (runs, steps); 0 where there is no value."""
    d2 = np.zeros(gap.shape[:2])
    for i in range(gap.shape[-1]):
        for j in range(gap.shape[-1]):
            d2 += gap[..., i] * precision[:, i, j] * gap[..., j]
    return np.where(np.isfinite(d2), np.maximum(d2, 0.0), 0.0)  # rounding may make it negative
