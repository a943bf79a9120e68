"""Factors and floors on a stated covariance, P' = D P D + F: one factor and one floor for each block of components.

D is diagonal, with the square root of the factor of each component's block, and F with its floor. Runs are the unit: a
run counts by the mean over its steps, so that nothing is assumed about how its steps depend on each other.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from consistency.referee.diagnostics.records.record import Record
from consistency.referee.diagnostics.verdict.parts import Interval
from consistency.referee.errors import InputError
from consistency.referee.fit_covariance.intervals import chance_of_one, dof_of_ratio, interval_of_ratio
from consistency.referee.types import Array

KINDS = {
    "position": ("x", "y", "z", "east", "north", "up", "e", "n", "u"),
    "attitude": ("heading", "roll", "pitch", "yaw"),
    "velocity": ("vx", "vy", "vz", "v", "speed"),
    "gyroscope bias": ("bgx", "bgy", "bgz"),
    "accelerometer bias": ("bax", "bay", "baz"),
}
ROUNDS = 50  # of Newton's method
FAR, CLOSE = 0.25, 1e-10  # decrement from which its steps are damped, and at which it ends


@dataclass(frozen=True)
class Block:
    """Components of the error that share a factor and a floor."""

    name: str
    places: tuple[int, ...]  # of its components in the error

    def __len__(self) -> int:
        return len(self.places)

    def of(self, P: Array) -> Array:
        """The covariances of its components, of covariances (..., n, n)."""
        places = list(self.places)
        return P[..., places, :][..., places]


@dataclass(frozen=True)
class Factors:
    """What a stated covariance becomes: P' = D P D + F."""

    blocks: tuple[Block, ...]
    factor: Array  # (B,), on variances
    floor: Array  # (B,), variances

    def of_components(self) -> tuple[Array, Array]:
        """Factor and floor of each component of the error, (n,) both."""
        shares = members(self.blocks)
        return self.factor @ shares, self.floor @ shares

    def applied(self, P: Array) -> Array:
        """Corrected covariances of stated ones, (..., n, n)."""
        factor, floor = self.of_components()
        d = np.sqrt(factor)
        return np.asarray(P * np.outer(d, d) + np.diag(floor))


def members(blocks: Sequence[Block]) -> Array:
    """Which components each block has, (B, n), 1 or 0."""
    found = np.zeros((len(blocks), sum(map(len, blocks))))
    for b, block in enumerate(blocks):
        found[b, list(block.places)] = 1.0
    return found


def blocks_of(axes: Sequence[str], n: int, per_axis: bool) -> tuple[Block, ...]:
    """Blocks of an error of n components by their names: position, attitude, velocity, biases.

    Components of other names are a block each, since their units are not known; those without names are one block.
    """
    if per_axis:
        names = list(axes) or [f"axis {i}" for i in range(n)]
    elif not axes:
        names = ["state"] * n
    else:
        kind_of = {axis: kind for kind, members in KINDS.items() for axis in members}
        names = [kind_of.get(axis, axis) for axis in axes]
    found: dict[str, list[int]] = {}
    for i, name in enumerate(names):
        found.setdefault(name, []).append(i)
    return tuple(Block(name, tuple(places)) for name, places in found.items())


# --- the factors alone ------------------------------------------------------------------------------------------------


def run_moments(record: Record, blocks: Sequence[Block]) -> Array:
    """Q (R, B, B): means over the steps of each run of e_b' (P^-1)_bc e_c, which is all that factors are fitted to.

    NaN where a run has no step that counts.
    """
    Q = np.full((len(record.run_numbers), len(blocks), len(blocks)), np.nan)
    for run, (error, P) in enumerate(steps_of_runs(record)):
        if len(error):
            parts = error[..., None] * members(blocks).T
            Q[run] = np.mean(np.swapaxes(parts, 1, 2) @ np.linalg.solve(P, parts), axis=0)
    return Q


def steps_of_runs(record: Record) -> Iterator[tuple[Array, Array]]:
    """Errors (k, n) and stated covariances (k, n, n) of the steps of each run that count."""
    assert record.error is not None
    assert record.covariance is not None
    assert record.nees is not None
    for error, P, nees in zip(record.error, record.covariance, record.nees, strict=True):
        there = np.isfinite(nees)
        yield error[there], P[there]


def fit_factors(Q: Array, sizes: Array) -> Array:
    """The factors (..., B) that are most likely for mean moments Q (..., B, B), of blocks with ``sizes`` (B,).

    With x = 1 / sqrt(factor) the negative log likelihood of a step is x' Q x / 2 - sum sizes log x, which is convex and
    self-concordant, so that damped steps of Newton's method stay within x > 0 (Boyd & Vandenberghe 2004, sec. 9.6).

    Raises
    ------
    InputError
        A block has no error at all.
    """
    own = np.diagonal(Q, axis1=-2, axis2=-1)
    if not (own > 0).all():
        raise InputError("a block of components has no error in any step; there is nothing to fit: leave it out")
    x = np.sqrt(sizes / own)
    for _ in range(ROUNDS):
        scaled = Q * x[..., :, None] * x[..., None, :]
        gradient = scaled.sum(axis=-1) - sizes
        step = np.linalg.solve(scaled + np.diag(sizes), gradient[..., None])[..., 0]
        decrement = np.sqrt(np.maximum((step * gradient).sum(axis=-1, keepdims=True), 0.0))
        x = x * (1.0 - step / np.where(decrement < FAR, 1.0, 1.0 + decrement))
        if decrement.max() < CLOSE:
            break
    return np.asarray(x**-2.0)


def without_each(values: Array) -> Array:
    """Means over the first axis with each of its R entries left out, of the same shape."""
    return np.asarray((values.sum(axis=0) - values) / (len(values) - 1))


@dataclass(frozen=True)
class Fit:
    """Factors of some runs, and what becomes of them with each of R runs left out."""

    factors: Factors
    left_out: tuple[Factors, ...]  # (R,), each fitted without one run
    factor: tuple[Interval, ...]  # (B,), before any term was dropped
    floor: tuple[Interval, ...]  # (B,)
    dof: Array  # (B,), degrees of freedom with which a factor is known
    chance: tuple[float, ...]  # (B,), of a factor as far from 1, without floors, where the right one is 1
    notes: tuple[str, ...] = ()


def fit_alone(record: Record, blocks: tuple[Block, ...]) -> Fit:
    """Fit a factor to each block of the errors of two runs or more, without floors."""
    sizes = np.array([len(block) for block in blocks], float)
    Q = run_moments(record, blocks)
    factor = fit_factors(Q.mean(axis=0), sizes)
    left_out = fit_factors(without_each(Q), sizes)
    none = np.zeros(len(blocks))
    values = list(zip(factor.tolist(), left_out.T, strict=True))
    return Fit(
        Factors(blocks, factor, none),
        tuple(Factors(blocks, each, none) for each in left_out),
        tuple(interval_of_ratio(*value) for value in values),
        (Interval(0.0, 0.0, 0.0),) * len(blocks),
        known_dof(left_out, sizes),
        tuple(chance_of_one(*value) for value in values),
    )


def known_dof(left_out: Array, sizes: Array) -> Array:
    """Degrees of freedom with which factors (R, B), each without a run, are known where R - 1 runs are fitted.

    They are at least those of runs whose steps are all the same.
    """
    return np.asarray(np.maximum(dof_of_ratio(left_out), (len(left_out) - 1) * sizes))


def run_score(C: Array, error: Array) -> float:
    """Log density of a step, mean over errors (k, n) of a run with covariances C (k, n, n)."""
    squares = (error * np.linalg.solve(C, error[..., None])[..., 0]).sum(axis=1)
    return float(-0.5 * (squares + np.linalg.slogdet(2.0 * np.pi * C)[1]).mean())
