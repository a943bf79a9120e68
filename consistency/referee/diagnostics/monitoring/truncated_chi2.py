"""The chi-square distribution truncated by a validation gate: only values up to a limit are observed."""

from __future__ import annotations

import math

from scipy import special
from scipy.optimize import brentq

from consistency.referee.diagnostics.statistics import distributions

TINY = 1e-290  # below, a distribution function is taken from its series
WIDEST = 1e3  # scale up to which one is looked for


def gate_limit(gate: float, dof: float) -> float:
    """Largest accepted NIS of a gate that accepts the share ``gate`` of the innovations of a right filter."""
    return float(distributions.chi2.ppf(gate, dof))


def log_chi2_cdf(x: float, dof: float) -> float:
    """Logarithm of the chi-square distribution function, without underflow.

    Far below the mean from its series, NIST Digital Library of Mathematical Functions eq. 8.7.1 and 8.5.1.
    """
    value = float(special.gammainc(dof / 2, x / 2))
    if value > TINY:
        return math.log(value)
    a = dof / 2
    half = x / 2
    series = float(special.hyp1f1(1.0, a + 1.0, half))
    return a * math.log(half) - half - math.lgamma(a + 1.0) + math.log(series)


def gated_mean(scale: float, dof: float, limit: float) -> float:
    """Mean of scale times chi-square(dof), given that it is at most ``limit``."""
    x = limit / scale
    return scale * dof * math.exp(log_chi2_cdf(x, dof + 2) - log_chi2_cdf(x, dof))


def gated_scale(mean: float, dof: float, gate: float | None) -> float:
    """The scale at which the mean NIS behind the gate is ``mean``: its maximum-likelihood estimate.

    ``dof`` may be an average. Infinite where the mean is larger than that of any scale up to 1,000: the values then
    show only that they were accepted.
    """
    if gate is None or mean == 0.0:
        return mean / dof
    limit = gate_limit(gate, dof)
    low, high = 0.5 * mean / dof, WIDEST  # behind a gate the mean is never above scale times dof
    if gated_mean(high, dof, limit) <= mean:
        return math.inf
    return float(brentq(lambda scale: gated_mean(scale, dof, limit) - mean, low, high, rtol=1e-9))
