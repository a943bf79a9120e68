"""Any filter through a trial, step by step: the path that filters of the user's own take."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from consistency.filters.compiled import problem_of
from consistency.filters.kernel.linalg import definiteness
from consistency.protocols import Filter, WholeTrial
from consistency.scenario import Belief
from consistency.types import Array, Estimates, Failure, Trial

SYMMETRY = 1e-8  # relative to the largest entry, as nees() demands


def optimal_gain(filter_: Filter) -> bool:
    """Does the filter declare that its gain is optimal, so that its innovations may be judged?"""
    declared = getattr(filter_, "innovations", None)
    return isinstance(declared, str) and declared == "optimal"


def name_of(filter_: Filter) -> str:
    """``name`` of a filter, or its class's."""
    return str(getattr(filter_, "name", type(filter_).__name__))


def run_filter(filter_: Filter, trial: Trial, belief: Belief, timeout: float | None = None) -> Estimates:
    """A whole trial through a filter, compiled where it can be.

    An exception, a time-out (``timeout`` seconds a trial), an estimate that is not finite or a pose
    covariance that is not positive definite ends the run as a :class:`Failure` of that step.
    """
    if isinstance(filter_, WholeTrial):
        return filter_.run(trial, belief)
    return step_through(filter_, trial, belief, timeout)


def step_through(filter_: Filter, trial: Trial, belief: Belief, timeout: float | None = None) -> Estimates:
    """A whole trial through a filter by its ``init``, ``predict``, ``update`` and ``pose``."""
    T = trial.steps
    pose, covariance = np.full((T, 3), np.nan), np.full((T, 3, 3), np.nan)
    nis, dof = np.full(T, np.nan), np.zeros(T, np.int64)
    reason, step, full_rank = "", 0, False
    started = time.monotonic()
    state: Any = None
    for step in range(1, T + 1):
        try:
            if step == 1:
                state = filter_.init(problem_of(trial, belief))
            state = filter_.predict(state, trial.control(step))
            updated = filter_.update(state, trial.observation(step))
            if not isinstance(updated, tuple) or len(updated) != 2:
                raise TypeError("update must return (state, info)")
            state, info = updated
            estimate = filter_.pose(state)
            mean, P = _shaped(estimate.mean, (3,)), _shaped(estimate.covariance, (3, 3))
            if info is not None and len(info.innovation):
                np.linalg.cholesky(info.S)
                nis[step - 1], dof[step - 1] = info.nis, len(info.innovation)
        except np.linalg.LinAlgError:
            reason = "the innovation covariance is not positive definite"
            break
        except Exception as error:  # whatever a user's filter throws is a result
            reason = f"{type(error).__name__}: {error}".encode(errors="backslashreplace").decode()
            break
        rank = definiteness(P)
        if not (np.isfinite(mean).all() and np.isfinite(P).all()):
            reason = "the estimate is not finite"
        elif np.abs(P - P.T).max() > SYMMETRY * np.abs(P).max():
            reason = "the pose covariance is not symmetric"
        elif rank < 0 or (full_rank and rank == 0):
            reason = "the pose covariance is not positive definite"
        elif timeout is not None and time.monotonic() - started > timeout:
            reason = f"time-out after {timeout:g} s"
        if reason:
            break
        full_rank = full_rank or rank == 1
        pose[step - 1], covariance[step - 1] = mean, P
    if reason:
        nis[step - 1], dof[step - 1] = np.nan, 0
    failure = Failure(name_of(filter_), trial.run, step, reason) if reason else None
    return Estimates(name_of(filter_), trial.run, pose, covariance, nis, dof, failure)


def _shaped(value: Any, shape: tuple[int, ...]) -> Array:
    array = np.array(value, dtype=float)
    if array.shape != shape:
        raise ValueError(f"pose() gave an array of shape {array.shape}, not {shape}")
    return array
