"""Floors beside factors on a stated covariance: whether data tell them apart, whether they are needed, their fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy import stats

from consistency.referee.defaults import CONFIDENCE
from consistency.referee.diagnostics.records.record import Record
from consistency.referee.diagnostics.verdict.parts import Interval
from consistency.referee.fit_covariance.factors import (
    Block,
    Factors,
    Fit,
    fit_alone,
    known_dof,
    mean_over_runs,
    run_score,
    steps_of_runs,
)
from consistency.referee.fit_covariance.white_noise import interval_of, interval_of_ratio, nonnegative
from consistency.referee.types import Array, Indices

ALIKE = 0.98  # squared cosine between a stated covariance and a floor, from which data do not tell one from the other
STEPS, CLOSE = 60, 1e-9  # of scoring; gain of the log likelihood of a step at which it ends
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
    places = list(block.places)
    first, second = [], []
    for _, P in steps_of_runs(record):
        inverse = np.linalg.inv(P[:, places][:, :, places])
        first.append(np.trace(inverse, axis1=1, axis2=2).mean())
        second.append((inverse**2).sum(axis=(1, 2)).mean())
    return float(np.mean(first) ** 2 / (len(block) * np.mean(second)))


# --- maximum likelihood -----------------------------------------------------------------------------------------------


def fit_with_floors(record: Record, alone: Fit, free: Indices) -> Fit:
    """Fit factors and the floors of some blocks, beginning with the factors ``alone``.

    Scoring, as in :func:`~consistency.referee.fit_covariance.white_noise.fit_terms`, with runs of the same weight. What
    is fitted without a run is one step of scoring from the fit of all.
    """
    blocks, start = alone.factors.blocks, alone.factors.factor
    theta = np.append(start, np.zeros(len(free)))
    value, g, H = scores(record, blocks, free, theta)
    for _ in range(STEPS):
        target = nonnegative(H.sum(axis=0), g.sum(axis=0) + H.sum(axis=0) @ theta)
        target[: len(start)] = np.maximum(target[: len(start)], LEAST * start)
        step, gain = 1.0, -np.inf
        while gain < 0 and step >= 1e-3:
            trial = theta + step * (target - theta)
            tried = scores(record, blocks, free, trial)
            gain = float(tried[0].mean() - value.mean())
            step *= 0.5
        if gain > 0:
            theta, (value, g, H) = trial, tried
        if gain < CLOSE:
            break
    B, p = len(blocks), len(theta)
    without_g, without_H = g.sum(axis=0) - g, H.sum(axis=0) - H
    open_steps = theta + np.linalg.solve(without_H, without_g[..., None])[..., 0]  # which may lead below 0
    open_step = theta + np.linalg.solve(H.sum(axis=0), g.sum(axis=0))
    left_out = np.array([nonnegative(h, b + h @ theta) for h, b in zip(without_H, without_g, strict=True)])
    left_out[:, :B] = np.maximum(left_out[:, :B], LEAST * alone.factors.factor)
    factors = [_factors(blocks, free, each) for each in (theta, *left_out)]
    floors = [Interval(0.0, 0.0, 0.0)] * B
    for i, b in zip(range(B, p), free, strict=True):
        floors[b] = floor_interval(theta[i], open_step[i], open_steps[:, i])
    intervals = []
    for b, factor in enumerate(theta[:B].tolist()):
        if open_steps[:, b].min() > LEAST * start[b]:
            intervals.append(interval_of_ratio(factor, open_steps[:, b]))
        else:  # a factor that may be 0, so that the floor stands alone
            center = factor if factor > 2.0 * LEAST * start[b] else 0.0
            intervals.append(floor_interval(center, open_step[b], open_steps[:, b])._replace(value=factor))
    return Fit(
        factors[0],
        tuple(factors[1:]),
        tuple(intervals),
        tuple(floors),
        known_dof(relative_sizes(record, factors[0], factors[1:]), np.array([len(block) for block in blocks])),
    )


def scores(record: Record, blocks: tuple[Block, ...], free: Indices, theta: Array) -> tuple[Array, Array, Array]:
    """Log likelihood of a step but for its constant, its gradient and expected information, means of each run.

    Shapes (R,), (R, p) and (R, p, p), for p parameters: a factor of each block, then the floors of those that are free.
    """
    factors = _factors(blocks, free, theta)
    found = []
    for error, P in steps_of_runs(record):
        C = factors.applied(P)
        inverse = np.linalg.inv(C)
        u = (inverse @ error[..., None])[..., 0]
        F = _derivatives(C, factors, free)
        G = inverse[:, None] @ F
        flat = G.reshape(*G.shape[:2], -1)
        turned = np.swapaxes(G, -1, -2).reshape(flat.shape)
        information = 0.5 * np.tensordot(flat, turned, ((0, 2), (0, 2)))
        gradient = 0.5 * (np.einsum("ki,kpij,kj->p", u, F, u, optimize=True) - np.einsum("kpii->p", G))
        value = -0.5 * float((error * u).sum() + np.linalg.slogdet(C)[1].sum())
        found.append((value / len(error), gradient / len(error), information / len(error)))
    values, gradients, informations = zip(*found, strict=True)
    return np.array(values), np.array(gradients), np.array(informations)


def _derivatives(C: Array, factors: Factors, free: Indices) -> Array:
    """Derivatives (k, p, n, n) of corrected covariances C (k, n, n) by factors and floors."""
    n = C.shape[-1]
    scaled = C - np.diag(factors.of_components()[1])
    found = []
    for block, factor in zip(factors.blocks, factors.factor, strict=True):
        rows = np.zeros((n, 1))
        rows[list(block.places)] = 0.5 / factor
        found.append(rows * scaled + scaled * rows.T)
    for b in free:
        own = np.zeros(n)
        own[list(factors.blocks[b].places)] = 1.0
        found.append(np.broadcast_to(np.diag(own), C.shape))
    return np.stack(found, axis=1)


def relative_sizes(record: Record, whole: Factors, others: Sequence[Factors]) -> Array:
    """Corrected variances of each block by other factors, over those by ``whole``, (others, B)."""
    sizes = np.empty((len(others), len(whole.blocks)))
    for b, block in enumerate(whole.blocks):
        places = list(block.places)
        inverses = (np.linalg.inv(whole.applied(P)[:, places][:, :, places]) for _, P in steps_of_runs(record))
        traces = [np.trace(inverse, axis1=1, axis2=2).mean() for inverse in inverses]
        share = float(np.mean(traces)) * whole.floor[b] / len(block)  # of the floor
        floor = max(whole.floor[b], 1e-300)
        sizes[:, b] = [
            (1.0 - share) * each.factor[b] / whole.factor[b] + share * each.floor[b] / floor for each in others
        ]
    return sizes


def _factors(blocks: tuple[Block, ...], free: Indices, theta: Array) -> Factors:
    floor = np.zeros(len(blocks))
    floor[free] = theta[len(blocks) :]
    return Factors(blocks, theta[: len(blocks)], floor)


def floor_interval(value: float, open_value: float, left_out: Array) -> Interval:
    """Interval of a floor from its values with each run left out, which may lie below 0; one-sided at 0."""
    if value > 0.0 and left_out.min() > 0.0:
        return interval_of(float(value), left_out)
    k = len(left_out)
    error = float(np.sqrt(k - 1) * left_out.std())
    tail = 1.0 - CONFIDENCE if value == 0.0 else 0.5 * (1.0 - CONFIDENCE)
    reach = float(stats.t.isf(tail, k - 1)) * error
    return Interval(float(value), max(float(value) - reach, 0.0), max(float(open_value), 0.0) + reach)
