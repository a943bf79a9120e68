"""Test whether runs that end early were lost; if so, the remaining steps are a biased sample of the errors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import special

from consistency.referee.types import Array

RATE = 1e-3  # chance to say so where runs end for reasons that have nothing to do with their errors


@dataclass(frozen=True)
class EarlyEnds:
    """Runs that end before the last step of the others, and their errors there."""

    runs: int  # that end while others go on
    above: float  # share of the runs that go on whose NEES is smaller in that step; 1/2 if ends do not depend on errors
    p_value: float  # that they do not, or on small errors only; NaN where no run ends early

    @property
    def lost(self) -> bool:
        """Whether runs that end early have clearly larger errors than those that go on."""
        return self.p_value <= RATE


def early_ends(nees: Array) -> EarlyEnds:
    """Test whether runs that end early have a larger NEES in their last step than the runs that go on.

    In each step in which runs end, the NEES of all runs that have reached it are ranked. Given these values, each run
    is equally likely to end if ends do not depend on errors, however the steps depend on each other. So the sum of
    their ranks has the mean and variance of Wilcoxon (1945), and those of different steps are uncorrelated (Prentice
    1978, Biometrika 65). The sum over all steps is taken as normal, which for few runs is on the safe side.

    Parameters
    ----------
    nees : (runs, steps), NaN where a run has no value
    """
    there = np.isfinite(nees)
    last = np.where(there.any(axis=1), nees.shape[1] - 1 - np.argmax(there[:, ::-1], axis=1), -1)
    runs, above, gap, variance = 0, 0.0, 0.0, 0.0
    for step in np.unique(last[(last >= 0) & (last < last.max(initial=-1))]):
        reached = there[:, step]
        ending, R = last[reached] == step, int(reached.sum())
        d = int(ending.sum())
        if d == R:
            continue
        ranks = float(_ranks(nees[reached, step])[ending].sum())
        runs += d
        above += (ranks - 0.5 * d * (d + 1)) / (R - d)
        gap += ranks - 0.5 * d * (R + 1)
        variance += d * (R - d) * (R + 1) / 12.0
    if not runs:
        return EarlyEnds(0, float("nan"), float("nan"))
    return EarlyEnds(runs, above / runs, float(special.ndtr(-gap / np.sqrt(variance))))


def _ranks(values: Array) -> Array:
    """Ranks from 1, equal values sharing the mean of theirs."""
    _, place, count = np.unique(values, return_inverse=True, return_counts=True)
    return np.asarray((np.cumsum(count) - 0.5 * (count - 1))[place])
