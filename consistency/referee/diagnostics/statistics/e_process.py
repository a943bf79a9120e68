"""E-process for the scale, valid at any stopping time and under any dependence between steps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import special

from consistency.referee.types import Array

UP = np.array([0.1, 0.25, 0.5, 1.0])  # stakes against a covariance too small
DOWN = np.array([0.25, 0.5, 1.0, 2.0, 4.0])  # against one too large
KEPT = 0.02  # of a stake, so that no single run ends the game


@dataclass(frozen=True)
class EProcess:
    """Betting on run means of the NEES; N runs in the order in which they came.

    For a filter whose covariance is right, or errs in the other direction only, each of ``up`` and ``down`` ever
    reaches 1 / alpha with probability alpha at most (Ville 1939), and so does ``both``.
    """

    up: Array  # (N,), e-value against 'no covariance is too small' after each run
    down: Array  # (N,), against 'none is too large'

    @property
    def both(self) -> Array:
        """(N,), against 'the covariance is right'."""
        return np.asarray(0.5 * (self.up + self.down))


def e_process(means: Array, dof: int | Array) -> EProcess:
    """E-process on run means Y_i of the NEES over its degrees of freedom.

    Up: the mean over stakes l of prod(1 + l (Y_i - 1)). Down: the mean over l of
    prod(0.98 max(0, 1 - l (Y_i - 1)) / c_l + 0.02), with c_l the mean of max(0, 1 - l (Y - 1)) for
    Y = chi-square(n) / n: c_l = (1 + l) F_n(x) - l F_n+2(x), x = n (1 + 1 / l), F_k the distribution function of
    chi-square(k).

    Each factor is convex in Y_i, and Y_i is an average over steps of chi-squares over n, so by Jensen's inequality
    its mean is at most that of a single step, 1, however the steps depend on each other and however many there
    are. Runs only have to be independent; they may differ in length, in dependence and in dimension. (Waudby-Smith &
    Ramdas 2024 describe betting on means; the mixture over stakes is of this project.)

    Parameters
    ----------
    means : (runs,), mean NEES of each run over its degrees of freedom; a run without a value is left out beforehand
    dof : dimension of the error, one number or (runs,)
    """
    y = np.asarray(means, float)
    n = np.broadcast_to(np.asarray(dof, float), y.shape)[:, None]
    x = n * (1.0 + 1.0 / DOWN)
    expected = (1.0 + DOWN) * special.chdtr(n, x) - DOWN * special.chdtr(n + 2.0, x)
    gain = np.maximum(0.0, 1.0 - DOWN * (y[:, None] - 1.0))
    with np.errstate(divide="ignore"):  # a run without any error loses all that was staked
        won = np.log1p(UP * (y[:, None] - 1.0))
    return EProcess(_mixture(won), _mixture(np.log((1.0 - KEPT) * gain / expected + KEPT)))


def ever(values: Array) -> float:
    """p value of an e-process (N,) looked at after every run: 1 over the largest value so far."""
    return min(1.0, 1.0 / float(np.max(values, initial=1.0)))


def _mixture(log_gains: Array) -> Array:
    """Mean over stakes of the product up to each run, (N, stakes) -> (N,)."""
    totals = np.cumsum(log_gains, axis=0)
    return np.asarray(np.exp(np.minimum(special.logsumexp(totals, axis=1) - np.log(log_gains.shape[1]), 700.0)))
