"""Scale of a single log, if errors go on to decorrelate as they do within it. Reported, never judged."""

from __future__ import annotations

import numpy as np
from scipy import special

from consistency.referee.defaults import CONFIDENCE
from consistency.referee.diagnostics.planning.number_of_runs import MARGIN
from consistency.referee.diagnostics.questions.equivalence import deciding_runs
from consistency.referee.diagnostics.questions.scale import FEW, LEAST, MeanTest
from consistency.referee.diagnostics.statistics import distributions
from consistency.referee.diagnostics.verdict.parts import Interval, Settings, Within
from consistency.referee.types import Array

REACH = 5.0  # correlation times over which autocorrelations are summed: Sokal (1997), sec. 3
LONG = 20.0  # correlation times that a log has at least; by simulation (benchmarks/single_log.py)
APART = 10.0  # correlation times in a piece of a log that stands as a run
MOST = 50  # pieces; more gain nothing


def within(nees: Array, dof: int, settings: Settings, factor: float, confidence: float = CONFIDENCE) -> Within | None:
    """Ratio of true to stated covariance of one log, with an interval from how its NEES decorrelates.

    The mean of T values Y_k = NEES_k / dof has the variance s^2 tau / T with the integrated autocorrelation time tau,
    summed over a window of at least 5 tau (Madras & Sokal 1988; Sokal 1997, "Monte Carlo methods in statistical
    mechanics", sec. 3). Its distribution is taken as chi-square(nu) / nu with nu = 2 T mean^2 / (s^2 tau), one standard
    error to the safe side, and Student's t for the remaining uncertainty. An error that is constant over the log is not
    detected.

    Parameters
    ----------
    nees : (T,), in order; NaN where there is none
    factor : by which the ratio may be off in a log that decides

    Returns
    -------
    None where the log has fewer than 20 correlation times
    """
    values = nees[np.isfinite(nees)] / dof
    if len(values) < LONG or not values.std() > 0:
        return None
    tau, reach = correlation_time(values - values.mean())
    steps = len(values)
    if steps < LONG * tau:
        return None
    ratio, spread = float(values.mean()), float(values.var(ddof=1))
    fourth = float(np.mean((values - ratio) ** 4)) / spread**2
    doubt = 2.0 * (2.0 * reach + 1.0) / steps + max(fourth - 1.0, 0.0) * tau / steps  # variance of log(tau s^2)
    log_nu = np.log(2.0 * ratio**2 * steps / (spread * tau)) - np.sqrt(doubt)
    nu = float(np.exp(min(log_nu, np.log(dof * steps))))
    z = float(distributions.t.isf(0.5 * (1.0 - confidence), max(2.0 / doubt, LEAST)))
    low, high = (float(distributions.chi2.ppf(special.ndtr(side), nu)) / nu for side in (-z, z))
    one_step = MeanTest(FEW, ratio, nu / steps, np.inf, np.nan, np.nan)
    least = deciding_runs(one_step, factor, settings)
    needed = None if least is None else max(int(np.ceil(MARGIN * least)), int(np.ceil(FEW * APART * tau)))
    pieces = None if needed is None else int(min(MOST, max(needed, steps) // (APART * tau)))
    return Within(Interval(ratio, ratio / high, ratio / max(low, 1e-300)), tau, nu, needed, pieces)


def correlation_time(series: Array) -> tuple[float, int]:
    """Integrated correlation time of a series (T,) about zero, at least 1, and the lag up to which it was summed."""
    T = len(series)
    transform = np.fft.rfft(series, 2 * T)
    covariance = np.fft.irfft(transform * transform.conj(), 2 * T)[:T]
    if not covariance[0] > 0:
        return 1.0, 1
    tau = 2.0 * np.cumsum(covariance / covariance[0]) - 1.0
    enough = np.arange(T) >= REACH * tau
    lag = int(np.argmax(enough)) if enough.any() else T - 1
    return max(1.0, float(tau[lag])), max(lag, 1)
