"""Whether innovations are white and have the stated covariance, and whether errors of one log are independent."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import special

from consistency.referee.diagnostics import distributions
from consistency.referee.diagnostics.record import Record
from consistency.referee.diagnostics.verdict_parts import NisTest, Outliers
from consistency.referee.diagnostics.whitening import all_finite, by_runs, whiten
from consistency.referee.types import Array

LAGS = 10
IMPOSSIBLE, UNLIKELY = 1e-9, 1e-3  # probability that any innovation of a right filter is as large
FEW = 0.05  # share of innovations that may be called outliers
FEWEST_INNOVATIONS = 400  # innovations; below, the chi-square of the portmanteau is not to be trusted
FEWEST_EACH = 40  # innovations for each component, measured with up to 40 components


LEAST_GAIN = float(np.log(1e4))  # log likelihood that another number of components gains over a wrong scale
ODD = 1e-3  # probability that a NIS with this number of components is not taken for such
SMALL = 0.7  # NIS over its degrees of freedom: gates and cautious noises leave more
NEES_RIGHT = (0.8, 1.25)  # mean NEES over its degrees of freedom
AFTER_UPDATE = (
    "are the innovations residuals after the update, or is S not that of the prediction? Give z - h(x) of the "
    "predicted x, with S = H P H' + R of the predicted P"
)
FEWEST_PIECES = 20  # pieces that are asked
ENOUGH = (
    150  # pieces that show it: of sizes that continue as AR(.3) to AR(.99), fewer than 5 % of logs are then found at
)
# fault and not doubted (benchmarks/calibration_windows.py)
RATE = 0.004  # chance to doubt independent pieces; by simulation at most 0.5 %, with 20 pieces and with 1,000
SIZES = 0.75  # share of the rate that sizes have: signs have as many numbers as the error, and need less
ALIKE = 0.9  # and of that what goes together has, as only this makes a mean less sure than it seems


def nis_of(innovations: Array, covariances: Array) -> tuple[Array, Array]:
    """NIS and its degrees of freedom, (runs, steps, m), (runs, steps, m, m) -> (runs, steps), (runs, steps).

    NaN and 0 where there is no innovation.
    """
    u = whiten(innovations, covariances)
    return np.square(u).sum(axis=-1), np.where(np.isfinite(u[..., 0]), u.shape[-1], 0)


def nis_and_dof(record: Record) -> tuple[Array, Array] | None:
    """NIS of a record and its degrees of freedom, (runs, steps) each; None without any."""
    if record.innovations.nis is not None and record.innovations.nis_dof is not None:
        return record.innovations.nis, record.innovations.nis_dof
    if record.innovations.values is not None and record.innovations.covariances is not None:
        return nis_of(record.innovations.values, record.innovations.covariances)
    return None


def nis_test(nis: Array, dof: Array) -> NisTest:
    """Chi-square test of the total NIS, Bar-Shalom, Li & Kirubarajan (2001) sec. 5.4.

    Innovations of a right filter are independent over steps too, so all runs and steps add up, whatever
    number of degrees of freedom each step has. Shapes (runs, steps); NaN does not count.
    """
    counted = np.isfinite(nis) & (dof > 0)
    k = int(dof[counted].sum())
    total = float(nis[counted].sum())
    if k == 0:
        return NisTest(float("nan"), 0, float("nan"), float("nan"))
    return NisTest(total / k, k, float(distributions.chi2.sf(total, k)), float(distributions.chi2.cdf(total, k)))


def outliers_of(nis: Array, dof: Array) -> Outliers | None:
    """Outliers among innovations, (runs, steps); None where no NIS is impossible, or too many are.

    A right filter has any with probability ``IMPOSSIBLE`` at most, so that they may be looked for beside any question.
    """
    rows, columns = np.nonzero(np.isfinite(nis) & (dof > 0))
    values = nis[rows, columns]
    n = dof[rows, columns]
    if not len(values):
        return None
    p = np.minimum(1.0, distributions.chi2.sf(values, n) * len(values))
    far = p < UNLIKELY
    count = int(far.sum())
    worst = int(np.lexsort((-values / n, p))[0])
    if p[worst] >= IMPOSSIBLE or count > max(1.0, FEW * len(values)) or count == len(values):
        return None
    rest = nis_test(values[~far], n[~far])
    run = int(rows[worst])
    step = int(columns[worst])
    return Outliers(count, len(values), run, step, float(values[worst]), int(n[worst]), float(p[worst]), rest)


@dataclass(frozen=True)
class Whiteness:
    """Autocorrelation over steps, and the test that it is zero."""

    correlation: Array  # (lags,), of lag 1, 2, ...; mean over components
    bound: float  # that 95 % of each stay within, if white
    statistic: float  # portmanteau
    dof: int
    p_value: float


def whiteness(innovations: Array, covariances: Array, lags: int = LAGS) -> Whiteness:
    """Portmanteau test that innovations are independent over steps, from their autocorrelation matrices.

    With u the innovations in units of their stated covariance and C_l the mean of u_k u_{k+l}' over the M
    pairs of all runs, sum M ``|C_l|^2`` / s^4 is chi-square with lags m^2 degrees of freedom (Box & Pierce 1970;
    Hosking 1980 for vectors), s^2 the mean square of u: a wrong scale alone does not fire it.

    Parameters
    ----------
    innovations, covariances : (runs, steps, m), (runs, steps, m, m); NaN where there is none
    """
    return _portmanteau(whiten(innovations, covariances), lags)


def nis_whiteness(nis: Array, dof: Array, lags: int = LAGS) -> Whiteness:
    """Whiteness of the NIS alone, where no innovations are kept, shapes (runs, steps).

    The cube root of the NIS is nearly Gaussian (Wilson & Hilferty 1931). It is standardised by its exact mean and
    standard deviation, because autocorrelations are about a mean of 0; the mean of Wilson and Hilferty is 5 % of a
    standard deviation off with one degree of freedom, which over many steps looks like correlation. The remaining mean
    is removed, so that white innovations that are not Gaussian do not count as correlated.

    Correlated innovations show in their squares, with the correlation squared.
    """
    counted = np.isfinite(nis) & (dof > 0)
    if not counted.any():
        return _portmanteau(np.full((*np.shape(nis), 1), np.nan), lags)
    overall = float(nis[counted].sum() / dof[counted].sum())
    mean, deviation = cube_root_moments(np.arange(int(dof[counted].max()) + 1))

    def standardised(nis: Array, dof: Array) -> Array:
        n = np.where(np.isfinite(nis) & (dof > 0), dof, 0).astype(int)
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.asarray((np.cbrt(nis / (n * overall)) - mean[n]) / deviation[n])

    u = by_runs(standardised, nis, dof)
    u -= np.nanmean(u) if overall > 0 else np.nan
    return _portmanteau(u[..., None], lags)


def cube_root_moments(dof: Array) -> tuple[Array, Array]:
    """Mean and standard deviation of the cube root of chi-square(dof) / dof, (...) each; NaN where ``dof`` is 0.

    E (chi-square(n) / n)^r = (2 / n)^r Gamma(n / 2 + r) / Gamma(n / 2), with r = 1/3 and 2/3.
    """
    half = np.where(dof > 0, 0.5 * dof, np.nan)
    mean, square = (half**-r * special.poch(half, r) for r in (1 / 3, 2 / 3))
    return mean, np.sqrt(square - mean**2)


def _portmanteau(u: Array, lags: int) -> Whiteness:
    _, steps, m = u.shape
    lags = min(lags, max(steps // 4, 1), max(steps - 1, 0))
    present = all_finite(u)
    unknown = Whiteness(np.full(0, np.nan), float("nan"), float("nan"), 0, float("nan"))
    if lags == 0 or present.sum() < max(FEWEST_INNOVATIONS, FEWEST_EACH * m):
        return unknown
    u = np.where(present[..., None], u, 0.0)
    power = float(np.square(u).sum() / (present.sum() * m))
    statistic = 0.0
    correlation = np.zeros(lags)
    pairs = 0
    for lag in range(1, lags + 1):
        pairs = int((present[:, lag:] & present[:, :-lag]).sum())
        if pairs == 0 or power == 0:
            return unknown
        C = np.tensordot(u[:, :-lag], u[:, lag:], axes=((0, 1), (0, 1))) / (pairs * power)
        correlation[lag - 1] = np.trace(C) / m
        statistic += pairs * float(np.square(C).sum())
    dof = lags * m * m
    bound = 1.96 / np.sqrt(pairs * m)
    return Whiteness(correlation, float(bound), statistic, dof, float(distributions.chi2.sf(statistic, dof)))


# --- probable mix-ups: another number of components, or residuals after the update ----------------------------


def innovation_causes(nis: Array, dof: Array, nees_ratio: float) -> list[str]:
    """Hints on NIS of another number of components, or of residuals after the update; or none.

    Parameters
    ----------
    nis, dof : (runs, steps), NaN where there is no innovation
    nees_ratio : mean NEES over its degrees of freedom; NaN where no errors are known
    """
    counted = np.isfinite(nis) & (dof > 0) & (nis > 0)
    values = nis[counted]
    stated = dof[counted]
    if not len(values):
        return []
    if (stated == stated[0]).all():
        other = _other_dof(values, int(stated[0]))
        if other is not None:
            has = f"the NIS is distributed like chi-square with {other} degrees of freedom"
            return [f"{has}, not {stated[0]:.0f} as stated; give the number of components of the innovations"]
    total = float(values.sum())
    components = float(stated.sum())
    small = total < SMALL * components and distributions.chi2.cdf(total, components) < ODD
    if small and NEES_RIGHT[0] < nees_ratio < NEES_RIGHT[1]:
        return [f"the NEES is about right, and the NIS {components / total:.2g} times too small: {AFTER_UPDATE}"]
    return []


def _other_dof(nis: Array, stated: int) -> int | None:
    """Degrees of freedom of the chi-square law that NIS (N,) follow where a wrong scale of the stated one does not."""
    size = len(nis)
    mean = float(nis.mean())
    log_mean = float(np.log(nis).mean())
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
