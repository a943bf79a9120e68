"""What the filters of the bench are told: the problem before step 1, their random numbers, and their observations.

Noise and bias of observations are those that a belief has: every filter of the bench is told of its data here.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from consistency.bench.protocols import Problem, TrialTruth, is_realisable, name_of
from consistency.bench.scenario import Belief, BelievedSensor, models
from consistency.bench.types import Trial
from consistency.referee.errors import InputError
from consistency.referee.types import Array

FILTER = 2  # purpose in the spawn key of the seed; 0 and 1 are those of the simulation


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
    needs = f"filter '{name_of(filter_)}' is a bound that takes its Jacobians at the truth"
    if trial.truth is None or trial.landmarks is None:
        missing = "truth.parquet" if trial.truth is None else "landmarks.parquet"
        raise InputError(f"{needs}: run {trial.run} has none; a log needs {missing}, or leave the filter out")
    if len(trial.landmark) and trial.landmark.max() >= len(trial.landmarks):
        raise InputError(
            f"{needs}: run {trial.run} has observations of things that are not landmarks; leave the filter out"
        )
    return replace(problem, truth=TrialTruth(trial.truth, trial.landmarks))


def random_numbers(trial: Trial, name: str) -> np.random.Generator:
    """Random stream of the filter ``name`` in one run: independent of the noise of the trial and of other filters."""
    return np.random.default_rng(np.random.SeedSequence(trial.seed, spawn_key=(trial.run, FILTER, *name.encode())))


def sensor_noise(z: Array, sensor: BelievedSensor, converted: bool) -> tuple[Array, Array]:
    """Observations (M, s) less their believed biases, and their noise (M, s, s); as points by eq. 21 if ``converted``.

    The noise of a point is J diag(sigma^2) J' with J the Jacobian of eq. 21 at the measurement. All that the bench's
    own filters are told of an observation comes from here, or from the functions below.
    """
    z = z - bias_at(z, sensor)
    variance = variance_at(z, sensor)
    if not converted:
        return z, np.broadcast_to(variance, (len(z), *variance.shape[-2:])).copy()
    points = models.triangulate(z[:, 0], z[:, 1], z[:, 2], sensor.f or 0.0, sensor.B or 0.0)
    return np.column_stack(points), point_noise(z, variance, sensor)


def bias_at(z: Array, sensor: BelievedSensor) -> Array:
    """What the belief takes to be the biases of observations z (M, s) as they were measured, (M, s)."""
    return np.zeros_like(z) if sensor.bias is None else sensor.bias.at(z[:, 0], z[:, 1])


def variance_at(z: Array, sensor: BelievedSensor) -> Array:
    """Noise of observations z (M, s): (s, s) if it is the same everywhere, else (M, s, s)."""
    if sensor.disparity_growth is None:
        return np.diag(np.square(sensor.sigma))
    sigma = np.tile(sensor.sigma, (len(z), 1))
    sigma[:, 2] = disparity_sigma(z[:, 2], sensor)
    return np.asarray(np.square(sigma)[:, None] * np.eye(3))


def disparity_sigma(d: Array, sensor: BelievedSensor) -> Array | float:
    """Standard deviation of disparities d (M,), px: a number if it is the same everywhere, else (M,)."""
    growth = sensor.disparity_growth
    return sensor.sigma[2] if growth is None else sensor.sigma[2] * growth.ratio_at(d)


def point_noise(z: Array, variance: Array, sensor: BelievedSensor) -> Array:
    """Noise (M, 3, 3) of the points of eq. 21 at pixels z (M, 3) that have a ``variance`` (3, 3) or (M, 3, 3), m^2."""
    entries = models.triangulate_jacobian(z[:, 0], z[:, 1], z[:, 2], sensor.f or 0.0, sensor.B or 0.0)
    J = np.stack(np.broadcast_arrays(*entries), axis=-1).reshape(-1, 3, 3)
    return np.asarray(J @ variance @ np.swapaxes(J, 1, 2))
