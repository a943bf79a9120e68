"""Factors and floors on a stated covariance, P' = D P D + F: one factor and one floor for each block of components.

D is diagonal, with the square root of the factor of each component's block, and F with its floor. Runs are the unit of
all intervals, so that nothing is assumed about how the steps of a run depend on each other. A run counts by its number
of steps: with equal weights a right covariance would not have the factor 1 where runs end, or are in a group, by what
was measured (see :func:`consistency.referee.diagnostics.scale.RunMeans`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from consistency.referee.diagnostics.record import Record
from consistency.referee.diagnostics.verdict_parts import Interval
from consistency.referee.errors import InputError
from consistency.referee.fit_covariance.estimation import (
    TAIL,
    Score,
    chance_of_one,
    dof_of_ratio,
    effective_number,
    floor_interval,
    interval_of_ratio,
    log_densities,
    maximise,
    mean_over_runs,
    nonnegative,
    score_of,
    solve_each,
)
from consistency.referee.types import Array, Indices

KINDS = {
    "position": ("x", "y", "z", "east", "north", "up", "e", "n", "u"),
    "attitude": ("heading", "roll", "pitch", "yaw"),
    "velocity": ("vx", "vy", "vz", "v", "speed"),
    "gyroscope bias": ("bgx", "bgy", "bgz"),
    "accelerometer bias": ("bax", "bay", "baz"),
}
ROUNDS = 50  # of Newton's method
FAR, CLOSE = 0.25, 1e-10  # decrement from which its steps are damped, and at which it ends
ALIKE = 0.98  # squared cosine between a stated covariance and a floor, from which data do not tell one from the other
GAIN = 1e-9  # of the log likelihood of a step at which scoring ends
LEAST = 1e-9  # of its value with no floor, that a factor has
NONE = Interval(0.0, 0.0, 0.0)
SAME = "the stated covariance hardly varies, or has the shape of a floor, so that factor and floor cannot be told apart"


@dataclass(frozen=True)
class FactorBlock:
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

    blocks: tuple[FactorBlock, ...]
    factor: Array  # (B,), on variances
    floor: Array  # (B,), variances

    def of_components(self) -> tuple[Array, Array]:
        """Factor and floor of each component of the error, (n,) both."""
        shares = members(self.blocks)
        return self.factor @ shares, self.floor @ shares

    def by_name(self, axes: Sequence[str]) -> dict[str, tuple[float, float]]:
        """Factor and floor of each component by its name."""
        factor, floor = self.of_components()
        return dict(zip(axes, zip(factor.tolist(), floor.tolist(), strict=True), strict=True))

    def applied(self, P: Array) -> Array:
        """Corrected covariances of stated ones, (..., n, n)."""
        factor, floor = self.of_components()
        d = np.sqrt(factor)
        return np.asarray(P * np.outer(d, d) + np.diag(floor))


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


def members(blocks: Sequence[FactorBlock]) -> Array:
    """Which components each block has, (B, n), 1 or 0."""
    found = np.zeros((len(blocks), sum(map(len, blocks))))
    for b, block in enumerate(blocks):
        found[b, list(block.places)] = 1.0
    return found


def blocks_of(axes: Sequence[str], n: int, per_axis: bool) -> tuple[FactorBlock, ...]:
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
    return tuple(FactorBlock(name, tuple(places)) for name, places in found.items())


def stated_errors(record: Record) -> tuple[Array, Array, Array]:
    """Errors (runs, steps, n), stated covariances and NEES (runs, steps) of a record that has them."""
    assert record.errors.error is not None
    assert record.errors.covariance is not None
    assert record.errors.nees is not None
    return record.errors.error, record.errors.covariance, record.errors.nees


def steps_of_runs(record: Record) -> Iterator[tuple[Array, Array]]:
    """Errors (k, n) and stated covariances (k, n, n) of the steps of each run that count."""
    for error, P, nees in zip(*stated_errors(record), strict=True):
        there = np.isfinite(nees)
        yield error[there], P[there]


def run_weights(record: Record) -> Array:
    """Steps of each run that has any over their mean, (R,)."""
    assert record.errors.nees is not None
    counts = np.isfinite(record.errors.nees).sum(axis=1)
    counts = counts[counts > 0]
    return np.asarray(counts / counts.mean())


def fit_runs(record: Record, blocks: tuple[FactorBlock, ...], fits: int = 1) -> Fit:
    """Fit a factor to each block of two runs or more, and a floor where the held-out log score of runs asks for it.

    Each run has a step that counts. Where factor and floor can be told apart, the intervals are those of the model with
    both. All of several ``fits`` together have a floor by chance no more often than one.
    """
    alone = fit_alone(record, blocks)
    free, notes = [], []
    for b, block in enumerate(blocks):
        if likeness(record, block) < ALIKE:
            free.append(b)
        else:
            notes.append(f"{block.name}: {SAME}: the floor is 0")
    if not free:
        return replace(alone, notes=tuple(notes))
    both = fit_with_floors(record, alone, np.array(free))
    gains = held_out_scores(record, both) - held_out_scores(record, alone)
    gain = mean_over_runs(run_weights(record) * gains, TAIL / fits)
    if gain.low > 0.0:
        notes.append(
            f"with floors the held-out log score of a step gains {gain.value:.2g} [{gain.low:.2g}, {gain.high:.2g}]"
        )
        return replace(both, notes=tuple(notes))
    notes.append(f"floors are 0: with them the held-out log score of a step is not shown to gain ({gain.value:+.2g})")
    intervals = []
    for factor, beside_floor in zip(alone.factor, both.factor, strict=True):
        low = min(factor.value, beside_floor.low)
        high = max(factor.value, beside_floor.high)
        intervals.append(Interval(factor.value, low, high))
    floors = (each._replace(value=0.0, low=0.0) for each in both.floor)
    return replace(alone, factor=tuple(intervals), floor=tuple(floors), notes=tuple(notes))


def held_out_scores(record: Record, fit: Fit) -> Array:
    """Log density of a step of each run by the fit of the others, (R,)."""
    found = []
    for factors, (error, P) in zip(fit.left_out, steps_of_runs(record), strict=True):
        densities = log_densities(error, factors.applied(P))
        found.append(densities.mean())
    return np.array(found)


# --- factors alone ----------------------------------------------------------------------------------------------------


def fit_alone(record: Record, blocks: tuple[FactorBlock, ...]) -> Fit:
    """Fit a factor to each block of the errors of two runs or more, without floors."""
    sizes = np.array([len(block) for block in blocks], float)
    w = run_weights(record)
    Q = w[:, None, None] * run_moments(record, blocks)
    factor = fit_factors(Q.sum(axis=0) / w.sum(), sizes)
    left_out = fit_factors((Q.sum(axis=0) - Q) / (w.sum() - w)[:, None, None], sizes)
    runs = effective_number(w)
    none = np.zeros(len(blocks))
    values = list(zip(factor.tolist(), left_out.T, strict=True))
    return Fit(
        Factors(blocks, factor, none),
        tuple(Factors(blocks, each, none) for each in left_out),
        tuple(interval_of_ratio(*value, runs) for value in values),
        (NONE,) * len(blocks),
        known_dof(left_out, sizes, runs),
        tuple(chance_of_one(*value, runs) for value in values),
    )


def run_moments(record: Record, blocks: Sequence[FactorBlock]) -> Array:
    """Q (R, B, B): means over the steps of each run of e_b' (P^-1)_bc e_c, which is all that factors are fitted to."""
    Q = []
    for error, P in steps_of_runs(record):
        parts = error[..., None] * members(blocks).T
        products = np.swapaxes(parts, 1, 2) @ np.linalg.solve(P, parts)
        Q.append(products.mean(axis=0))
    return np.array(Q)


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
        step = solve_each(scaled + np.diag(sizes), gradient)
        squared = (step * gradient).sum(axis=-1, keepdims=True)
        decrement = np.sqrt(np.maximum(squared, 0.0))
        x = x * (1.0 - step / np.where(decrement < FAR, 1.0, 1.0 + decrement))
        if decrement.max() < CLOSE:
            break
    return np.asarray(x**-2.0)


def known_dof(left_out: Array, sizes: Array, runs: float) -> Array:
    """Degrees of freedom with which factors (R, B), each without a run, are known from one run less than ``runs``.

    They are at least those of runs whose steps are all the same.
    """
    return np.asarray(np.maximum(dof_of_ratio(left_out), (runs - 1.0) * sizes))


# --- factors and floors -----------------------------------------------------------------------------------------------


def likeness(record: Record, block: FactorBlock) -> float:
    """Squared cosine between the stated covariance of a block and a floor, in the metric of the likelihood.

    1 where each covariance is the same multiple of the identity.
    """
    stated = [block.of(P) for _, P in steps_of_runs(record)]
    squares = []
    for P in stated:
        inverse = np.linalg.inv(P)
        squares.append((inverse**2).sum(axis=(1, 2)).mean())
    return float(len(block) * mean_precision(stated) ** 2 / np.mean(squares))


def mean_precision(covariances: Sequence[Array]) -> float:
    """Mean over runs, steps and components of the diagonal of P^-1, of covariances (k, n, n) of each run."""
    means = []
    for P in covariances:
        precisions = np.diagonal(np.linalg.inv(P), axis1=1, axis2=2)
        means.append(precisions.mean())
    return float(np.mean(means))


def fit_with_floors(record: Record, alone: Fit, free: Indices) -> Fit:
    """Fit factors and the floors of some blocks by scoring, beginning with the factors ``alone``.

    What is fitted without a run is one step of scoring from the fit of all.
    """
    blocks = alone.factors.blocks
    B = len(blocks)
    start = np.append(alone.factors.factor, np.zeros(len(free)))
    least = LEAST * start

    def score(theta: Array) -> Score:
        return Score(*(part.sum(axis=0) for part in scores(record, blocks, free, theta)))

    theta = maximise(score, start, least, GAIN * len(alone.left_out))
    _, g, H = scores(record, blocks, free, theta)
    others_g, others_H = g.sum(axis=0) - g, H.sum(axis=0) - H  # of all runs but one
    open_value = theta + np.linalg.solve(H.sum(axis=0), g.sum(axis=0))  # which may lie below 0
    open_left_out = theta + solve_each(others_H, others_g)
    targets = zip(others_H, others_g + others_H @ theta, strict=True)
    left_out = [with_parameters(blocks, free, np.maximum(nonnegative(*target), least)) for target in targets]
    runs = effective_number(run_weights(record))
    intervals = []
    for i, value in enumerate(theta.tolist()):
        inside = value if value > 2.0 * least[i] else 0.0
        interval = floor_interval(inside, float(open_value[i]), open_left_out[:, i], runs)
        intervals.append(interval._replace(value=value))
    floors = dict(zip(free.tolist(), intervals[B:], strict=True))
    factors = with_parameters(blocks, free, theta)
    sizes = np.array([len(block) for block in blocks], float)
    return replace(
        alone,
        factors=factors,
        left_out=tuple(left_out),
        factor=tuple(intervals[:B]),
        floor=tuple(floors.get(b, NONE) for b in range(B)),
        dof=known_dof(relative_sizes(record, factors, left_out), sizes, runs),
    )


def with_parameters(blocks: tuple[FactorBlock, ...], free: Indices, theta: Array) -> Factors:
    """A factor of each block, and the floors of those that are free, from parameters (p,) in this order."""
    floor = np.zeros(len(blocks))
    floor[free] = theta[len(blocks) :]
    return Factors(blocks, theta[: len(blocks)], floor)


def scores(record: Record, blocks: tuple[FactorBlock, ...], free: Indices, theta: Array) -> tuple[Array, Array, Array]:
    """The score of a step, mean of each run times its weight: shapes (R,), (R, p) and (R, p, p)."""
    factors = with_parameters(blocks, free, theta)
    found = []
    for weight, (error, P) in zip(run_weights(record), steps_of_runs(record), strict=True):
        C = factors.applied(P)
        of_run = score_of(error, C, derivatives(C, factors, free))
        found.append([weight * part / len(error) for part in of_run])
    values, gradients, informations = map(np.array, zip(*found, strict=True))
    return values, gradients, informations


def derivatives(C: Array, factors: Factors, free: Indices) -> Array:
    """Derivatives (k, p, n, n) of corrected covariances C (k, n, n) by factors and floors."""
    n = C.shape[-1]
    own = members(factors.blocks)
    rates = 0.5 * own / factors.factor[:, None]  # of the square root of a factor, over it
    scaled = C - np.diag(factors.of_components()[1])
    by_factor = (rates[:, :, None] + rates[:, None, :]) * scaled[:, None]
    by_floor = own[free, :, None] * np.eye(n)
    by_floor = np.broadcast_to(by_floor, (len(C), *by_floor.shape))
    return np.concatenate([by_factor, by_floor], axis=1)


def relative_sizes(record: Record, whole: Factors, others: Sequence[Factors]) -> Array:
    """Corrected variances of each block by other factors, over those by ``whole``, (others, B)."""
    corrected = [whole.applied(P) for _, P in steps_of_runs(record)]
    precision = np.array([mean_precision([block.of(P) for P in corrected]) for block in whole.blocks])
    factor = np.array([each.factor for each in others]) / whole.factor
    floor = np.array([each.floor for each in others])
    return np.asarray(factor * (1.0 - whole.floor * precision) + floor * precision)
