"""Errors whose stated covariance is the identity, drawn in worlds that differ in how steps depend on each other."""

from __future__ import annotations

from typing import Any

import numpy as np

from consistency.referee.diagnostics import Evidence, Settings, Verdict, judge
from consistency.referee.types import Array


def independent(rng: np.random.Generator, runs: int, steps: int, n: int) -> Array:
    return rng.standard_normal((runs, steps, n))


def autoregression(rng: np.random.Generator, runs: int, steps: int, n: int, coefficient: float = 0.95) -> Array:
    white = rng.standard_normal((runs, steps, n))
    error = white.copy()
    for k in range(1, steps):
        error[:, k] = coefficient * error[:, k - 1] + np.sqrt(1.0 - coefficient**2) * white[:, k]
    return error


def fully_dependent(rng: np.random.Generator, runs: int, steps: int, n: int) -> Array:
    """One error in all steps of a run: the worst case."""
    return np.repeat(rng.standard_normal((runs, 1, n)), steps, axis=1)


def slow_axis(rng: np.random.Generator, runs: int, steps: int, n: int) -> Array:
    """The first component is one error in all steps of a run, the others are independent."""
    error = rng.standard_normal((runs, steps, n))
    error[..., 0] = rng.standard_normal((runs, 1))
    return error


def identities(error: Array) -> Array:
    n = error.shape[-1]
    return np.broadcast_to(np.eye(n), (*error.shape, n))


def verdict_on(error: Array, covariance: Array | None = None, **settings: Any) -> Verdict:
    """The verdict on errors with covariance I, or the one given."""
    return judge(Evidence("f", error, identities(error) if covariance is None else covariance), Settings(**settings))
