"""NEES of a map: of many landmarks that share the errors of one run."""

from __future__ import annotations

import numpy as np
from scipy.linalg import solve_triangular

from consistency.diagnostics.records import MapScore
from consistency.diagnostics.scale import ratio_interval
from consistency.types import Array, Indices

POINT = 3  # degrees of freedom of a landmark


def map_score(run: Indices, nees: Array) -> MapScore:
    """Mean NEES over 3 of landmarks (M,), with an interval from the spread between their runs (M,).

    Landmarks of one run share the error of its pose, so each run counts once, by the mean of its landmarks.
    """
    judged = np.isfinite(nees)
    _, place = np.unique(run[judged], return_inverse=True)
    counts = np.bincount(place)
    means = np.bincount(place, nees[judged]) / np.maximum(counts, 1) / POINT
    return MapScore(ratio_interval(means, POINT), len(counts), int(judged.sum()), int((~judged).sum()))


def joint_nees(error: Array, covariance: Array) -> Array:
    """Parts (n / 3,) of the NEES of a joint error (n,) with its covariance (n, n), three components after three.

    L^-1 error with L L' = covariance has independent standard normal components if the covariance is right. So each
    part is chi-square with 3 degrees of freedom, independent of the others: that of its components given those
    before. Their sum is the joint NEES. All are infinite if the covariance is not positive definite.
    """
    try:
        L = np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        return np.full(len(error) // POINT, np.inf)
    parts = np.square(solve_triangular(L, error, lower=True, check_finite=False)).reshape(-1, POINT).sum(axis=1)
    return parts if np.isfinite(parts).all() else np.full(len(parts), np.inf)
