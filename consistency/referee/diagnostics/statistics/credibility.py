"""Noncredibility index: how far the stated covariance is from the errors, in decibels."""

from __future__ import annotations

import numpy as np

from consistency.referee.diagnostics.records.array_blocks import blocks
from consistency.referee.diagnostics.records.whitening import all_finite, squared_length, whiten
from consistency.referee.types import Array


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
    index, inclination = zip(*(_of_steps(error[:, s], nees[:, s]) for s in blocks(steps, runs)), strict=True)
    return np.concatenate(index), np.concatenate(inclination)


def _of_steps(error: Array, nees: Array) -> tuple[Array, Array]:
    n = error.shape[-1]
    present = np.isfinite(nees) & all_finite(error) & (nees > 0)
    index, inclination = np.full(nees.shape[1], np.nan), np.full(nees.shape[1], np.nan)
    count = present.sum(axis=0)
    e = np.where(present[..., None], error, 0.0)
    by_step = np.ascontiguousarray(np.moveaxis(e, 1, 0))
    mse = np.swapaxes(by_step, -1, -2) @ by_step / np.maximum(count, 1)[:, None, None]
    scale = np.sqrt(np.diagonal(mse, axis1=-2, axis2=-1))
    good = (count >= 2 * n) & (scale > 0).all(axis=-1)
    unit = np.where(good[:, None], scale, 1.0)
    correlation = mse / (unit[:, :, None] * unit[:, None, :])
    good &= np.linalg.cond(np.where(good[:, None, None], correlation, np.eye(n))) < 1e12
    if not good.any():
        return index, inclination
    actual = squared_length(whiten(e[:, good] / unit[good], correlation[good]))
    here = present[:, good]
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(here, 10.0 * np.log10(np.where(here, nees[:, good], 1.0) / np.where(here, actual, 1.0)), 0.0)
    index[good] = np.abs(ratio).sum(axis=0) / count[good]
    inclination[good] = ratio.sum(axis=0) / count[good]
    return index, inclination
