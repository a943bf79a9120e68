"""Scores of each run: mean NEES, RMSE, wins of one filter over another, and pilot runs by which more are planned."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy import stats

from consistency.bench.runs.montecarlo import run_trials
from consistency.bench.runs.results_to_records import records_of_results
from consistency.bench.scenario import load_scenario
from consistency.bench.store.results import Tables, open_results
from consistency.referee.column_names import POSE
from consistency.referee.diagnostics.questions import scale
from consistency.referee.diagnostics.questions.scale import FEW
from consistency.referee.diagnostics.records.large_arrays import by_steps
from consistency.referee.diagnostics.records.record import Record
from consistency.referee.errors import InputError
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


def pilots_in(folder: Path, filters: Sequence[str] | None = None) -> dict[str, tuple[Array, int]]:
    """Pilots in a folder of results; see :func:`pilots_of`."""
    return pilots_of(open_results(folder), filters)


def pilots_in_world(scenario: str, filters: Sequence[str], runs: int, seed: int) -> dict[str, tuple[Array, int]]:
    """Pilots that are run for it, in a world by its name or path; see :func:`pilots_of`."""
    return pilots_of(run_trials(load_scenario(scenario), filters, runs, seed), filters)


def pilots_of(results: Tables, filters: Sequence[str] | None = None) -> dict[str, tuple[Array, int]]:
    """Pilots of :func:`consistency.referee.verdicts.planned_runs.plan`, of every filter or of those named."""
    return {of.name: (_pilot_means(of), of.t.size) for of in records_of_results(results, filters)}


def _pilot_means(of: Record) -> Array:
    """Mean NEES over dof of the runs that did not fail, (runs,)."""
    if of.nees is None:
        raise InputError(f"{of.name}: has no truth; only runs with a NEES tell how their steps depend on each other")
    mean_nees = mean_nees_of_runs(of)
    mean_nees = mean_nees[np.isfinite(mean_nees)] / len(POSE)
    if len(mean_nees) < FEW:
        raise InputError(f"{of.name}: a pilot needs at least {FEW} runs that did not fail, got {len(mean_nees)}")
    return np.asarray(mean_nees)
