"""Validity of matrices as covariances; the caller decides what to do with an invalid one."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

import numpy as np

from consistency.referee.diagnostics.records.large_arrays import by_runs
from consistency.referee.types import Array, Indices

DEFICIENT = 1e-12  # eigenvalue of a correlation matrix below which a direction carries no uncertainty
NEGATIVE = 1e-9  # of the largest entry: an eigenvalue further below zero is not rounding, in any unit


class Validity(IntEnum):
    """Classes of :func:`classify`; where several hold, the last of them."""

    VALID = 0
    DEFICIENT = 1  # positive semidefinite: a direction carries no uncertainty
    INDEFINITE = 2
    ASYMMETRIC = 3
    NOT_FINITE = 4


class Tolerance(NamedTuple):
    """Limits of rounding errors."""

    asymmetry: float  # of the largest entry
    indefinite: float  # eigenvalue of a correlation matrix, below zero
    zero: float  # variance that counts as none, in its own unit


EXACT = Tolerance(asymmetry=1e-8, indefinite=DEFICIENT, zero=0.0)  # arrays of doubles
# text files of seven digits; of fewer, a singular matrix; variances of nothing as in the filters of this package
ROUNDED = Tolerance(asymmetry=1e-6, indefinite=1e-4, zero=1e-24)


def classify(covariance: Array, tolerance: Tolerance = EXACT) -> Indices:
    """:class:`Validity` of each matrix, (..., n, n) -> (...), in any units of the components.

    Rank is judged by the smallest eigenvalue of the correlation matrix, where a component whose variance is zero has
    the variance 1 and the covariances that it has.
    """
    P = covariance.reshape(-1, *covariance.shape[-2:])
    return by_runs(lambda some: _classify(some, tolerance), P).reshape(covariance.shape[:-2])


def _classify(P: Array, tolerance: Tolerance) -> Indices:
    finite = np.isfinite(P).all(axis=(-2, -1))
    out = np.full(len(P), Validity.NOT_FINITE, dtype=np.int64)
    P = P[finite]
    variance = np.diagonal(P, axis1=-2, axis2=-1)
    none = np.abs(variance) <= tolerance.zero
    scale = np.where(none, 1.0, np.sqrt(np.abs(variance)))
    smallest = np.linalg.eigvalsh(P / (scale[..., :, None] * scale[..., None, :]))[:, 0]
    smallest = np.where(none.any(axis=-1), np.minimum(smallest, 0.0), smallest)
    kind = np.where(smallest > DEFICIENT, Validity.VALID, Validity.DEFICIENT)
    kind[smallest < -tolerance.indefinite] = Validity.INDEFINITE
    kind[asymmetric(P, tolerance)] = Validity.ASYMMETRIC
    out[finite] = kind
    return out


def asymmetric(covariance: Array, tolerance: Tolerance = EXACT) -> Array:
    """Which matrices (..., n, n) differ from their transpose by more than rounding; not those that are not finite."""
    with np.errstate(invalid="ignore"):  # infinity less infinity
        gap = np.abs(covariance - np.swapaxes(covariance, -1, -2)).max(axis=(-2, -1))
    return np.asarray(gap > tolerance.asymmetry * np.abs(covariance).max(axis=(-2, -1)))


def negative(covariance: Array) -> Array:
    """Which finite matrices (N, n, n) have a negative variance in some direction that is not rounding in any unit.

    More lenient than :attr:`Validity.INDEFINITE`, so that a covariance that lost its rank is not called impossible.
    """
    if not len(covariance):
        return np.zeros(0, bool)
    return np.asarray(np.linalg.eigvalsh(covariance)[:, 0] < -NEGATIVE * np.abs(covariance).max(axis=(-2, -1)))
