"""Test of the covariance in all directions, for estimators whose covariance may be too large."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from consistency.referee.diagnostics.questions.scale import UNKNOWN, ratio_interval, scale_test
from consistency.referee.diagnostics.questions.shape import second_moments
from consistency.referee.diagnostics.records.array_blocks import by_runs
from consistency.referee.diagnostics.records.whitening import all_finite
from consistency.referee.diagnostics.verdict.parts import Interval
from consistency.referee.types import Array


@dataclass(frozen=True)
class Largest:
    """The direction in which errors are largest against the stated covariance."""

    ratio: Interval  # of true to stated variance in directions that the judged runs had no part in choosing
    direction: Array  # (n,), unit vector of whitened errors, from all runs
    p_value: float


def largest_direction(whitened: Array) -> Largest:
    """Test that no direction has errors larger than stated: largest eigenvalue of the mean of w w' at most 1.

    A covariance is conservative if P >= E e e' in every direction (Forsling, Julier & Hendeby 2025), so that the
    largest eigenvalue of the whitened second moment is at most 1; the trace, which is the mean NEES, cannot tell.
    The leading eigenvector of one half of the runs (every other run) is the direction in which the other half is
    judged, and vice versa. Runs are independent, so the errors of each half are independent of its direction, and the
    test of a single component holds (:func:`scale_test`). Both halves count (Bonferroni).

    Parameters
    ----------
    whitened : (runs, steps, n), NaN where a run has no value. p is NaN with fewer than 2 runs or n = 1.
    """
    present = all_finite(whitened)
    n, some = whitened.shape[-1], present.any(axis=1)
    if some.sum() < 2 or n == 1:
        return Largest(UNKNOWN, np.full(n, np.nan), float("nan"))
    count = present.sum(axis=1)
    moments = by_runs(second_moments, whitened, present)[some] / count[some, None, None]
    steps = int(count.max())
    halves = [np.arange(len(moments)) % 2 == k for k in (0, 1)]
    along, p_values = np.empty(len(moments)), []
    for chosen, judged in (halves, halves[::-1]):
        u = _leading(moments[chosen])
        along[judged] = np.einsum("i,rij,j->r", u, moments[judged], u)
        p_values.append(scale_test(along[judged], 1, steps).above)
    return Largest(ratio_interval(along), _leading(moments), min(1.0, 2.0 * min(p_values)))


def _leading(moments: Array) -> Array:
    return np.asarray(np.linalg.eigh(moments.mean(axis=0))[1][:, -1])
