"""The bias map: what is known of it, whether there is one, and what a filter should believe of it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy import optimize, stats

from consistency.bench.scenario.effects.node_tables import bilinear
from consistency.referee.types import Array
from consistency.stereo.characterising import coordinate_fit
from consistency.stereo.characterising.likelihood import LikelihoodFit
from consistency.stereo.characterising.truth_residuals import FEW, Residuals

GRID = (5, 4)  # nodes across and down
TRACKS = 3  # that a node needs
UNSURE = 5.0  # px, standard deviation of the prior that keeps a node without data from being singular


class Grid(NamedTuple):
    """Nodes of the image, and which have data; K across, L down."""

    u: Array  # (K,), px from the principal point
    v: Array  # (L,)
    rows: Array  # (L K,), observations, each shared out over the nodes around it
    known: Array  # (L K,) of bool

    def regressors(self, data: Residuals) -> Array:
        """Weights (N, L K) of the nodes in each row."""
        return bilinear(data.ideal[:, 0], data.ideal[:, 1], self.u, self.v)

    @property
    def ridge(self) -> Array:
        """Precision (L K,) of a prior: some where there are too few data, none elsewhere."""
        return np.where(self.known, 0.0, UNSURE**-2)


def grid_of(data: Residuals, u: Array, v: Array) -> Grid:
    """Nodes at ``u`` (K,) and ``v`` (L,), and what the data have around each."""
    weights = bilinear(data.ideal[:, 0], data.ideal[:, 1], u, v)
    rows = weights.sum(axis=0)
    if not len(data):
        return Grid(u, v, rows, np.zeros(len(rows), bool))
    tracks = (np.add.reduceat(weights, data.first, axis=0) > 1.0).sum(axis=0)
    return Grid(u, v, rows, (rows >= FEW) & (tracks >= TRACKS))


class BiasEstimate(NamedTuple):
    """Bias of u, v, d at the nodes of a grid."""

    grid: Grid
    value: Array  # (3, L K), px
    half: Array  # (3, L K), px, half widths of simultaneous intervals
    p_value: Array  # (3,), that there is no bias anywhere
    shown: Array  # (3,) of bool
    believed: Array  # (3, L K), px: shrunken, 0 where nothing is known or shown

    def matrix(self, k: int) -> Array:
        """What is believed of u, v or d, (L, K)."""
        return self.believed[k].reshape(len(self.grid.v), len(self.grid.u))


def estimate_bias(
    fits: Sequence[LikelihoodFit],
    grid: Grid,
    level: float,
    rate: float,
) -> BiasEstimate:
    """Bias of each coordinate from its fit.

    Parameters
    ----------
    level : probability that the interval of one node misses
    rate : probability of finding a bias in a coordinate that has none
    """
    known = grid.known
    value = np.full((3, len(known)), np.nan)
    half = np.full((3, len(known)), np.nan)
    believed = np.zeros((3, len(known)))
    p_value = np.ones(3)
    for k, fit in enumerate(fits):
        beta, width, C = coordinate_fit.bias_coefficients(fit, level)
        value[k, known] = beta[known]
        half[k, known] = width[known]
        if not known.any():
            continue
        b = beta[known]
        S = C[np.ix_(known, known)]
        p_value[k] = stats.chi2.sf(b @ np.linalg.solve(S, b), len(b))
        if p_value[k] < rate:
            believed[k, known] = shrunken(b, S)
    return BiasEstimate(grid, value, half, p_value, p_value < rate, believed)


def shrunken(b: Array, S: Array) -> Array:
    """Estimates (m,) with covariance (m, m) drawn towards zero as much as their own scatter asks for.

    The true values are taken as draws from N(0, w^2), with w of the largest likelihood: empirical Bayes, Efron &
    Morris (1973).
    """
    values, axes = np.linalg.eigh(S)
    along = axes.T @ b

    def negative(log_w: float) -> float:
        variance = np.exp(2.0 * log_w) + values
        return 0.5 * (np.log(variance) + along**2 / variance).sum()

    largest = np.abs(b).max() + np.sqrt(values.max()) + 1e-9
    top = np.log(largest) + 1.0
    best = optimize.minimize_scalar(negative, bounds=(top - 12.0, top), method="bounded")
    w2 = np.exp(2.0 * best.x)
    return axes @ (along * w2 / (w2 + values))
