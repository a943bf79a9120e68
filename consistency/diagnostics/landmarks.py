"""NEES of a map: of many landmarks that share the errors of one run."""

from __future__ import annotations

import numpy as np

from consistency.diagnostics.records import MapScore
from consistency.diagnostics.scale import ratio_interval
from consistency.types import Array, Indices

POINT = 3  # degrees of freedom of a landmark in space


def map_score(run: Indices, nees: Array, dof: int = POINT) -> MapScore:
    """Mean NEES over ``dof`` of landmarks (M,), with an interval from the spread between their runs (M,).

    Landmarks of one run share the error of its pose, so each run counts once, by the mean of its landmarks.
    """
    judged = np.isfinite(nees)
    _, place = np.unique(run[judged], return_inverse=True)
    counts = np.bincount(place)
    means = np.bincount(place, nees[judged]) / np.maximum(counts, 1) / dof
    return MapScore(ratio_interval(means, dof), len(counts), int(judged.sum()), int((~judged).sum()))
