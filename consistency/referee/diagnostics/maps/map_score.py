"""NEES of a map: of many landmarks that share the errors of one run."""

from __future__ import annotations

import numpy as np
from scipy.linalg import solve_triangular

from consistency.referee.diagnostics.questions.scale import ratio_interval
from consistency.referee.diagnostics.verdict.parts import MapScore
from consistency.referee.types import Array, Indices

POSE, POINT = 3, 3  # degrees of freedom of a pose in the plane, and of a landmark in space


def map_score(run: Indices, nees: Array, dof: int = POINT) -> MapScore:
    """Mean NEES over ``dof`` of landmarks (M,), with an interval from the spread between their runs (M,).

    Landmarks of one run share the error of its pose, so each run counts once, by the mean of its landmarks.
    """
    judged = np.isfinite(nees)
    _, place = np.unique(run[judged], return_inverse=True)
    counts = np.bincount(place)
    means = np.bincount(place, nees[judged]) / np.maximum(counts, 1) / dof
    return MapScore(ratio_interval(means, dof), len(counts), int(judged.sum()), int((~judged).sum()))


def joint_nees(error: Array, covariance: Array, dof: int = POINT) -> Array:
    """Parts (1 + K,) of the NEES of a joint error (3 + ``dof`` K,) of a pose and K landmarks, with its covariance.

    L^-1 error with L L' = covariance has independent standard normal components if the covariance is right. So each
    part is chi-square with as many degrees of freedom as it has components, independent of the others: that of its
    components given those before. Their sum is the joint NEES. All are infinite if the covariance is not positive
    definite.
    """
    count = 1 + (len(error) - POSE) // dof
    try:
        L = np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        return np.full(count, np.inf)
    squares = np.square(solve_triangular(L, error, lower=True, check_finite=False))
    parts = np.append(squares[:POSE].sum(), squares[POSE:].reshape(-1, dof).sum(axis=1))
    return parts if np.isfinite(parts).all() else np.full(count, np.inf)
