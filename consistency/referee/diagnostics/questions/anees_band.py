"""Test of the covariance in single steps: a band for the ANEES that holds in all steps at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import optimize, special

from consistency.referee.defaults import FALSE_ALARM
from consistency.referee.diagnostics.questions.scale import FEW
from consistency.referee.diagnostics.records.large_arrays import block_slices
from consistency.referee.diagnostics.statistics import distributions
from consistency.referee.diagnostics.statistics.nees import anees
from consistency.referee.types import Array


@dataclass(frozen=True)
class Band:
    """Band in which the ANEES curve of a consistent filter stays in all steps at once."""

    low: Array  # (steps,), NaN where no run has a value
    high: Array  # (steps,)
    p_value: float  # of the curve: the smallest false-alarm rate at which it leaves its band; NaN without a step
    above: Array  # (steps,) of bool
    below: Array  # (steps,) of bool

    @property
    def outside(self) -> Array:
        """Whether the curve is outside in a step, on either side, (steps,) of bool."""
        return np.asarray(self.above | self.below)


def simultaneous_band(
    nees: Array, dof: int, false_alarm: float = FALSE_ALARM, method: str = "max", allow: str | None = None
) -> Band:
    """Band that the ANEES of a consistent filter leaves in any step with probability ``false_alarm`` at most.

    In each step, runs times ANEES is chi-square with runs times ``dof`` degrees of freedom (Bar-Shalom, Li &
    Kirubarajan 2001, sec. 5.4), turned into a standard normal z. With ``method`` "bonferroni" the rate is
    divided by the number of steps: exact under any dependence. With "max", the maximum of abs(z), neighbours
    that move together are counted once: P(max > c) <= sum P(z_k > c) - sum P(z_k > c, z_k+1 > c) (Hunter
    1976; Worsley 1982), with the second term from the bivariate normal with the correlation of the NEES in
    neighbouring steps over the runs, in Owen's (1956) T function: 2 Q(c) + 4 sum T(c, a_k), a_k^2 =
    (1 - rho_k) / (1 + rho_k). Where runs have gaps or end early, step averages are over different runs, and correlate
    less than the NEES of a run that has both steps: rho_k is that times s / sqrt(N_k N_k+1), where s of the N_k and
    N_k+1 runs are in both.

    Parameters
    ----------
    nees : (runs, steps), NaN where a run has no value
    allow : "conservative" leaves the lower side open

    Raises
    ------
    ValueError
        Unknown method.
    """
    if method not in ("max", "bonferroni"):
        raise ValueError(f"method must be 'max' or 'bonferroni', got '{method}'")
    alive = np.isfinite(nees).sum(axis=0)
    judged = np.flatnonzero(alive > 0)
    low = np.full(nees.shape[1], np.nan)
    high = np.full(nees.shape[1], np.nan)
    none = np.zeros(nees.shape[1], bool)
    if not len(judged):
        return Band(low, high, float("nan"), none, none)
    sides = 1 if allow == "conservative" else 2
    slopes = None
    if method == "max" and len(nees) >= FEW:
        parts = (nees[:, judged[b.start : b.stop + 1]] for b in block_slices(len(judged) - 1, len(nees)))
        slopes = np.concatenate([_slopes(part) for part in parts])

    def exceedance(c: float) -> float:
        if slopes is None:
            return sides * len(judged) * float(special.ndtr(-c))
        return sides * float(special.ndtr(-c) + 2.0 * special.owens_t(c, slopes).sum())

    c = float(optimize.brentq(lambda x: exceedance(x) - min(false_alarm, 0.999 * exceedance(0.0)), 0.0, 38.0))
    curve = anees(nees)
    k = alive[judged] * dof
    upper, lower = (
        distributions.chi2.sf(alive[judged] * curve[judged], k),
        distributions.chi2.cdf(alive[judged] * curve[judged], k),
    )
    smallest = float(upper.min() if sides == 1 else min(upper.min(), lower.min()))
    p_value = min(1.0, exceedance(max(float(-special.ndtri(smallest)), 0.0))) if smallest > 0 else 0.0
    counts, of_step = np.unique(alive[judged], return_inverse=True)
    if sides == 2:
        low[judged] = (distributions.chi2.ppf(special.ndtr(-c), counts * dof) / counts)[of_step]
    else:
        low[judged] = 0.0
    high[judged] = (distributions.chi2.isf(special.ndtr(-c), counts * dof) / counts)[of_step]
    with np.errstate(invalid="ignore"):
        return Band(low, high, p_value, curve > high, curve < low)


def _slopes(nees: Array) -> Array:
    """sqrt((1 - rho) / (1 + rho)) of neighbours among the steps of (runs, steps); rho from 0 to 1."""
    present = np.isfinite(nees)
    both = present[:, 1:] & present[:, :-1]
    shared = both.sum(axis=0)
    alive = present.sum(axis=0)
    count = np.maximum(shared, 1)
    a, b = (np.where(both, part, 0.0) for part in (nees[:, :-1], nees[:, 1:]))
    a, b = (np.where(both, part - part.sum(axis=0) / count, 0.0) for part in (a, b))
    scale = np.sqrt((a * a).sum(axis=0) * (b * b).sum(axis=0))
    rho = np.where((scale > 0) & (shared >= FEW), (a * b).sum(axis=0) / np.where(scale > 0, scale, 1.0), 0.0)
    rho = np.clip(rho * shared / np.sqrt(alive[:-1] * alive[1:]), 0.0, 1.0)
    return np.asarray(np.sqrt((1.0 - rho) / (1.0 + rho)))
