"""What a filter declares of itself: name, error, gain, truth; and what it is told before step 1."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from consistency.bench.protocols import Filter, Problem, TrialTruth, WholeTrial
from consistency.bench.scenario import Belief
from consistency.bench.types import Trial
from consistency.referee.errors import InputError
from consistency.referee.geometry import ADDITIVE, PLANAR

FILTER = 2  # purpose in the spawn key of the seed; 0 and 1 are those of the simulation


def name_of(filter_: Filter) -> str:
    """``name`` of a filter, or its class's."""
    return str(getattr(filter_, "name", type(filter_).__name__))


def error_of(filter_: Filter) -> str:
    """Convention of the filter's own error, "so2" where it declares none.

    Raises
    ------
    InputError
        No such convention, or nothing that gives the covariance of that error.
    """
    error = getattr(filter_, "error", ADDITIVE)
    if not isinstance(error, str) or error not in PLANAR:
        raise InputError(f"filter '{name_of(filter_)}': its error must be one of {', '.join(PLANAR)}, got {error!r}")
    if error != ADDITIVE and not isinstance(filter_, WholeTrial) and not hasattr(filter_, "own_covariance"):
        raise InputError(f"filter '{name_of(filter_)}': with the error '{error}' it needs own_covariance(state)")
    return error


def own_errors(filters: Sequence[Filter]) -> dict[str, str]:
    """Convention of each filter's own error, of those where it is not the additive one."""
    errors = {name_of(f): error_of(f) for f in filters}
    return {name: error for name, error in errors.items() if error != ADDITIVE}


def optimal_gain(filter_: Filter) -> bool:
    """Does the filter declare that its gain is optimal, so that its innovations may be judged?"""
    declared = getattr(filter_, "innovations", None)
    return isinstance(declared, str) and declared == "optimal"


def rejects(filter_: Filter) -> bool:
    """Does the filter say which observations it left out?"""
    return callable(getattr(filter_, "rejected", None))


def is_realisable(filter_: Any) -> bool:
    """False for a filter that declares itself a bound, to be told the truth."""
    return getattr(filter_, "realisable", True) is not False


def random_numbers(trial: Trial, name: str) -> np.random.Generator:
    """Random stream of the filter ``name`` in one run: independent of the noise of the trial and of other filters."""
    return np.random.default_rng(np.random.SeedSequence(trial.seed, spawn_key=(trial.run, FILTER, *name.encode())))


def problem_of(trial: Trial, belief: Belief) -> Problem:
    """What a filter is told before step 1 of ``trial``."""
    return Problem(belief, trial.start, trial.landmarks if belief.sensor.model == "linear" else None)


def problem_for(filter_: Any, trial: Trial, belief: Belief) -> Problem:
    """What this filter is told before step 1 of ``trial``: the truth too, if it is not realisable without.

    Raises
    ------
    InputError
        It needs the truth, and the trial has none, or has observations of what is not a landmark.
    """
    problem = problem_of(trial, belief)
    if is_realisable(filter_):
        return problem
    name = getattr(filter_, "name", type(filter_).__name__)
    needs = f"filter '{name}' is a bound that takes its Jacobians at the truth"
    if trial.truth is None or trial.landmarks is None:
        missing = "truth.parquet" if trial.truth is None else "landmarks.parquet"
        raise InputError(f"{needs}: run {trial.run} has none; a log needs {missing}, or leave the filter out")
    if len(trial.landmark) and trial.landmark.max() >= len(trial.landmarks):
        raise InputError(
            f"{needs}: run {trial.run} has observations of things that are not landmarks; leave the filter out"
        )
    return replace(problem, truth=TrialTruth(trial.truth, trial.landmarks))
