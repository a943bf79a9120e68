"""Pilot runs, which tell how steps depend on each other; a number of runs is planned from them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from consistency.bench.runs.montecarlo import run_trials
from consistency.bench.runs.results_to_records import records_of_results
from consistency.bench.runs.scores_by_run import mean_nees_of_runs
from consistency.bench.scenario import load_scenario
from consistency.bench.store.results import Tables, open_results
from consistency.referee.column_names import POSE
from consistency.referee.diagnostics.questions.scale import FEW
from consistency.referee.diagnostics.records.record import Record
from consistency.referee.errors import InputError
from consistency.referee.types import Array


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
