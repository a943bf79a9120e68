"""Settings at which errors have the size that is stated: any setting that is consistent lies among them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.stats import qmc

from consistency.referee.diagnostics import Verdict
from consistency.referee.types import Array

SPAN = float(np.log(100.0))  # of one factor to another, up and down from a fit; beyond it a filter hardly uses one
ALONG = 9  # settings for two factors: ratios a factor of 3.2 apart
AROUND = 16  # settings for more
CORRECTIONS = 2  # of the common scale; the first is nearly right, for gains hardly change with it


class Balanced(NamedTuple):
    """Log factors (p,), and the verdict on the runs of the fit."""

    log_factors: Array
    verdict: Verdict

    @property
    def rank(self) -> tuple[float, float]:
        """Greater is nearer to consistent: by the p-value of all questions, then by the size of the errors."""
        p = self.verdict.p_value
        ratio = self.verdict.inflation
        return (p if np.isfinite(p) else 0.0, -abs(np.log(ratio)) if ratio > 0.0 else -np.inf)


def directions(p: int) -> Array:
    """Log factors (settings, p) of mean zero: how factors may differ from each other."""
    if p == 1:
        return np.zeros((1, 1))
    if p == 2:
        apart = np.linspace(-SPAN, SPAN, ALONG)
        return np.column_stack([-apart / 2.0, apart / 2.0])
    points: Array = SPAN * (qmc.Sobol(p, scramble=False).random(AROUND) - 0.5)
    return np.asarray(points - points.mean(axis=1, keepdims=True))


def balanced(centre: Array, ratio: Callable[[Array], float], judge: Callable[[Array], Verdict]) -> list[Balanced]:
    """Settings at which the mean NEES is as stated, one for each direction from a fit, with the verdict on each.

    Scaling all covariances together leaves the gains of a linear filter as they are and divides its NEES, so that each
    direction has one such setting, and finding it takes one step or two. Directions in which a run fails are left out.

    Parameters
    ----------
    centre : log factors (p,) of the fit
    ratio : mean NEES over its degrees of freedom at log factors (p,); not finite where a run fails
    judge : the verdict there, on the same runs
    """
    settings = []
    for direction in directions(len(centre)):
        x = centre + direction
        for _ in range(CORRECTIONS):
            x = x + np.log(ratio(x))
        if np.isfinite(x).all():
            settings.append(Balanced(x, judge(x)))
    return settings


def nearest(settings: Sequence[Balanced]) -> Balanced | None:
    """The one that comes nearest to consistent; None of none."""
    return max(settings, key=lambda setting: setting.rank, default=None)
