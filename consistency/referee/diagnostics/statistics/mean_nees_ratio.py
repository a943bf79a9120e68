"""Difference and sum of the logarithms of two mean NEES: one-sided tests that hold for few and skewed run means."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import special

from consistency.referee.types import Array

REACH = 4.0  # standard errors; a value farther from the hypothesis moves the variance no more than this one
LARGEST = 50.0  # growth of the log variance at most, so that the exponential is finite


@dataclass(frozen=True)
class Contrast:
    """log ratio_a plus or minus log ratio_b, with its variance."""

    value: float
    variance: float
    slope: float  # change of the log variance with the value
    freedom: float  # degrees of freedom of Student's t

    @property
    def error(self) -> float:
        """Standard error of the value."""
        return float(np.sqrt(self.variance))

    @property
    def p_values(self) -> tuple[float, float]:
        """One-sided p values: of a true value that is not above 0, and of one that is not below 0."""
        if self.variance == 0.0:
            return float(self.value <= 0.0), float(self.value >= 0.0)
        move = min(abs(self.value), REACH * self.error)  # to the hypothesis
        t = self.value / self._error(-self.slope * move if self.value > 0.0 else self.slope * move)
        return float(special.stdtr(self.freedom, -t)), float(special.stdtr(self.freedom, t))

    def half_width(self, tail: float) -> float:
        """Distance from the value to a one-sided confidence limit, missed with probability ``tail`` at most."""
        widest = self._error(abs(self.slope) * REACH * self.error)
        return -float(special.stdtrit(self.freedom, tail)) * widest

    def _error(self, growth: float) -> float:
        """Standard error, to the safe side, where the log variance is larger by ``growth``."""
        return self.error * float(np.exp(0.5 * (min(max(growth, 0.0), LARGEST) + margin(self.freedom))))


def contrast(a: Array, b: Array, sign: float, paired: bool) -> Contrast:
    """log mean a - log mean b (``sign`` -1) or log mean a + log mean b (``sign`` 1) of run means.

    The variance comes from each run's first-order influence on the logarithms (Efron & Stein 1981). With few runs
    Student's t of it errs too often, because run means are skewed: a sample without large values has a small mean
    and a small spread. Therefore

    - the spread of the run means of a filter is at least that of a gamma distribution with their mean and mean
      logarithm, which reveals slow runs by their small values;
    - the variance is replaced by its value under the tested hypothesis, if that is larger. To first order its logarithm
      changes by ``slope`` times the value (Johnson 1978 corrects t for the same dependence);
    - it is taken one standard error to the safe side, see :func:`margin`.

    These corrections were chosen by simulation and then measured on fresh draws; they are not derived.

    Parameters
    ----------
    a, b : (R,), (S,), mean NEES of each run over dof; their means are positive
    paired : row i of both is the same trial (R = S); otherwise the runs are independent, and Student's t has as many
        degrees of freedom as the filter with fewer runs allows
    """
    x = a / a.mean() - 1.0
    y = sign * (b / b.mean() - 1.0)
    of_a = x.var(ddof=1) / len(x)
    of_b = y.var(ddof=1) / len(y)
    if paired:
        z = x + y
        variance = z.var(ddof=1) / len(z)
        change = z * z - 2.0 * x * _product(z, x) - 2.0 * sign * y * _product(z, y)
        bend = _third_moment(change, z)
    else:
        variance = of_a + of_b
        change_a = x * x - 2.0 * x * _product(x, x)
        change_b = y * y - 2.0 * sign * y * _product(y, y)
        bend = _third_moment(change_a, x) + _third_moment(change_b, y)
    value = float(np.log(a.mean()) + sign * np.log(b.mean()))
    freedom = min(len(a), len(b)) - 1.0
    if variance == 0.0:
        return Contrast(value, 0.0, 0.0, freedom)
    hidden = max(of_a, _gamma_spread(a) / len(a)) + max(of_b, _gamma_spread(b) / len(b))
    return Contrast(value, float(variance * hidden / (of_a + of_b)), float(bend / variance**2), freedom)


def margin(freedom: float) -> float:
    """Standard error of the logarithm of a variance with this many degrees of freedom, for Gaussian values."""
    return float(np.sqrt(2.0 / freedom))


def _product(x: Array, y: Array) -> float:
    return float(x @ y) / (len(x) - 1)


def _third_moment(change: Array, z: Array) -> float:
    """Covariance of the variance of the mean of ``z`` with this mean."""
    n = len(z)
    return float(change @ z) / (n * (n - 1) * (n - 2))


def _gamma_spread(means: Array) -> float:
    """Squared coefficient of variation of the gamma distribution with this mean and mean logarithm.

    1 / a with log a - digamma(a) = log mean - mean log, to within 1.5 %.
    """
    s = max(float(np.log(means.mean()) - np.log(np.maximum(means, np.finfo(float).tiny)).mean()), 0.0)
    return float(12.0 * s / (3.0 - s + np.sqrt((s - 3.0) ** 2 + 24.0 * s)))
