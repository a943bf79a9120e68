"""What a filter declares of itself: name, error, sensors; whether that fits a belief; what it is told before step 1."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from consistency.bench.filters import filter_names, get_filter, usable_names
from consistency.bench.protocols import Filter, Problem, TrialTruth, WholeTrial
from consistency.bench.scenario import Belief
from consistency.bench.scenario.tables.toml_tables import UNITS
from consistency.bench.types import Trial
from consistency.referee.errors import InputError
from consistency.referee.geometry.conventions import ADDITIVE, PLANAR
from consistency.referee.parsing import require_name


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


def resolve_filters(filters: Sequence[str | Filter], belief: Belief, log: str | None = None) -> list[Filter]:
    """Filters by name or as they are, checked against the sensor, of the log in a folder or of a scenario."""
    instances = [get_filter(f) if isinstance(f, str) else f for f in filters]
    if not instances:
        raise InputError(f"no filter given; known: {', '.join(filter_names())}")
    for filter_ in instances:
        if isinstance(filter_, type) or not isinstance(filter_, Filter):
            hint = (
                "give an object of it, with ()" if isinstance(filter_, type) else "it needs init, predict, update, pose"
            )
            raise InputError(f"{filter_!r} is not a filter: {hint}")
    names = [name_of(f) for f in instances]
    if len(set(names)) < len(names):
        raise InputError(f"a filter is given twice: {', '.join(sorted({n for n in names if names.count(n) > 1}))}")
    built_in = filter_names()
    for given, name in zip(filters, names, strict=True):
        is_ours = isinstance(given, str) or type(given).__module__.startswith("consistency.")
        if name in built_in and not is_ours:
            raise InputError(f"filter '{name}': is a built-in filter; give yours another name")
    model = belief.sensor.model
    for filter_ in instances:
        require_name(name_of(filter_), "filter")
        error_of(filter_)
        sensors = getattr(filter_, "sensors", None)
        if sensors is not None and model not in sensors:
            fitting = [name for name in usable_names() if model in getattr(get_filter(name), "sensors", (model,))]
            raise InputError(
                f"filter '{name_of(filter_)}' works on a sensor {' or '.join(sensors)}, not '{model}'; "
                f"filters that fit: {', '.join(fitting)}"
            )
        for key in getattr(filter_, "needs", ()):
            if getattr(belief.sensor, key) is None:
                unit = f"{key}{UNITS.get(key, '')}"
                place = f"key 'belief.sensor.{unit}'" if log is None else f"{log}/sensor.toml: key '{unit}'"
                raise InputError(f"{place}: missing; filter '{name_of(filter_)}' needs it, so add it or leave it out")
    return instances


def is_realisable(filter_: Any) -> bool:
    """False for a filter that declares itself a bound, to be told the truth."""
    return getattr(filter_, "realisable", True) is not False


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
