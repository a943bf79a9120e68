"""Probable mix-ups of innovations: the number of their components, and the moment of the update that they are of."""

from __future__ import annotations

import numpy as np
from scipy import special

from consistency.referee.diagnostics.statistics import distributions
from consistency.referee.types import Array

LEAST_GAIN = float(np.log(1e4))  # log likelihood that another number of components gains over a wrong scale
ODD = 1e-3  # chance that a NIS with this number of components is not taken for such
SMALL = 0.7  # NIS over its degrees of freedom: gates and cautious noises leave more
NEES_RIGHT = (0.8, 1.25)  # mean NEES over its degrees of freedom
AFTER_UPDATE = (
    "are the innovations residuals after the update, or is S not that of the prediction? Give z - h(x) of the "
    "predicted x, with S = H P H' + R of the predicted P"
)


def innovation_causes(nis: Array, dof: Array, nees_ratio: float) -> list[str]:
    """Hints on NIS of another number of components, or of residuals after the update; or none.

    Parameters
    ----------
    nis, dof : (runs, steps), NaN where there is no innovation
    nees_ratio : mean NEES over its degrees of freedom; NaN where no errors are known
    """
    counted = np.isfinite(nis) & (dof > 0) & (nis > 0)
    values, stated = nis[counted], dof[counted]
    if not len(values):
        return []
    if (stated == stated[0]).all():
        other = _other_dof(values, int(stated[0]))
        if other is not None:
            has = f"the NIS is distributed like chi-square with {other} degrees of freedom"
            return [f"{has}, not {stated[0]:.0f} as stated; give the number of components of the innovations"]
    total, components = float(values.sum()), float(stated.sum())
    small = total < SMALL * components and distributions.chi2.cdf(total, components) < ODD
    if small and NEES_RIGHT[0] < nees_ratio < NEES_RIGHT[1]:
        return [f"the NEES is about right, and the NIS {components / total:.2g} times too small: {AFTER_UPDATE}"]
    return []


def _other_dof(nis: Array, stated: int) -> int | None:
    """Degrees of freedom of the chi-square law that NIS (N,) follow where a wrong scale of the stated one does not."""
    size, mean, log_mean = len(nis), float(nis.mean()), float(np.log(nis).mean())
    scale = mean / stated
    scaled = _likelihood(stated, mean / scale, log_mean - np.log(scale)) - np.log(scale)
    for dof in {int(mean), int(mean) + 1} - {0, stated}:
        of_mean = (mean - dof) * np.sqrt(size / (2.0 * dof))
        of_log = (log_mean - np.log(2.0) - special.digamma(dof / 2)) * np.sqrt(size / special.polygamma(1, dof / 2))
        follows = max(of_mean**2, of_log**2) <= distributions.chi2.isf(ODD, 1)
        if follows and size * (_likelihood(dof, mean, log_mean) - scaled) >= LEAST_GAIN:
            return dof
    return None


def _likelihood(dof: int, mean: float, log_mean: float) -> float:
    """Mean log density of chi-square at values with a mean and a mean logarithm."""
    half = dof / 2
    return float((half - 1.0) * log_mean - mean / 2 - half * np.log(2.0) - special.gammaln(half))
