"""What records of results say run by run: mean NEES, RMSE, and wins of one filter over another."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import stats

from consistency.referee.diagnostics.questions import scale
from consistency.referee.diagnostics.records.large_arrays import by_steps
from consistency.referee.diagnostics.records.record import Record
from consistency.referee.types import Array


def log_rmse(of: Record, axes: Sequence[int]) -> Array:
    """log RMSE of some axes of the pose together in each run, in the world, shape (R,); NaN where it failed."""
    error = of.in_world.error
    assert error is not None
    value: Array = 0.5 * np.log(np.square(error[:, :, list(axes)]).sum(axis=2).mean(axis=1))
    return value


def mean_nees_of_runs(of: Record) -> Array:
    """Mean NEES of each run over its judged steps, in the filter's own error, shape (R,); infinite for a failed run."""
    assert of.nees is not None
    means, count = scale.run_means(of.nees)
    means[count == 0] = np.inf
    means[np.isin(of.run_numbers, [failure.run for failure in of.failures])] = np.inf
    return np.asarray(means)


def nis_ratio(of: Record, runs: int) -> Array:
    """NIS of the first ``runs`` runs over their degrees of freedom in each step, (T,)."""
    assert of.nis is not None
    assert of.nis_dof is not None
    return by_steps(_ratio, of.nis[:runs], of.nis_dof[:runs])


def _ratio(nis: Array, nis_dof: Array) -> Array:
    has_nis = np.isfinite(nis) & (nis_dof > 0)
    dof = np.where(has_nis, nis_dof, 0).sum(axis=0)
    total = np.where(has_nis, nis, 0.0).sum(axis=0)
    return np.asarray(np.where(dof > 0, total / np.maximum(dof, 1), np.nan))


def wins(a: Record, b: Record) -> tuple[int, float]:
    """Runs in which ``a`` has the lower mean NEES than ``b``, and the two-sided p value of a sign test without ties."""
    better, worse = (int((mean_nees_of_runs(x) < mean_nees_of_runs(y)).sum()) for x, y in ((a, b), (b, a)))
    return better, float(stats.binomtest(better, better + worse).pvalue) if better + worse else 1.0
