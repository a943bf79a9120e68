"""Floors beside factors on a stated covariance: whether data tell them apart, whether they are needed, their fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from consistency.referee.diagnostics.records.record import Record
from consistency.referee.diagnostics.verdict.parts import Interval
from consistency.referee.fit_covariance.factors import (
    Block,
    Factors,
    Fit,
    fit_alone,
    known_dof,
    members,
    run_score,
    steps_of_runs,
)
from consistency.referee.fit_covariance.intervals import floor_interval, mean_over_runs
from consistency.referee.fit_covariance.scoring import Score, maximise, nonnegative, score_of
from consistency.referee.types import Array, Indices

ALIKE = 0.98  # squared cosine between a stated covariance and a floor, from which data do not tell one from the other
CLOSE = 1e-9  # gain of the log likelihood of a step at which scoring ends
LEAST = 1e-9  # of its value with no floor, that a factor has
SAME = "the stated covariance hardly varies, or has the shape of a floor, so that factor and floor cannot be told apart"


def fit_runs(record: Record, blocks: tuple[Block, ...]) -> Fit:
    """Fit a factor to each block of two runs or more, and a floor where the held-out log score of runs asks for it.

    Where factor and floor can be told apart, the intervals are those of the model with both.
    """
    alone = fit_alone(record, blocks)
    free = [b for b, block in enumerate(blocks) if likeness(record, block) < ALIKE]
    notes = [f"{block.name}: {SAME}: the floor is 0" for b, block in enumerate(blocks) if b not in free]
    if not free:
        return replace(alone, notes=tuple(notes))
    both = fit_with_floors(record, alone, np.array(free))
    gain = mean_over_runs(held_out_scores(record, both) - held_out_scores(record, alone))
    if gain.low > 0.0:
        notes.append(
            f"with floors the held-out log score of a step gains {gain.value:.2g} [{gain.low:.2g}, {gain.high:.2g}]"
        )
        return replace(both, notes=tuple(notes))
    notes.append(f"floors are 0: with them the held-out log score of a step is not shown to gain ({gain.value:+.2g})")
    factors = zip(alone.factor, both.factor, strict=True)
    intervals = (Interval(a.value, min(a.value, b.low), max(a.value, b.high)) for a, b in factors)
    floors = (each._replace(value=0.0, low=0.0) for each in both.floor)
    return replace(alone, factor=tuple(intervals), floor=tuple(floors), notes=tuple(notes))


def held_out_scores(record: Record, fit: Fit) -> Array:
    """Log density of a step of each run by the fit of the others, (R,)."""
    runs = zip(fit.left_out, steps_of_runs(record), strict=True)
    return np.array([run_score(factors.applied(P), error) for factors, (error, P) in runs])


def likeness(record: Record, block: Block) -> float:
    """Squared cosine between the stated covariance of a block and a floor, in the metric of the likelihood.

    1 where each covariance is the same multiple of the identity.
    """
    first, second = [], []
    for _, P in steps_of_runs(record):
        inverse = np.linalg.inv(block.of(P))
        first.append(np.trace(inverse, axis1=1, axis2=2).mean())
        second.append((inverse**2).sum(axis=(1, 2)).mean())
    return float(np.mean(first) ** 2 / (len(block) * np.mean(second)))


# --- maximum likelihood -----------------------------------------------------------------------------------------------


def fit_with_floors(record: Record, alone: Fit, free: Indices) -> Fit:
    """Fit factors and the floors of some blocks by scoring, beginning with the factors ``alone``.

    Runs have the same weight. What is fitted without a run is one step of scoring from the fit of all.
    """
    blocks = alone.factors.blocks
    B = len(blocks)
    start = np.append(alone.factors.factor, np.zeros(len(free)))
    least = LEAST * start

    def score(theta: Array) -> Score:
        return Score(*(part.sum(axis=0) for part in scores(record, blocks, free, theta)))

    theta = maximise(score, start, least, CLOSE * len(alone.left_out))
    _, gradients, informations = scores(record, blocks, free, theta)
    g, H = gradients.sum(axis=0), informations.sum(axis=0)
    open_value = theta + np.linalg.solve(H, g)  # which may lie below 0
    open_left_out = theta + np.linalg.solve(H - informations, (g - gradients)[..., None])[..., 0]
    left_out, intervals = [], []
    for of_run, information in zip(gradients, informations, strict=True):
        rest = H - information
        at = np.maximum(nonnegative(rest, g - of_run + rest @ theta), least)
        left_out.append(with_parameters(blocks, free, at))
    for i, value in enumerate(theta.tolist()):
        inside = value if value > 2.0 * least[i] else 0.0
        interval = floor_interval(inside, float(open_value[i]), open_left_out[:, i])
        intervals.append(interval._replace(value=value))
    floors = [Interval(0.0, 0.0, 0.0)] * B
    for i, b in enumerate(free):
        floors[b] = intervals[B + i]
    factors = with_parameters(blocks, free, theta)
    sizes = np.array([len(block) for block in blocks], float)
    dof = known_dof(relative_sizes(record, factors, left_out), sizes)
    return replace(
        alone, factors=factors, left_out=tuple(left_out), factor=tuple(intervals[:B]), floor=tuple(floors), dof=dof
    )


def with_parameters(blocks: tuple[Block, ...], free: Indices, theta: Array) -> Factors:
    """A factor of each block, and the floors of those that are free, from parameters (p,) in this order."""
    floor = np.zeros(len(blocks))
    floor[free] = theta[len(blocks) :]
    return Factors(blocks, theta[: len(blocks)], floor)


def scores(record: Record, blocks: tuple[Block, ...], free: Indices, theta: Array) -> tuple[Array, Array, Array]:
    """The score of a step, mean of each run: shapes (R,), (R, p) and (R, p, p)."""
    factors = with_parameters(blocks, free, theta)
    found = []
    for error, P in steps_of_runs(record):
        C = factors.applied(P)
        of_run = score_of(error, C, derivatives(C, factors, free))
        found.append([part / len(error) for part in of_run])
    values, gradients, informations = map(np.array, zip(*found, strict=True))
    return values, gradients, informations


def derivatives(C: Array, factors: Factors, free: Indices) -> Array:
    """Derivatives (k, p, n, n) of corrected covariances C (k, n, n) by factors and floors."""
    n = C.shape[-1]
    own = members(factors.blocks)
    rates = 0.5 * own / factors.factor[:, None]  # of the square root of a factor, over it
    scaled = C - np.diag(factors.of_components()[1])
    by_factor = (rates[:, :, None] + rates[:, None, :]) * scaled[:, None]
    by_floor = np.broadcast_to(own[free, :, None] * np.eye(n), (len(C), len(free), n, n))
    return np.concatenate([by_factor, by_floor], axis=1)


def relative_sizes(record: Record, whole: Factors, others: list[Factors]) -> Array:
    """Corrected variances of each block by other factors, over those by ``whole``, (others, B)."""
    precision = np.empty(len(whole.blocks))
    for b, block in enumerate(whole.blocks):
        inverses = [np.linalg.inv(block.of(whole.applied(P))) for _, P in steps_of_runs(record)]
        precision[b] = np.mean([np.trace(each, axis1=1, axis2=2).mean() for each in inverses]) / len(block)
    factor = np.array([each.factor for each in others]) / whole.factor
    floor = np.array([each.floor for each in others])
    return np.asarray(factor * (1.0 - whole.floor * precision) + floor * precision)
