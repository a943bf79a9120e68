"""A truth that all runs share, in words: why errors are smaller than a covariance that allows for others."""

from __future__ import annotations

import numpy as np

from consistency.referee.diagnostics.questions.sample import POSITION
from consistency.referee.diagnostics.records.record import Record
from consistency.referee.diagnostics.verdict.answers import SCALE
from consistency.referee.diagnostics.verdict.verdict import Findings

FEWEST = 8  # runs; fewer true starts may be near each other by chance
SAME = 0.1  # of the stated variance of the position, which that of true starts drawn from it exceeds
LESS = 0.5  # of the median of all steps, that the NEES of the first one is at most
ROUNDING = 1e-9  # of the extent of a path


def same_truth(record: Record, found: Findings) -> list[str]:
    """That all runs have the same true path or start, where the covariance is too large in the first judged step.

    There it has to be worse than in most: a covariance that is too large throughout is so for another reason.
    """
    where = found.location
    if record.path is None or where is None or where.first_outside is None or len(record.path) < FEWEST:
        return []
    assert record.nees is not None
    assert found.scale is not None
    step = int(np.argmax(found.scale.alive > 0))
    anees = found.scale.anees
    is_below = bool(anees[step] < min(where.simultaneous[step, 0], LESS * float(np.nanmedian(anees))))
    if not is_below or not set(found.faults) & set(SCALE):
        return []
    true = record.path[:, :, 0]
    apart = np.abs(true - true[:1])
    if np.nanmax(apart) <= ROUNDING * max(float(np.nanmax(np.abs(true))), 1.0):
        return [
            "all runs have the same true path: draw its start from the first covariance, which allows for others, and "
            "the rest from the filter's model"
        ]
    counted = np.isfinite(record.nees[:, step])
    index = [i for i, axis in enumerate(record.axes) if axis in POSITION]
    stated = np.asarray(record.covariance)[counted, step][:, index, index].mean(axis=0).sum()
    if np.nanvar(true[counted, step], axis=0).sum() < SAME * stated:
        return [
            "all runs have the same true start, which the covariance does not know: draw it from the first covariance"
        ]
    return []
