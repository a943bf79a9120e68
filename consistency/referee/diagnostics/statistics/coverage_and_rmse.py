"""Coverage of the stated bounds, root mean square errors, and the noncredibility index."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from consistency.referee.defaults import CONFIDENCE
from consistency.referee.diagnostics.records.large_arrays import block_slices, by_runs, of_runs
from consistency.referee.diagnostics.records.whitening import all_finite, spread_steps, squared_length, whiten
from consistency.referee.diagnostics.statistics.nees import binomial_interval
from consistency.referee.types import Array

TWO_SIGMA = 0.9544997361036416  # P(|N(0, 1)| <= 2)


def coverage(error: Array, covariance: Array, bound: float = 2.0, counted: Array | None = None) -> Array:
    """Share of errors within ``bound`` standard deviations, for each axis.

    Shapes (..., n) and (..., n, n) -> (n,); rows with NaN, or not ``counted`` (...), do not count.
    """
    error = np.asarray(error, float)
    P = np.asarray(covariance, float)
    if error.ndim == 1:
        error = error[None]
        P = P[None]
    P = np.broadcast_to(P, (*error.shape, error.shape[-1]))
    n = error.shape[-1]
    inside = np.zeros(n, np.int64)
    count = np.zeros(n, np.int64)
    for here in of_runs(error):
        for i in range(n):
            e = error[here][..., i]
            sigma = _sigma(P[here][..., i, i])
            valid = np.isfinite(e) & np.isfinite(sigma)
            if counted is not None:
                valid &= counted[here]
            within = np.abs(np.where(valid, e, 0.0)) <= bound * np.where(valid, sigma, 0.0)
            inside[i] += (valid & within).sum()
            count[i] += valid.sum()
    return np.where(count > 0, inside / np.maximum(count, 1), np.nan)


def _sigma(variance: Array) -> Array:
    return np.sqrt(np.where(variance >= 0, variance, np.nan))


def rmse(error: Array, axes: Sequence[int] | None = None, counted: Array | None = None) -> float:
    """Root of the mean squared length of errors (..., n) over all runs and steps.

    NaN rows do not count.

    Parameters
    ----------
    axes : components of the length; all of them where None
    counted : (...) of bool, rows that count
    """
    e = np.asarray(error, float)
    if axes is None:
        axes = range(e.shape[-1])
    squared = np.empty(e[..., 0].size)
    count = 0
    for here in of_runs(e):
        part = squared_length(e[here][..., list(axes)])
        known = np.isfinite(part)
        if counted is not None:
            known &= counted[here]
        part = part[known]
        squared[count : count + len(part)] = part
        count += len(part)
    if not count:
        return float("nan")
    return float(np.sqrt(squared[:count].mean()))


def coverage_interval(
    error: Array,
    covariance: Array,
    bound: float = 2.0,
    confidence: float = CONFIDENCE,
    counted: Array | None = None,
) -> tuple[Array, Array]:
    """Coverage of one step of each run and its exact binomial interval (Clopper & Pearson 1934), for each axis.

    One step of each run, spread over the trajectory (:func:`spread_steps`), gives independent draws; pooled steps would
    not. Shapes (runs, steps, n), (runs, steps, n, n) -> (n,), (n, 2); rows with NaN, or not ``counted`` (runs, steps),
    are not drawn.
    """
    error = np.asarray(error, float)
    P = np.asarray(covariance, float)
    there = by_runs(_usable, error, P)
    if counted is not None:
        there &= counted
    steps = spread_steps(there)
    rows = np.flatnonzero(steps >= 0)
    if not len(rows):
        n = error.shape[-1]
        return np.full(n, np.nan), np.tile([0.0, 1.0], (n, 1))
    variance = np.diagonal(P[rows, steps[rows]], axis1=-2, axis2=-1)
    inside = (np.abs(error[rows, steps[rows]]) <= bound * _sigma(variance)).sum(axis=0)
    return inside / len(rows), np.stack(binomial_interval(inside, len(rows), confidence), axis=-1)


def _usable(error: Array, P: Array) -> Array:
    out = np.ones(error.shape[:-1], bool)
    for i in range(error.shape[-1]):
        out &= np.isfinite(error[..., i]) & np.isfinite(P[..., i, i]) & (P[..., i, i] >= 0)
    return out


def noncredibility(error: Array, nees: Array) -> tuple[Array, Array]:
    """Noncredibility index and inclination index of every step, Li & Zhao (2006).

    10 / N times the sum over runs of log10(NEES / NEES*), with absolute value for the first and with sign for
    the second; NEES* is that with the actual mean squared error matrix of the step in place of the stated
    covariance. 0 is credible; 10 is a covariance wrong by a factor of 10. Inclination above 0 is
    overconfident. Both are relative to errors of the same runs, so they need many more runs than dimensions.

    Parameters
    ----------
    error : (runs, steps, n)
    nees : (runs, steps); NaN where a run has no value

    Returns
    -------
    (steps,) and (steps,) in dB; NaN where fewer than 2 n runs have a value
    """
    runs, steps = nees.shape
    if runs < 2 * error.shape[-1]:
        return np.full(steps, np.nan), np.full(steps, np.nan)
    index, inclination = zip(*(_of_steps(error[:, s], nees[:, s]) for s in block_slices(steps, runs)), strict=True)
    return np.concatenate(index), np.concatenate(inclination)


def _of_steps(error: Array, nees: Array) -> tuple[Array, Array]:
    n = error.shape[-1]
    present = np.isfinite(nees) & all_finite(error) & (nees > 0)
    index = np.full(nees.shape[1], np.nan)
    inclination = np.full(nees.shape[1], np.nan)
    runs_in_step = present.sum(axis=0)
    e = np.where(present[..., None], error, 0.0)
    by_step = np.ascontiguousarray(np.moveaxis(e, 1, 0))
    mse = np.swapaxes(by_step, -1, -2) @ by_step / np.maximum(runs_in_step, 1)[:, None, None]
    scale = np.sqrt(np.diagonal(mse, axis1=-2, axis2=-1))
    scored = (runs_in_step >= 2 * n) & (scale > 0).all(axis=-1)
    unit = np.where(scored[:, None], scale, 1.0)
    correlation = mse / (unit[:, :, None] * unit[:, None, :])
    scored &= np.linalg.cond(np.where(scored[:, None, None], correlation, np.eye(n))) < 1e12
    if not scored.any():
        return index, inclination
    actual = squared_length(whiten(e[:, scored] / unit[scored], correlation[scored]))
    present_runs = present[:, scored]
    with np.errstate(divide="ignore", invalid="ignore"):
        stated_over_actual = np.where(present_runs, nees[:, scored], 1.0) / np.where(present_runs, actual, 1.0)
        ratio = np.where(present_runs, 10.0 * np.log10(stated_over_actual), 0.0)
    index[scored] = np.abs(ratio).sum(axis=0) / runs_in_step[scored]
    inclination[scored] = ratio.sum(axis=0) / runs_in_step[scored]
    return index, inclination
