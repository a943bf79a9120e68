"""Records of draws, gates and worlds of the calibration, errors that several worlds need, and counted rows."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import lru_cache
from typing import Any

import numpy as np
from scipy import signal

from consistency.referee.types import Array

STEPS, DOF, SEED = 100, 3, 20070101


@dataclass(frozen=True)
class World:
    """A way to draw gates, and what it is in words."""

    draw: Callable[[Draw], Gate]
    about: str
    dof: int | None = DOF  # dimension of the error; None without one


@dataclass(frozen=True)
class Draw:
    """What to draw: ``runs`` runs of ``steps`` steps."""

    rng: np.random.Generator
    runs: int
    steps: int = STEPS
    first: int = 0  # runs that gates before this one have had, in worlds with a pool of runs


@dataclass(frozen=True)
class Gate:
    """Arrays of one gate, named as those of ``consistency.Record``; R runs, T steps."""

    error: Array | None = None  # (R, T, n)
    covariance: Array | None = None  # (R, T, n, n)
    nees: Array | None = None  # (R, T)
    dof: int | None = None
    nis: Array | None = None  # (R, T)
    nis_dof: Array | None = None  # (R, T)
    innovations: Array | None = None  # (R, T, m)
    innovation_covariances: Array | None = None  # (R, T, m, m)
    optimal_gain: bool = False

    def wrong_by(self, ratio: float) -> Gate:
        """The gate of a filter whose covariances are ``ratio`` times too small."""
        if ratio == 1.0:
            return self
        factors = {"covariance": 1.0 / ratio, "nees": ratio, "nis": ratio, "innovation_covariances": 1.0 / ratio}
        changed: dict[str, Any] = {n: value * factors[n] for n, value in self.arrays().items() if n in factors}
        return replace(self, **changed)

    def first(self, runs: int) -> Gate:
        """The gate of the first ``runs`` runs."""
        return replace(self, **{name: value[:runs] for name, value in self.arrays().items()})

    def arrays(self) -> dict[str, Any]:
        """The arrays that are given, by name."""
        given = {field.name: getattr(self, field.name) for field in fields(self)}
        return {name: value for name, value in given.items() if isinstance(value, np.ndarray)}


def joined(gates: Sequence[Gate]) -> Gate:
    """The runs of several draws from one world as one gate."""
    if len(gates) == 1:
        return gates[0]
    arrays: dict[str, Any] = {n: np.concatenate([gate.arrays()[n] for gate in gates]) for n in gates[0].arrays()}
    return replace(gates[0], **arrays)


# --- what several worlds need -----------------------------------------------------------------------------------


def shared(covariance: Array, error: Array) -> Array:
    """One covariance for all runs, (T, n, n) or (n, n) -> (R, T, n, n)."""
    return np.broadcast_to(covariance, (*error.shape, error.shape[-1]))


def standard(error: Array) -> Gate:
    """Errors of unit variance, with the covariance that says so."""
    return Gate(error, shared(np.eye(error.shape[-1]), error))


@lru_cache
def roots(steps: int) -> Array:
    """Roots (T, 3, 3) of a covariance that changes from step to step."""
    return np.asarray(np.eye(DOF) + 0.3 * np.random.default_rng(SEED).standard_normal((steps, DOF, DOF)))


def first_order(draw: Draw, correlation: Array | np.float64, n: int) -> Array:
    """Stationary first-order autoregressive errors of unit variance (R, T, n); correlation of neighbours: a number
    or (R, 1)."""
    w = draw.rng.standard_normal((draw.runs, draw.steps, n))
    fresh = np.sqrt(1.0 - np.square(correlation))
    for k in range(1, draw.steps):
        w[:, k] = correlation * w[:, k - 1] + fresh * w[:, k]
    return w


def stationary(noise: Array, correlation: float, axis: int = 0) -> Array:
    """White noise made a stationary first-order autoregression of its variance along an axis; it is overwritten."""
    np.moveaxis(noise, axis, 0)[1:] *= np.sqrt(1.0 - correlation**2)
    return np.asarray(signal.lfilter([1.0], [1.0, -correlation], noise, axis=axis))


def random_walk_filter(draw: Draw, start: float, process: float, noise: float, n: int) -> tuple[Array, Array]:
    """Errors (R, T, n) of the Kalman filter of n random walks, and their variances (T, n)."""
    kicks, noises = draw.rng.standard_normal((2, draw.steps, draw.runs, n))
    P, e = start, np.sqrt(start) * draw.rng.standard_normal((draw.runs, n))
    errors, variances = np.empty((draw.runs, draw.steps, n)), np.empty((draw.steps, n))
    for k in range(draw.steps):
        P, e = P + process, e + np.sqrt(process) * kicks[k]
        gain = P / (P + noise)
        P, e = (1.0 - gain) * P, (1.0 - gain) * e - gain * np.sqrt(noise) * noises[k]
        errors[:, k], variances[k] = e, P
    return errors, variances


def headings(draw: Draw) -> Array:
    """Headings (R, T) that wander 0.5 rad a step, another way in each run."""
    return np.asarray(0.5 * draw.rng.standard_normal((draw.runs, draw.steps)).cumsum(axis=1))


def turned(error: Array, variance: Array, heading: Array) -> tuple[Array, Array]:
    """Planar errors (R, T, 2) of variances (T, 2), seen from a body of that heading, and their covariance."""
    turn = rotation(-heading)
    return (turn @ error[..., None])[..., 0], (turn * variance[..., None, :]) @ np.swapaxes(turn, -1, -2)


def rotation(angle: Array) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.stack([np.stack([c, -s], axis=-1), np.stack([s, c], axis=-1)], axis=-2)


def with_innovations(rows: Sequence[tuple[Array, float, Array, float]]) -> Gate:
    """Error (R, 2), its variance, innovation (R, 2) and its variance of every step -> a gate."""
    error, innovation = (np.stack([row[i] for row in rows], axis=1) for i in (0, 2))
    P, S = (np.array([row[i] for row in rows])[:, None, None] * np.eye(2) for i in (1, 3))
    return Gate(error, shared(P, error), innovations=innovation, innovation_covariances=shared(S, innovation))


def row(
    world: str, question: str, ratio: float, runs: int, stated: float, bound: str, gates: int, found: int
) -> dict[str, Any]:
    """``found`` of ``gates`` gates, and the share that is ``stated`` with its ``bound``, "<=" or ">="."""
    return {
        "world": world, "question": question, "ratio": ratio, "runs": runs, "looks": 1, "stated": stated,
        "bound": bound, "gates": gates, "found": found,
    }  # fmt: skip
