"""Test of independence for consecutive errors of a log: their signs and sizes, at all lags at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import special

from consistency.referee.types import Array

FEWEST_PIECES = 20  # pieces that are asked
ENOUGH = (
    150  # pieces that show it: of sizes that continue as AR(.3) to AR(.99), fewer than 5 % of logs are then found at
)
# fault and not doubted (benchmarks/calibration_windows.py)
RATE = 0.004  # chance to doubt independent pieces; by simulation at most 0.5 %, with 20 pieces and with 1,000
SIZES = 0.75  # share of the rate that sizes have: signs have as many numbers as the error, and need less
ALIKE = 0.9  # and of that what goes together has, as only this makes a mean less sure than it seems


@dataclass(frozen=True)
class Independence:
    """Whether pieces of a log seem to be independent."""

    pieces: int
    sizes: float  # p value of the sizes of the errors, corrected for all that is asked; NaN where there are too few
    signs: float  # and of their signs
    alike: bool  # in what is clearer, neighbours go together; otherwise against each other

    @property
    def p_value(self) -> float:
        """p value of the hypothesis that pieces are independent; NaN where there are too few."""
        return min(self.sizes, self.signs)

    @property
    def doubtful(self) -> bool:
        """Whether pieces seem to be dependent; at most 0.5 % of logs with independent pieces are called so."""
        return self.p_value <= RATE

    @property
    def of_sizes(self) -> bool:
        """Whether the sizes show the dependence more clearly than the signs."""
        return self.sizes <= self.signs


def independence(whitened: Array, nees: Array | None = None) -> Independence:
    """Test whether the errors of pieces of a log are independent of each other.

    The variance of a mean over W pieces, relative to W independent ones, is the sum of their autocorrelations over all
    lags, which is the spectrum at its low end. So the periodogram is summed over its lowest b frequencies, b = 1, 2, 4,
    ... up to a quarter of W, and compared with the rest: for white Gaussian series the ratio has exactly the F
    distribution (Priestley 1981, Spectral Analysis and Time Series, ch. 6). It is applied to

    - the errors, with the mean 0 that they should have: a bias counts as a correlation that never decays;
    - the cube roots of their NEES, which are nearly Gaussian (Wilson & Hilferty 1931), about their mean over the
      pieces, so that the size of the covariance does not matter.

    Each p value is multiplied by the number of bands and divided by its share of the rate (Bonferroni). What all pieces
    have in common cannot be seen, and what changes slowly only if it is strong.

    Parameters
    ----------
    whitened : (W, n), L^-1 e with L L' = P, in the order of the log; several logs one behind another. Rows that are
        not finite are left out
    nees : (W,), of each piece, where it is not the squared length of ``whitened``, as of pieces with many steps
    """
    there = np.isfinite(whitened).all(axis=1)
    w = whitened[there]
    if len(w) < FEWEST_PIECES:
        return Independence(len(w), float("nan"), float("nan"), True)
    error_sizes = np.cbrt(np.square(w).sum(axis=1) if nees is None else nees[there])[:, None]
    shares = np.array([ALIKE, 1.0 - ALIKE])
    of_sizes = _low_and_high(error_sizes - error_sizes.mean(), True) / (SIZES * shares)
    of_signs = _low_and_high(w, False) / ((1.0 - SIZES) * shares)
    clearer = of_sizes if of_sizes.min() <= of_signs.min() else of_signs
    p_sizes, p_signs = (min(1.0, float(p.min())) for p in (of_sizes, of_signs))
    return Independence(len(w), p_sizes, p_signs, bool(clearer[0] <= clearer[1]))


def _low_and_high(series: Array, centred: bool) -> Array:
    """p values (2,) that low frequencies of a series (W, m) have more, and that they have less, than the others."""
    W, m = series.shape
    power = np.square(np.abs(np.fft.rfft(series, axis=0))).sum(axis=1)  # frequencies 0, 1, ..., W // 2
    freedom = np.full(len(power), 2.0 * m)
    freedom[0] = 0.0 if centred else m
    if W % 2 == 0:
        freedom[-1] = m
    power *= freedom / m  # each is now the same variance times chi-square with that many degrees of freedom
    bands = 2 ** np.arange(int(np.log2(W // 4)) + 1)
    low = np.cumsum(power)[bands]
    k = np.cumsum(freedom)[bands]
    rest = power.sum() - low
    others = freedom.sum() - k
    if not power.sum() > 0:
        return np.ones(2)
    ratio = (low / k) / np.maximum(rest / others, np.finfo(float).tiny)
    tails = np.array([special.fdtrc(k, others, ratio), special.fdtr(k, others, ratio)])
    return np.asarray(tails.min(axis=1) * len(bands))
